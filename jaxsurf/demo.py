r"""The main job from end to end: a surface, its curvature, heat on it, and a gradient.

What `jaxsurf demo` computes, and the notebook after it; the command line only prints it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from .borders.detect import detect_boundary
from .boundary import Closure
from .cloud import PointCloud
from .conditions import dirichlet
from .curvature import shape_tensor
from .failures import warn
from .formats.by_suffix import contents_of
from .heat import Heat, carried, cell_areas, diffuse, spot
from .io import read, write
from .neighbors import Neighbors
from .onesided import eliminate
from .operators import laplace_beltrami
from .plot import plot_fields
from .shapes.implicit import level_set_normals, project_to_level_set
from .shapes.level_sets import double_torus, level_set
from .spectrum import Spectrum, spectral_estimate
from .stages import noted, timed
from .stencils.method import AbstractMethod
from .stencils.stencil import Stencil

STAGES = ("points", "operator", "spectrum", "curvature", "heat", "files")


class Surface(NamedTuple):
    """A cloud that depends on one number, for the gradient.

    Args:
        cloud: the surface as sampled.
        title: in words.
        parameter: what is varied, in words, and its value in `cloud`.
        moved: the cloud with the same points, for another value; differentiable.
        up: axis that points up in pictures.
        view: direction from the surface to the viewer.
    """

    cloud: PointCloud
    title: str
    parameter: tuple[str, float]
    moved: Callable[[Float[Array, ""]], PointCloud]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    view: tuple[float, float, float] = (0.7, -1.7, 1.3)

    @property
    def size(self) -> float:
        """Longest side of the box around the points."""
        return float(np.ptp(np.asarray(self.cloud.points), axis=0).max())


def built_in_surface(n: int = 10_000, *, thickness: float = 0.4) -> Surface:
    """A smooth surface of genus two, sampled on its level set; the tubes' thickness varies."""
    phi, bounds = double_torus(thickness)
    cloud = level_set(phi, n=n, bounds=bounds)
    title = f"double torus, tubes of radius {thickness:g} (built in)"
    moved = jax.tree_util.Partial(_thickened, cloud)
    return Surface(cloud, title, ("thickness of the tubes", thickness), moved)


@jax.jit
def _thickened(cloud: PointCloud, thickness: float | Float[Array, ""]) -> PointCloud:
    """The chosen points carried along to tubes of another thickness."""
    phi = double_torus(thickness)[0]
    points = project_to_level_set(phi, cloud.points)
    return PointCloud(points, level_set_normals(phi, points))


def surface_from_file(
    path: str | Path,
    n: int | Literal["all"] | None = None,
    *,
    smooth: bool = True,
    largest_part: bool = False,
    border: bool = False,
) -> Surface:
    """A mesh resampled to n points, or a file's own points.

    The size of the whole varies.

    Args:
        n: "all" for the file's own; None for 10,000 of a mesh and all of what has no triangles.
        smooth, largest_part: for `read`, which states in warnings what it converts.
        border: for points without triangles: those that `detect_boundary` names are the border.

    Raises:
        ValueError: a number of points to resample what has no triangles; a border asked for of
            triangles, which tell theirs, or where there is none.
    """
    has_triangles = bool(contents_of(path).faces)
    if isinstance(n, int) and not has_triangles:
        raise ValueError(f"{path}: no triangles to sample {n} points on, leave the number out")
    resampled = has_triangles and n != "all"
    count = (n or 10_000) if resampled else None
    cloud = read(path, n=count, smooth=smooth, largest_part=largest_part)  # type: ignore[arg-type]
    if border:
        if has_triangles:
            raise ValueError(f"{path}: triangles tell where the border is, leave `border` out")
        found = detect_boundary(cloud)
        if not found.any():
            raise ValueError(f"{path}: no point looks like a border point, leave `border` out")
        cloud = PointCloud(cloud.points, cloud.normals, boundary=found)
    own = "resampled evenly" if resampled else "its own points"
    moved = jax.tree_util.Partial(_scaled, cloud)
    # Scans are usually stored with y up.
    up, view = (0.0, 1.0, 0.0), (0.5, 0.5, 1.7)
    title = f"{Path(path).name} ({own})"
    return Surface(cloud, title, ("scale of all points", 1.0), moved, up, view)


def _scaled(cloud: PointCloud, scale: float | Float[Array, ""]) -> PointCloud:
    return eqx.tree_at(lambda c: c.points, cloud, scale * cloud.points)


