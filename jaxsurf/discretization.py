r"""A surface and all that is computed from its points: operators, curvatures, integrals."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from . import curvature, operators, quadrature
from .arguments import as_float, as_many, finite, instance, switched_off, whole
from .borders.border import Border
from .borders.order import marked_border
from .build import checked_lists
from .built import Built, built, weighed
from .cloud import PointCloud
from .failures import is_concrete, needs_values, without_derivatives
from .interpolation import interpolated
from .kept import Kept
from .motion import code_of, folded, is_judged, moved_cloud, raise_for
from .neighbors import Neighbors, switched_on
from .renew import NeighborSearch, renewed
from .stencils.algebra import Composition
from .stencils.method import AbstractMethod
from .stencils.stencil import Stencil
from .stencils.usual import USUAL
from .symmetric import symmetrised


class Discretization(eqx.Module):
    r"""A cloud with neighbours and a method: the surface, as far as it can be calculated with.

    Made by `discretize`. Operators and areas are computed when they are first asked for, and kept;
    where points or normals are traced every time.

    Args:
        cloud: n points in d dimensions with unit normals.
        neighbors: of every point.
        method: how weights are computed.
        border: the marked border of the cloud; None if it is closed.
        found_at: where the points were when their neighbours were found; None if where they are.
        found: what was wrong then, as in `code`; None if nothing.

    Example:
        >>> surface = js.discretize(js.torus(1_000, 1.0, 0.4), method=js.GFDM(degree=4))
        >>> isinstance(surface, js.Discretization), surface.n
        (True, 1000)
    """

    cloud: PointCloud
    neighbors: Neighbors
    method: AbstractMethod
    border: Border | None = None
    found_at: Float[Array, "n d"] | None = None
    found: Int[Array, " n"] | None = None

    def __check_init__(self):
        if not isinstance(self.cloud, PointCloud):
            return  # a pytree of something else, as transformations make them
        as_many("neighbors", self.neighbors.n, "the cloud", self.cloud.n)
        name = f"polynomial_degree of {type(self.method).__name__}"
        whole(self.method.polynomial_degree, name, least=1)

    def __repr__(self):
        return f"Discretization({self.cloud!r}, {self.neighbors!r}, {self.method!r})"

    @property
    def n(self) -> int:
        """Number of points, switched-off ones included."""
        return self.cloud.n

    # --- operators -------------------------------------------------------------------------

    @property
    def laplacian(self) -> Stencil:
        """Laplace–Beltrami operator, see `laplace_beltrami`."""
        return self._built.laplacian

    @property
    def gradient(self) -> Stencil:
        """Gradient along the surface, see `surface_gradient`."""
        return self._built.gradient if self.method.shares_moments else self._gradient

    @property
    def divergence(self) -> Stencil:
        """Divergence along the surface, see `surface_divergence`."""
        return operators.divergence_of(self.gradient)

    @property
    def biharmonic(self) -> Composition:
        """The Laplacian applied twice, see `biharmonic`."""
        return self.laplacian @ self.laplacian

    def directional_derivative(self, direction: Float[Array, "*n d"]) -> Stencil:
        """Derivative along a vector field, see `js.directional_derivative`."""
        return operators.along(self.gradient, direction)

    def diffusion(self, diffusivity: Float[Array, "*n"]) -> Stencil:
        """Diffusion in an inhomogeneous or anisotropic medium, see `js.diffusion`."""
        return operators.diffusion(
            self.cloud, diffusivity, neighbors=self.neighbors, method=self.method
        )

    @Kept
    def symmetric_laplacian(self) -> Stencil:
        r"""A Laplacian that is symmetric and negative semi-definite in the inner product of masses.

        With `cell_areas` m: $m_i w_{ij} = m_j w_{ji} > 0$, $j \ne i$, and rows that sum to zero, on
        any cloud and to round-off. At a border it has the natural condition $\partial_\nu u = 0$.
        `diagnostics.residual`: how far moments of its rows are from the Laplacian's, relatively.

        Accuracy: solutions of second order on quasi-uniform points (`tests/test_symmetric.py`);
            $L u$ itself is not, see `python -m experiments run symmetric`. Symmetric to round-off
            in single precision too.
        Differentiable: forward and reverse, in points and normals, for fixed neighbours.
        Raises:
            ValueError: as `areas` and `laplacian`.

        Example:
            >>> surface = js.discretize(js.sphere(300), method=js.GFDM(degree=2))
            >>> m, u = surface.cell_areas, surface.cloud.points[:, 0] ** 3
            >>> operator = surface.symmetric_laplacian
            >>> bool(abs(m @ operator(u)) < 1e-12), bool(m @ (u * operator(u)) < 0)
            (True, True)
        """
        return symmetrised(self.laplacian, self.cloud, self.neighbors, self.cell_areas, self.border)

    @Kept
    def _built(self) -> Built:
        lists, weights = (self.neighbors, self.method), vars(self).pop("_weights", None)
        return built(self.cloud, *lists, self._cut_at_once, weights=weights)

    @property
    def _cut_at_once(self) -> quadrature.Cut | None:
        """How cells are cut with the operators: in compiled code, which drops what nobody wants."""
        compiled = not is_concrete(without_derivatives(self.cloud))
        even = self.neighbors.near is None and self.border is None
        at_once = compiled and even and self.method.shares_moments
        return quadrature.cut_by(self.neighbors, self.method, self.cloud.dim) if at_once else None

    @Kept
    def _cells(self) -> quadrature.Cells:
        if self._cut_at_once is not None:
            return self._built.cells
        return quadrature.cells_of(self.cloud, self.neighbors, self.method, self.border)

    @Kept
    def _gradient(self) -> Stencil:
        return operators.surface_gradient(self.cloud, self.neighbors, method=self.method)

    # --- curvatures ------------------------------------------------------------------------

    @property
    def shape_tensor(self) -> Float[Array, "n d d"]:
        """See `shape_tensor`."""
        return curvature.tensor_of(self.gradient, self.cloud.normals)

    @property
    def mean_curvature(self) -> Float[Array, " n"]:
        """See `mean_curvature`."""
        return curvature.mean_of(self.shape_tensor)

    @property
    def gauss_curvature(self) -> Float[Array, " n"]:
        """See `gauss_curvature`."""
        curvature.check_surface(self.cloud)
        return curvature.gauss_of(curvature.along_tangents(self.shape_tensor, self.cloud)[0])

    @property
    def principal_curvatures(self) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 3"]]:
        """See `principal_curvatures`."""
        curvature.check_surface(self.cloud)
        return curvature.principal_of(*curvature.along_tangents(self.shape_tensor, self.cloud))

    @property
    def expected_error(self) -> Float[Array, ""]:
        r"""Relative error to expect of the Laplacian, of fields as smooth as the surface.

        $\|\Delta_S x + (d - 1) H n\| / \|(d - 1) H n\|$ over all points: what the Laplacian
        makes of positions beside what the gradient makes of normals. A few per cent: more points.

        Accuracy: between a fifth and four times the error of fields that vary as fast, on smooth,
            coarse and random points (`tests/test_accuracy.py`). Wrong normals count too. A plane
            has none but round-off. In float32 within 1e-5 of it.
        Differentiable: forward and reverse, in points and normals.

        Example:
            >>> coarse, fine = (js.discretize(js.sphere(n)) for n in (200, 2_000))
            >>> bool(coarse.expected_error > 30 * fine.expected_error > 0)
            True
        """
        return curvature.expected_error(self.cloud, self.laplacian, self.mean_curvature)

    # --- integrals -------------------------------------------------------------------------

    @Kept
    def areas(self) -> Float[Array, " n"]:
        r"""Weights $a_i$ with $\sum_i a_i u(x_i) \approx \int_S u\,dS$, `(n,)`, in length^(d-1).

        The cells $\{x : |x - x_i| \le |x - x_j|\}$ cut the surface into parts; over each the
        local polynomial of a field, of degree p, is integrated. Zero at switched-off points.

        Accuracy: error $O(h^{p+1})$ with p the degree of the method (the order, for DC-PSE), one
        order more for even p on even points; $O(h^2)$ where the surface has a border
        (`tests/test_discretization.py`).
        Differentiable: forward and reverse, in points and normals; in reverse once.
        Raises:
            ValueError: the cell of a point is not closed by its neighbours (named by index), as
                on a border that is not marked, or in a fold of a scan (see `cell_areas`).
        """
        return quadrature.areas(self._cells, self.neighbors, self.method.polynomial_degree)

    @Kept
    def cell_areas(self) -> Float[Array, " n"]:
        r"""Areas of the cells themselves, `(n,)`: positive, with the sum of `areas`.

        The masses of `symmetric_laplacian`. As weights of integrals of second order only, since
        the middle of a cell is not its point. Where neighbours do not close a cell, the mean of
        theirs, with a warning. Differentiable as `areas`.
        """
        return quadrature.cell_areas(self._cells, self.neighbors)

    def integrate(self, u: Float[Array, "n *c"]) -> Float[Array, "*c"]:
        r"""$\int_S u\,dS$ of a field or of each of its components."""
        return quadrature.integral(self.areas, self._field(u))

    def mean(self, u: Float[Array, "n *c"]) -> Float[Array, "*c"]:
        """Integral over area."""
        return quadrature.mean(self.areas, self._field(u))

    def inner(self, u: Float[Array, "n *c"], v: Float[Array, "n *c"]) -> Float[Array, ""]:
        r"""$\int_S u \cdot v\,dS$; of fields with components, the sum over them."""
        u, v = self._field(u), self._field(v)
        if u.shape != v.shape:
            raise ValueError(f"fields have shapes {u.shape} and {v.shape}, expected the same")
        return jnp.sum(quadrature.integral(self.areas, u * v))

    def interpolate(
        self, u: Float[Array, "n *c"], points: Float[Array, "m d"]
    ) -> Float[Array, "m *c"]:
        """Values of a field at other points of the surface, or near it.

        Args:
            u: field on the cloud, `(n, *c)`.
            points: where its values are wanted, `(m, d)`.

        Returns:
            Values `(m, *c)`, of the local polynomial of the cloud's point next to each.

        Accuracy: error $O(h^{p+1})$ with p as for `areas`.
        Differentiable: forward and reverse, in the field, the points wanted, and the cloud's points
        and normals; for fixed nearest points.
        Raises:
            ValueError: wrong shapes, points that are not finite; points farther from the surface
                than the neighbours reach (named by index).
        """
        u = self._field(u)
        points = finite(as_float(points, "points", ("m", self.cloud.dim)), "points")
        degree = self.method.polynomial_degree
        return interpolated(self.cloud, self.neighbors, degree, points, u)

    def _field(self, u) -> Float[Array, "n *c"]:
        u = as_float(u, "field", (self.n, ...))
        return switched_off(self.cloud.active, u)

    # --- motion ----------------------------------------------------------------------------

    def search(self, *, margin: float = 1.25) -> NeighborSearch:
        """Room to find neighbours in while the surface moves, for `moved`; concrete surfaces only.

        Args:
            margin: factor on what these points need. Where points crowd, or where the neighbours
                that a point had are spread, more is needed; a code says where it is not enough.

        Raises:
            TypeError: a margin that is no number.
            ValueError: a margin below 1; a traced surface.
        """
        needs_values("the surface", self)
        return NeighborSearch.allocated(self.cloud, self.neighbors, self.method, margin)

    def moved(
        self,
        points: Float[Array, "n d"],
        normals: Float[Array, "n d"] | None = None,
        *,
        search: NeighborSearch | None = None,
    ) -> Discretization:
        r"""The same surface with its points elsewhere: same border, mask and method.

        Args:
            points: new positions, `(n, d)`; switched-off ones stay where they are.
            normals: new unit normals; if None those of the tangents carried along by the motion,
                $n \propto F t_1 \times F t_2$ with F the gradient of the new positions on the
                surface as it was.
            search: finds the neighbours anew and adapts them, as `choose_neighbors` does, also in
                compiled code; from `Discretization.search`. If None they are the same as before.

        Returns:
            The moved surface. Its spacing, if it has one, is stretched with its area. A row for
            which a search has no room, in compiled code, keeps those it had; a code says so.

        Accuracy: normals as `gradient`, $O(h^p)$; of rotations and changes of scale to round-off
            (`tests/test_discretization.py::test_moved_surfaces_are_new_ones`). Neighbours found
            are those of `choose_neighbors` up to distances that round-off decides, where their
            code is 0 (`tests/test_renew.py`).
        Differentiable: forward and reverse, in the points and normals given and in those of the
            surface as it was; for fixed neighbours, or for those that a search finds.
        Raises:
            TypeError: a search that is none.
            ValueError: wrong shapes; on concrete arrays points that are not finite or coincide,
                that fold the surface, or that their lists do not serve. Under `jit`, `vmap` and
                `grad` see `code`.
        """
        points = as_float(points, "points", self.cloud.points.shape)
        if search is not None:
            instance(search, NeighborSearch, "search", "see Discretization.search")
        cloud = moved_cloud(self.cloud, points, normals, lambda: self.gradient)
        if search is None:
            found_at = self.cloud.points if self.found_at is None else self.found_at
            lists = (self.neighbors, self.method, self.border, jax.lax.stop_gradient(found_at))
            surface = Discretization(cloud, *lists, self.found)
        else:
            surface = self._renewed(cloud, search)
        if is_judged() and is_concrete(surface):
            surface.check()
        return surface

    def _renewed(self, cloud: PointCloud, search: NeighborSearch) -> Discretization:
        """The surface of another cloud of the same points, with neighbours of its own."""
        there = Discretization(cloud, self.neighbors, search.method, self.border)
        how = there._cut_at_once, is_judged()
        neighbors, found, made = renewed(search, cloud, self.neighbors, *how)
        # What has turned no list found anew would hold.
        found = jnp.where(folded(cloud, self.neighbors), 2, found)
        surface = Discretization(cloud, neighbors, search.method, self.border, found=found)
        vars(surface)["_kept"] = {"_built": made}
        return surface

    @Kept
    def code(self) -> Int[Array, " n"]:
        """What is wrong with each point: what would be an error outside `jit`, as a number.

        0: nothing. 1: its position or normal is not finite. 2: the normal of a neighbour next to it
        points to the other side. 3: its stencil is degenerate. 4: its list no longer reaches: since
        the list was found the surface was stretched so differently in different directions that a
        point outside may be less than half as far as one in it; or a search did not find enough
        neighbours as far as it looks. 5: more neighbours than a search has room for.
        """
        diagnostics = self.laplacian.diagnostics
        assert diagnostics is not None
        where = self.cloud, self.neighbors, self.found_at, self.found
        return jax.lax.stop_gradient(code_of(*where, diagnostics.residual))

    def check(self) -> None:
        """Raise a ValueError that names the first point of the least `code` above 0; not traced."""
        raise_for(np.asarray(self.code))


def discretize(
    cloud: PointCloud,
    neighbors: Neighbors | None = None,
    *,
    method: AbstractMethod = USUAL,
) -> Discretization:
    r"""A surface that can be calculated with: a cloud, its neighbours and a method.

    Args:
        cloud: n points in d dimensions with unit normals.
        neighbors: from `find_neighbors`; chosen by `choose_neighbors` if None (not under `jit`).
        method: how weights are computed.

    Returns:
        The surface, with its operators, curvatures and integrals.

    Accuracy: of each part as its own function has it; integrals see `Discretization.areas`. In
    float32 areas and interpolated values are within 1e-5 on 500 points, gradients of integrals in
    the points within 1 % (`tests/test_discretization.py`, `tests/test_forms.py`).
    Differentiable: forward and reverse, in points and normals, for fixed neighbours.
    Raises:
        TypeError: no cloud, neighbours or method.
        ValueError: as `choose_neighbors` and `find_border`; a traced cloud with a border.

    Example:
        >>> surface = js.discretize(js.sphere(1_000), method=js.GFDM(degree=4))
        >>> z = surface.cloud.points[:, 2]
        >>> bool(jnp.abs(surface.laplacian(z) + 2 * z).max() < 1e-3)
        True
        >>> bool(abs(surface.integrate(z**2) - 4 * jnp.pi / 3) < 1e-5)
        True
    """
    instance(cloud, PointCloud, "cloud")
    instance(method, AbstractMethod, "method", "GFDM(degree=4) or DCPSE(order=2), say")
    lists, weights = (neighbors, None) if neighbors is not None else weighed(cloud, method)
    lists = switched_on(cloud, checked_lists(lists))
    surface = Discretization(cloud, lists, method, marked_border(cloud))
    vars(surface)["_weights"] = weights if is_concrete(cloud) else None
    return surface
