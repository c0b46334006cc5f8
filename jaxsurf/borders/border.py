r"""A border as rows of its points, and its geometry between them: feet, normals, conormals.

The conormal $\nu = \tau\times n$ is tangent to the surface and normal to its border. The tangent
$\tau$ of the border comes from polynomials through up to five border points in a row, so that
it is as accurate as the stencils that use it; rows end at corners.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..arguments import instance, shaped
from ..cloud import PointCloud
from ..compiling import sized_jit
from ..failures import check, is_concrete
from ..frames import tangent_frames


class Border(eqx.Module):
    """The border points of a cloud, and for each the rows of border points around it.

    A point inside a smooth piece has the same row twice; a corner one on each side. On a plane
    curve, whose border is its ends, a row is the end and the point next to it.

    Args:
        points: the border points, `(m,)`, piece by piece in order.
        rows: border points around each, in order with the surface on the left, `(2, m, r)`.
        mask: which of them count, `(2, m, r)`.

    Example:
        >>> square = js.graph(lambda x, y: 0 * x, (6, 6))
        >>> border = js.find_border(square)
        >>> len(border.points), int(border.corners.sum())
        (20, 4)
    """

    points: Int[Array, " m"]
    rows: Int[Array, "2 m r"]
    mask: Bool[Array, "2 m r"]

    def __init__(self, points, rows, mask):
        self.points, self.rows, self.mask = points, rows, mask
        m, shape = np.shape(self.points), np.shape(self.rows)
        if len(m) != 1 or not m[0]:
            raise ValueError(f"points has shape {m}, expected (m,) with at least 1 point")
        if len(shape) != 3 or shape[:2] != (2, *m) or shape[2] < 2:
            raise ValueError(f"rows has shape {shape}, expected (2, {m[0]}, r)")
        shaped(self.mask, "mask", shape)
        for name in ("points", "rows"):
            given = getattr(self, name)
            if given.dtype.kind not in "iu":
                raise TypeError(f"{name} is of type {given.dtype}, expected indices")
            check(given, lambda x: x < 0, f"{name} names point {{v}}, points count from 0")

    def __repr__(self):
        _, m, r = self.rows.shape
        corners = int(self.corners.sum()) if is_concrete(self.rows) else "?"
        return f"Border({m} points, {corners} corners, rows of up to {r} points)"

    @property
    def corners(self) -> Bool[np.ndarray, " m"]:
        """True where two smooth pieces meet; on the host, also while the cloud is traced."""
        before, after = np.asarray(self.rows)
        return np.any(before != after, axis=1)

    @sized_jit
    def conormals(self, cloud: PointCloud) -> Float[Array, "m d"]:
        """Outward unit conormals; at a corner the mean direction of both sides."""
        return _unit(jnp.sum(self._on_both_sides(cloud), axis=0))

    def _on_both_sides(self, cloud: PointCloud) -> Float[Array, "2 m d"]:
        """Those of both pieces, together: the geometry there is compiled once."""
        m = len(self.points)
        side, slot = jnp.divmod(jnp.arange(2 * m), m)
        found = self.at(cloud, side, slot, cloud.points[self.points[slot]])[2]
        return found.reshape(2, m, -1)

    def side_conormals(self, cloud: PointCloud, side: int) -> Float[Array, "m d"]:
        """Outward unit conormals of the piece before (0) or after (1) each point."""
        slot = jnp.arange(len(self.points))
        return self.at(cloud, side, slot, cloud.points[self.points])[2]

    @sized_jit
    def edges(self, cloud: PointCloud) -> Float[Array, "2 m d"]:
        """Outward conormals of what bounds the surface at each point: both sides of a convex
        corner, else one, and zero."""
        before, after = self._on_both_sides(cloud)
        mean, none = _unit(before + after), jnp.zeros_like(before)
        if cloud.dim == 2:
            return jnp.stack([mean, none])
        turns = jnp.any(self.rows[0] != self.rows[1], axis=1)
        turn = jnp.sum(jnp.cross(before, after) * cloud.normals[self.points], axis=1)
        convex = (turns & (turn > 0))[:, None]
        return jnp.stack([jnp.where(convex, before, mean), jnp.where(convex, after, none)])

    @sized_jit
    def at(self, cloud: PointCloud, side, slot, near: Float[Array, "p d"]):
        """Foot points on the border, and the geometry there.

        Args:
            cloud: the points and normals.
            side: which row of a point to follow, 0 or 1 or `(p,)`.
            slot: place in `points` of the border point close by, `(p,)`.
            near: positions, `(p, d)`.

        Returns:
            Foot points `(p, d)`, unit normals and outward conormals there, and the weights `(p, r)`
            by which what is known on the border is carried to the foot; a corner has no part
            in them, as a flux has two values there.
        """
        rows, mask = self.rows[side, slot], self.mask[side, slot]
        points, normals = cloud.points[rows], cloud.normals[rows]
        if cloud.dim == 2:
            return _end(points, normals)
        centre = cloud.points[self.points[slot]]
        last = jnp.sum(mask, axis=1) - 1
        chord = jnp.take_along_axis(points, last[:, None, None], axis=1)[:, 0] - points[:, 0]
        axis = chord / jnp.linalg.norm(chord, axis=1, keepdims=True)
        nodes = jnp.einsum("prd,pd->pr", points - centre[:, None], axis)
        x = jnp.einsum("pd,pd->p", near - centre, axis)

        def nearer(x, _):
            value, slope = _lagrange(nodes, mask, x)
            foot = jnp.einsum("pr,prd->pd", value, points)
            tangent = jnp.einsum("pr,prd->pd", slope, points)
            away = jnp.einsum("pd,pd->p", near - foot, tangent)
            return x + away / jnp.sum(tangent**2, axis=1), None

        x = jax.lax.scan(nearer, x, None, length=_NEWTON)[0]
        value, slope = _lagrange(nodes, mask, x)
        foot = jnp.einsum("pr,prd->pd", value, points)
        tangent = jnp.einsum("pr,prd->pd", slope, points)
        normal = _unit(jnp.einsum("pr,prd->pd", value, normals))
        conormal = _unit(jnp.cross(tangent, normal))
        turns = jnp.any(self.rows[0] != self.rows[1], axis=1)
        smooth = mask & ~jnp.zeros(cloud.n, bool).at[self.points].set(turns)[rows]
        return foot, normal, conormal, _lagrange(nodes, smooth, x)[0]


_NEWTON = 3


def _unit(v):
    return v / jnp.linalg.norm(v, axis=-1, keepdims=True)


def _end(points, normals):
    """The end of a plane curve: the conormal leads away from the point next to it."""
    normal = normals[:, 0]
    tangent = tangent_frames(normal)[:, 0]
    inward = jnp.einsum("pd,pd->p", points[:, 1] - points[:, 0], tangent)
    value = jnp.zeros(points.shape[:2], points.dtype).at[:, 0].set(1)
    return points[:, 0], normal, -jnp.sign(inward)[:, None] * tangent, value


def _lagrange(nodes, mask, x):
    """Values and slopes at x of the polynomials that are 1 at one node and 0 at the others."""
    r = nodes.shape[1]
    others = mask[:, None] & ~jnp.eye(r, dtype=bool)
    gap = jnp.where(others, nodes[:, :, None] - nodes[:, None], 1)
    step = jnp.where(others, x[:, None, None] - nodes[:, None], gap)
    factor = step / gap
    value = jnp.where(mask, jnp.prod(factor, axis=2), 0)
    # The product rule, without a division by factors that vanish at the nodes.
    without = jnp.where(jnp.eye(r, dtype=bool), 1, factor[:, :, None])
    terms = jnp.where(others, jnp.prod(without, axis=3) / gap, 0)
    return value, jnp.where(mask, jnp.sum(terms, axis=2), 0)


def checked_border(border: Border, cloud: PointCloud) -> Border:
    """Refuse what is no border, or that of a larger cloud."""
    instance(border, Border, "border", "made by js.find_border")
    text = f"border names point {{v}}, the cloud has {cloud.n}"
    check(border.points, lambda x: x >= cloud.n, text)
    return border