def central_point(surface: Surface) -> int:
    """The point in the middle of the picture, of those away from the border, which is held."""
    border = surface.cloud.boundary
    points = np.asarray(surface.cloud.points)
    points = points - points.mean(axis=0)
    view = np.resize(surface.view, points.shape[1])
    height = points @ view / np.linalg.norm(view)
    aside = np.sqrt(np.maximum(np.sum(points**2, axis=1) - height**2, 0))
    central = height - 3 * aside
    if border is not None and border.any():
        away = cKDTree(points[np.asarray(border)]).query(points)[0]
        central = np.where(away >= min(surface.size / 3, away.max()), central, -np.inf)
    return int(np.argmax(central))


# --- the whole -----------------------------------------------------------------------------


@dataclass
class Demo:
    """Everything the report says."""

    surface: Surface
    method: AbstractMethod
    laplacian: Stencil
    spectrum: Spectrum
    curvature: dict[str, Float[Array, " n"]]
    heat: Heat
    temperature: Float[Array, "frames n"]
    uncorrected: Float[Array, "frames n"]
    areas: Float[Array, " n"]
    source: int
    probe: int
    sensitivity: Float[Array, " n"]
    gradient: float
    difference: float
    notes: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    seconds: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def lost(self) -> float:
        """Relative change of the heat on the whole surface from first to last."""
        return _change(self.temperature @ self.areas)

    @property
    def lost_uncorrected(self) -> float:
        """The same by the operator alone."""
        return _change(self.uncorrected @ self.areas)

    @property
    def disagreement(self) -> float:
        """Relative difference of the gradient and the central difference."""
        return abs(self.gradient - self.difference) / max(abs(self.difference), 1e-300)

    @property
    def peaks(self) -> Float[np.ndarray, " frames"]:
        """Largest |u| at each frame."""
        return np.asarray(jnp.max(jnp.abs(self.temperature), axis=1))

    @property
    def stable(self) -> bool:
        """True if the largest |u| never grew."""
        return bool(np.all(np.diff(self.peaks) <= 1e-6 * self.peaks[0]))


def run(
    sample: Callable[[], Surface],
    *,
    method: AbstractMethod,
    out: Path,
    until: float | None = None,
    tell: Callable[[str], None] = lambda stage: None,
) -> Demo:
    """The main job: one pass through all `STAGES`.

    Args:
        sample: makes the surface.
        method: of all operators.
        out: folder for the picture and the ParaView file; made if absent.
        until: final time of the heat; size²/100, rounded, if None.
        tell: called with the name of each stage as it begins.

    Raises:
        ValueError, OSError, ImportError: as the functions of the package used here.
    """
    if until is not None and not until > 0:
        raise ValueError(f"time = {until}, expected a positive number")
    out.mkdir(parents=True, exist_ok=True)
    seconds: dict[str, tuple[float, float]] = {}
    notes: list[str] = []

    @contextmanager
    def stage(name: str):
        tell(name)
        with timed() as spent, noted(notes):
            yield
        seconds[name] = spent()

    with stage("points"):
        surface = sample()
        cloud = surface.cloud
    with stage("operator"):
        laplacian = laplace_beltrami(cloud, method=method)
        neighbors = _lists(laplacian)
        closure = _held_at_border(cloud)
    with stage("spectrum"):
        at_rest = _at_rest_on_border(laplacian)
        spectrum = spectral_estimate(at_rest)
    with stage("curvature"):
        curvature = jax.block_until_ready(_curvature(cloud, neighbors, method))
    with stage("heat"):
        areas = cell_areas(cloud, neighbors)
        source = central_point(surface)
        start = spot(cloud, source, surface.size / 16)
        end = until or _rounded(surface.size**2 / 100)
        heat = Heat.within(end, at_rest, float(spectrum.radius))
        probe = _probe(cloud, source, float(np.sqrt(2 * heat.until)))
        reading = _reading(cloud, areas, probe, surface.size / 16)
        # One program for heat, gradient and difference: another takes longer to compile than it
        # saves.
        value = jnp.asarray(surface.parameter[1], start.dtype)
        at = lambda value: _with_gradient(
            value,
            start,
            (cloud, surface.moved),
            areas,
            neighbors,
            method,
            closure,
            heat,
            reading,
        )
        try:
            (_, temperature), (gradient, sensitivity) = at(value)
        except eqx.EquinoxRuntimeError as error:
            raise ValueError(
                f"heat cannot be followed to t = {end:g}: eigenvalues of the operator have real "
                f"parts up to {float(spectrum.abscissa):.3g}. {'; '.join(notes)}"
            ) from error
        step = 1e-4 * value
        above, below = (at(value + h)[0][0] for h in (step, -step))
        difference = (above - below) / (2 * step)
        # What the correction by the areas hides.
        uncorrected = temperature if closure else diffuse(laplacian, None, start, heat)
    demo = Demo(
        surface,
        method,
        laplacian,
        spectrum,
        curvature,
        heat,
        temperature,
        uncorrected,
        areas,
        source,
        probe,
        sensitivity / areas,
        float(gradient),
        float(difference),
        seconds=seconds,
    )
    with stage("files"):
        demo.files = save(demo, out)
    demo.notes = list(dict.fromkeys(notes))
    return demo


# A gradient further than this from the difference quotient is wrong.
_AGREE = 1e-4


def healthy(demo: Demo) -> bool:
    """True if the heat never grew and the gradient is that of the difference quotient."""
    return demo.stable and demo.disagreement <= _AGREE


def save(demo: Demo, out: Path) -> list[Path]:
    """The picture and the ParaView file; a warning for what a missing package prevents."""
    files, cloud, t = [], demo.surface.cloud, demo.heat.frames
    if find_spec("matplotlib") is None:
        warn("no picture: pip install 'jaxsurf[pictures]'")
    else:
        panels = {f"{name} curvature": values for name, values in demo.curvature.items()}
        panels["sensitivity of the probe to heat at t = 0"] = demo.sensitivity
        panels |= {f"heat at t = {s:.3g}": u for s, u in zip(t, demo.temperature)}
        files.append(out / "demo.png")
        plot_fields(cloud, panels, path=files[-1], view=demo.surface.view, up=demo.surface.up)
    if find_spec("meshio") is None:
        warn("no file for ParaView: pip install 'jaxsurf[files]'")
    else:
        fields = {f"{name}_curvature": values for name, values in demo.curvature.items()}
        fields |= {f"heat_{i}": u for i, u in enumerate(demo.temperature)}
        fields |= {"sensitivity": demo.sensitivity, "area": demo.areas}
        if demo.laplacian.diagnostics is not None:
            fields["tube"] = demo.laplacian.diagnostics.tube
        files.append(out / "demo.vtu")
        write(files[-1], cloud, fields)
    return files


def _temperature_at(value, start, surface, areas, neighbors, method, closure, heat, reading):
    """What the probe reads in the end for a value of the surface's parameter; and temperatures."""
    cloud, moved = surface
    at = moved(value)
    laplacian = laplace_beltrami(at, neighbors, method=method)
    kept = carried(areas, cloud, at, neighbors) if closure is None else None
    temperature = diffuse(laplacian, closure, start, heat, kept)
    return temperature[-1] @ reading, temperature


# Everything large is an argument: arrays that a compiled function closes over are folded.
_with_gradient = eqx.filter_jit(jax.value_and_grad(_temperature_at, argnums=(0, 1), has_aux=True))


def _lists(operator: Stencil) -> Neighbors:
    """The neighbours that an operator was built on: a padded slot repeats its own point."""
    slots = operator.indices.T
    return Neighbors(slots, (slots != slots[:, :1]).at[:, 0].set(True))


def _held_at_border(cloud: PointCloud) -> Closure | None:
    """Border points keep their temperature: without it the problem is not well posed."""
    border = cloud.boundary
    if border is None or not border.any():
        return None
    return eliminate(cloud, dirichlet(border, jnp.zeros(int(border.sum()), cloud.points.dtype)))


def _at_rest_on_border(laplacian: Stencil) -> Stencil:
    border = laplacian.border
    return laplacian if border is None else (1.0 - border) * laplacian


def _curvature(cloud, neighbors, method) -> dict[str, Float[Array, " n"]]:
    """All from one shape tensor, as its stencils are the dearest part."""
    tensor = shape_tensor(cloud, neighbors, method=method)
    trace = jnp.trace(tensor, axis1=1, axis2=2)
    if cloud.dim == 2:
        return {"curve": trace}
    return {"mean": trace / 2, "Gauss": (trace**2 - jnp.sum(tensor**2, axis=(1, 2))) / 2}


def _probe(cloud: PointCloud, source: int, distance: float) -> int:
    """A point at about that distance from the source, on its side of the surface."""
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    off = np.abs(np.linalg.norm(points - points[source], axis=1) - distance)
    if cloud.boundary is not None:
        off = np.where(np.asarray(cloud.boundary), np.inf, off)
    return int(np.argmin(np.where(normals @ normals[source] > 0, off, np.inf)))


def _reading(cloud, areas, probe: int, width: float) -> Float[Array, " n"]:
    """Weights of a mean about a point, on its side of the surface.

    The steps damp what is rough only little: read at one point, the sensitivity has rings about it.
    """
    facing = cloud.normals @ cloud.normals[probe] > 0
    weights = jnp.where(facing, areas * spot(cloud, probe, width), 0)
    return weights / jnp.sum(weights)


def _change(content: Float[Array, " frames"]) -> float:
    return float(abs(content[-1] / content[0] - 1))


def _rounded(value: float) -> float:
    return float(f"{value:.1g}")
