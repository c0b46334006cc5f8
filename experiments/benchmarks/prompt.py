"""At the prompt: what a first call, the same call again, and a call with other values cost.

Every function in a process of its own, with nothing compiled and no cache on disk. What a user has
made before, the cloud and its operator, say, is made before the clock starts.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxsurf as js

from ..report import Row
from .timing import clock

N = 2_500
_FIRST, _ABOVE = 3.0, 20.0
# Going to the compiler and back: all that a call does beside its work.
_EVENTS = ("jaxpr_trace_duration", "jaxpr_to_mlir_module_duration", "backend_compile_duration")


class _Compiler:
    """Seconds spent in tracing and compiling, and the number of programs compiled."""

    def __init__(self):
        self.seconds, self.programs = 0.0, 0
        jax.monitoring.register_event_duration_secs_listener(self._note)

    def _note(self, event: str, seconds: float, **_):
        kind = event.rpartition("/")[2]
        if kind in _EVENTS:
            self.seconds += seconds
            self.programs += kind == "backend_compile_duration"


def stretched(cloud: js.PointCloud) -> js.PointCloud:
    """Another surface with as many points."""
    factors = jnp.array([1.1, 1.0, 0.9])[: cloud.points.shape[1]]
    normals = cloud.normals / factors
    normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    return js.PointCloud(cloud.points * factors, normals, boundary=cloud.boundary)


def _octahedron(levels: int) -> tuple[np.ndarray, np.ndarray]:
    """A sphere of triangles, each cut into four at each level: 1,026 vertices at level 4."""
    points = np.concatenate([np.eye(3), -np.eye(3)])
    corners = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2)]
    faces = np.array(corners + [(b, a, c + 3) for a, b, c in corners])
    for _ in range(levels):
        sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, place = np.unique(sides, axis=0, return_inverse=True)
        a, b, c = faces.T
        ab, bc, ca = (len(points) + place.reshape(-1, 3)).T
        faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        points = np.concatenate([points, points[edges].sum(axis=1)])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points, faces


def _written(path: Path, *what) -> Path:
    js.write(path, *what)
    return path


def _nothing(x, y):
    return 0.0 * x


def _peaks(s):
    return 1 + 0.1 * jnp.sin(3 * s), s


def _phi(x):
    return jnp.sum(x**2) - 1


def _closest(x):
    x = x / jnp.linalg.norm(x, axis=1, keepdims=True)
    return x, x


def _egg(a):
    return lambda x: jnp.sum(x**4) + a * x[0] * x[1] - 1


def _saddle(x, y):
    return 0.3 * x * y


def _cubic(t, u, args):
    return u - u**3


def _inflated(t, surface, fields, args):
    return args * surface.cloud.normals


def _stretched(t, surface, fields, args):
    return args * surface.cloud.points * jnp.array([0.5, -0.2, 0.0])


_TIMES = np.linspace(0.1, 2.0, 20)


def _decay(rate):
    return jnp.exp(-rate * _TIMES)


def _last(evolution):
    return evolution.clouds[-1].points


def _smoothed(transformation, g):
    return transformation.update(g, transformation.init(g))[0]


def _heat(surface):
    return js.AdvectionDiffusionReaction(surface.laplacian)


def _quartic(u):
    return jnp.sum(u**4)


def _reach(surface, a):
    return jnp.mean(surface.cloud.points**2) * a


def _scaled(x, a):
    return a * x


_SGD = optax.sgd(0.1)


class Made:
    """What calls need; each thing is made when it is first asked for."""

    def __init__(self, cloud: js.PointCloud, number: float):
        self.cloud, self.number = cloud, number
        self.u = jnp.asarray(np.sin(2 * np.asarray(cloud.points[:, 0])))

    def __getattr__(self, name):
        value = {
            "neighbors": lambda: js.choose_neighbors(self.cloud),
            "surface": lambda: js.discretize(self.cloud, self.neighbors, method=js.GFDM(degree=2)),
            "laplacian": lambda: js.laplace_beltrami(self.cloud),
            "gradient": lambda: js.surface_gradient(self.cloud),
            "conditions": lambda: js.dirichlet(self.cloud.boundary),
            "closure": lambda: js.eliminate(self.cloud, self.conditions),
            "preconditioner": lambda: js.multigrid(self.laplacian),
            "problem": lambda: js.AdvectionDiffusionReaction(
                self.laplacian, diffusivity=self.number
            ),
            # Once, with room for all that is searched.
            "capacity": lambda: js.allocate_search(js.sphere(N).points, 0.2),
            "mesh": lambda: js.TriangleMesh(*_octahedron(4)),
            "folder": lambda: Path(tempfile.mkdtemp()),
            "file": lambda: _written(self.folder / "a.xyz", self.cloud),
            "fields": lambda: _written(self.folder / "a.vtu", self.cloud, {"u": self.u}),
            "flat": lambda: js.graph(_nothing, N).points[:, :2] * self.number,
            "raw": lambda: np.asarray(self.cloud.points),
            "spin": lambda: jnp.cross(jnp.array([0.0, 0.0, 1.0]), self.cloud.points),
        }[name]()
        self.__dict__[name] = value
        return value


# Name: what has to be there before, and the call. `closed` and `open` are the surface.
CALLS: dict[str, tuple[str, str, Callable]] = {
    "ellipsoid": ("closed", "", lambda m: js.ellipsoid(N, (1.0, 0.8, 0.5 + m.number)).points),
    "torus": ("closed", "", lambda m: js.torus(N, 1.0, 0.4 * m.number).points),
    "level_set": (
        "closed",
        "",
        lambda m: js.level_set(
            _egg(m.number - 1), n=N, bounds=((-1.5,) * 3, (1.6,) * 3)
        ).points,
    ),
    "estimate_normals": ("closed", "", lambda m: js.estimate_normals(m.cloud.points)),
    "find_neighbors": ("closed", "", lambda m: js.find_neighbors(m.cloud, k=30).indices),
    "choose_neighbors": ("closed", "", lambda m: js.choose_neighbors(m.cloud).indices),
    "search_neighbors": (
        "closed",
        "capacity",
        lambda m: js.search_neighbors(
            m.cloud.points, radius=0.15 * m.number, capacity=m.capacity, throw=False
        )[0].indices,
    ),
    "laplace_beltrami": ("closed", "", lambda m: js.laplace_beltrami(m.cloud).weights),
    "laplace_beltrami, GFDM(degree=4)": (
        "closed",
        "",
        lambda m: js.laplace_beltrami(m.cloud, method=js.GFDM(degree=4)).weights,
    ),
    "surface_gradient": ("closed", "", lambda m: js.surface_gradient(m.cloud).weights),
    "surface_divergence": ("closed", "", lambda m: js.surface_divergence(m.cloud).weights),
    "diffusion": ("closed", "", lambda m: js.diffusion(m.cloud, 1 + m.u**2).weights),
    "mean_curvature": ("closed", "", lambda m: js.mean_curvature(m.cloud)),
    "principal_curvatures": ("closed", "", lambda m: js.principal_curvatures(m.cloud)),
    "refit_normals": (
        "closed",
        "neighbors",
        lambda m: js.refit_normals(m.cloud.points, m.cloud.normals, m.neighbors, degree=2),
    ),
    "areas": ("closed", "surface", lambda m: m.surface.areas),
    "interpolate": (
        "closed",
        "surface",
        lambda m: m.surface.interpolate(m.u, m.cloud.points[::2]),
    ),
    "moved": ("closed", "surface", lambda m: m.surface.moved(1.1 * m.cloud.points).laplacian),
    "moved, neighbours anew": (
        "closed",
        "surface",
        lambda m: m.surface.moved(1.1 * m.cloud.points, search=m.surface.search()).laplacian,
    ),
    "evolve": (
        "closed",
        "surface",
        lambda m: _last(js.evolve(js.Motion(_inflated), m.surface, t1=0.1, args=m.number)),
    ),
    "evolve, neighbours anew": (
        "closed",
        "surface",
        lambda m: _last(js.evolve(js.Motion(_stretched), m.surface, t1=1.0, args=m.number)),
    ),
    "evolve, heat": (
        "closed",
        "surface",
        lambda m: js.evolve(
            js.Motion(_inflated), m.surface, t1=0.01, fields=m.u, problem=_heat, args=m.number
        ).fields[-1],
    ),
    "evolve, MeanCurvatureFlow": (
        "closed",
        "surface",
        lambda m: _last(js.evolve(js.MeanCurvatureFlow(), m.surface, t1=0.01 * m.number)),
    ),
    "adapt_points": (
        "closed",
        "surface",
        lambda m: js.adapt_points(m.surface, js.Adaptation(0.05 * m.number), m.u).fields,
    ),
    "volume": ("closed", "surface", lambda m: js.volume(m.surface)),
    "willmore_energy": ("closed", "surface", lambda m: js.willmore_energy(m.surface)),
    "moments": ("closed", "surface", lambda m: js.moments(m.surface)),
    "eigenvalues": ("closed", "surface", lambda m: js.eigenvalues(m.surface, 6)),
    "compliance": ("closed", "surface", lambda m: js.compliance(m.surface, m.u)),
    "chamfer_distance": (
        "closed",
        "surface",
        lambda m: js.chamfer_distance(m.surface, 1.1 * m.cloud.points[::2]),
    ),
    "signed_distance": (
        "closed",
        "surface",
        lambda m: js.signed_distance(m.surface, 1.01 * m.cloud.points[::2]),
    ),
    "tangent_point_energy": ("closed", "surface", lambda m: js.tangent_point_energy(m.surface)),
    "medial_radius": ("closed", "surface", lambda m: js.medial_radius(m.surface)),
    "sobolev_gradient": (
        "closed",
        "surface",
        lambda m: _smoothed(js.sobolev_gradient(m.surface, m.number), m.u),
    ),
    "star_shape": (
        "closed",
        "surface",
        lambda m: js.star_shape(m.surface, 2)(m.number * np.eye(9)[0]).cloud.points,
    ),
    "optimize_shape": (
        "closed",
        "surface",
        lambda m: (
            js.optimize_shape(
                _reach, js.MappedShape(_scaled, m.surface), jnp.array(m.number), optimizer=_SGD,
                args=(jnp.array(m.number),), steps=3,
            ).theta
        ),
    ),
    "solve_inverse": (
        "closed",
        "laplacian",
        lambda m: (
            js.solve_inverse(
                _decay, jnp.array(0.5), jnp.exp(-m.number * _TIMES), noise=0.1
            ).theta
        ),
    ),
    "rigid_motion": (
        "closed",
        "",
        lambda m: js.rigid_motion(m.cloud.points[0], (m.number * jnp.ones(3), jnp.ones(3))),
    ),
    "spherical_harmonics": ("closed", "", lambda m: js.spherical_harmonics(m.cloud.normals, 4)),
    "taylor_remainders": (
        "closed",
        "",
        lambda m: js.taylor_remainders(_quartic, m.u, m.number * jnp.cos(m.u)).slope,
    ),
    "conservative_weights": (
        "closed",
        "laplacian",
        lambda m: js.conservative_weights(m.laplacian, m.number),
    ),
    "L(u)": ("closed", "laplacian", lambda m: m.laplacian(m.u)),
    "G(u)": ("closed", "gradient", lambda m: m.gradient(m.u)),
    "spectral_estimate": (
        "closed",
        "laplacian",
        lambda m: js.spectral_estimate(m.laplacian).radius,
    ),
    "multigrid": ("closed", "laplacian", lambda m: js.multigrid(m.laplacian)),
    "solve": ("closed", "laplacian", lambda m: js.solve(m.laplacian, m.laplacian(m.u)).value),
    "solve, Dirichlet": (
        "open",
        "laplacian closure",
        lambda m: js.solve(m.laplacian, m.u, closure=m.closure).value,
    ),
    "eliminate": ("open", "conditions", lambda m: js.eliminate(m.cloud, m.conditions)),
    "without_flux": ("open", "surface", lambda m: js.without_flux(m.surface)),
    "with_ghosts": ("open", "", lambda m: js.with_ghosts(m.cloud, js.neumann(m.cloud.boundary))),
    "solve_nonlinear": (
        "closed",
        "laplacian",
        lambda m: js.solve_nonlinear(m.laplacian, _nonlinear, m.u, args=m.number).value,
    ),
    "eigenmodes": ("closed", "laplacian", lambda m: js.eigenmodes(m.laplacian, 6).values),
    "geodesic_distance": (
        "closed",
        "neighbors",
        lambda m: js.geodesic_distance(m.cloud, np.array([int(7 * m.number)])),
    ),
    "integrate": (
        "closed",
        "problem",
        lambda m: js.integrate(m.problem, m.u, t1=0.05 * m.number, rtol=1e-4 * m.number).ys,
    ),
    "integrate, IMEX": (
        "closed",
        "laplacian",
        lambda m: (
            js.integrate(
                js.AdvectionDiffusionReaction(
                    m.laplacian, diffusivity=m.number, reaction=_cubic
                ),
                m.u,
                t1=0.05 * m.number,
                solver=js.IMEX(order=3),
                dt0=0.005,
            ).ys
        ),
    ),
    "hyperviscosity": (
        "closed",
        "laplacian",
        lambda m: js.hyperviscosity(m.laplacian, 1.0 * m.number)(m.u),
    ),
    "upwind_viscosity": ("closed", "spin", lambda m: js.upwind_viscosity(m.cloud, m.spin).weights),
    "circle": ("closed", "", lambda m: js.circle(N, radius=m.number).points),
    "double_torus": ("closed", "", lambda m: js.double_torus()[1]),
    "surface_of_revolution": ("closed", "", lambda m: js.surface_of_revolution(_peaks, N).points),
    "graph": ("closed", "", lambda m: js.graph(_saddle, N).points),
    "project_to_level_set": (
        "closed",
        "",
        lambda m: js.project_to_level_set(_phi, 1.1 * m.cloud.points),
    ),
    "level_set_normals": ("closed", "", lambda m: js.level_set_normals(_phi, m.cloud.points)),
    "level_set_curvature": ("closed", "", lambda m: js.level_set_curvature(_phi, m.cloud.points)),
    "sample_mesh": ("closed", "mesh", lambda m: js.sample_mesh(m.mesh, n=N, seed=int(m.number))),
    "clean_mesh": ("closed", "mesh", lambda m: js.clean_mesh(*_octahedron(4))[0].vertices),
    "sort_cloud": ("closed", "", lambda m: js.sort_cloud(m.cloud)[1]),
    "jitter": ("closed", "", lambda m: js.jitter(m.cloud, _closest, spacing=0.07 * m.number)),
    "poisson_disk": ("closed", "", lambda m: js.poisson_disk(m.cloud.points, 0.1 * m.number)),
    "read": ("closed", "file", lambda m: js.read(m.file).points),
    "read_fields": ("closed", "fields", lambda m: js.read_fields(m.fields)["u"]),
    "write": ("closed", "folder", lambda m: js.write(m.folder / "b.vtu", m.cloud)),
    "plot_cloud": ("closed", "folder", lambda m: js.plot_cloud(m.cloud, m.u) and None),
    "plot_fields": ("closed", "folder", lambda m: js.plot_fields(m.cloud, {"u": m.u}) and None),
    "plot_series": ("closed", "folder", lambda m: js.plot_series(m.cloud, [m.u]) and None),
    "animate": ("closed", "folder", lambda m: js.animate(m.folder / "b.gif", m.cloud, [m.u])),
    "from_points": ("closed", "raw", lambda m: js.from_points(m.raw)),
    "tangent_frames": ("closed", "", lambda m: js.tangent_frames(m.cloud.normals)),
    "tube_ratio": ("closed", "neighbors", lambda m: js.tube_ratio(m.cloud, m.neighbors)),
    "allocate_search": (
        "closed",
        "",
        lambda m: js.allocate_search(m.cloud.points, 0.2 * m.number).candidates,
    ),
    "discretize": ("closed", "", lambda m: js.discretize(m.cloud).laplacian.weights),
    "biharmonic": ("closed", "", lambda m: js.biharmonic(m.cloud)(m.u)),
    "partial_derivative": (
        "closed",
        "flat",
        lambda m: js.partial_derivative(m.flat, (1, 0)).weights,
    ),
    "directional_derivative": (
        "closed",
        "spin",
        lambda m: js.directional_derivative(m.cloud, m.spin).weights,
    ),
    "gauss_curvature": ("closed", "", lambda m: js.gauss_curvature(m.cloud)),
    "mean_curvature_vector": ("closed", "", lambda m: js.mean_curvature_vector(m.cloud)),
    "shape_tensor": ("closed", "", lambda m: js.shape_tensor(m.cloud)),
    "identity": ("closed", "", lambda m: js.identity(N)(m.u)),
    "jacobi": ("closed", "laplacian", lambda m: js.jacobi(m.laplacian - 1)(m.u)),
    "detect_boundary": ("open", "", lambda m: js.detect_boundary(m.cloud)),
    "find_border": ("open", "", lambda m: js.find_border(m.cloud).points),
    "border_conormals": ("open", "", lambda m: js.border_conormals(m.cloud)),
    "robin": ("open", "", lambda m: js.robin(m.cloud.boundary, m.number, a=1.0, b=1.0).where),
    "dirichlet": ("open", "", lambda m: js.dirichlet(m.cloud.boundary, m.number).where),
    "free": ("open", "", lambda m: js.free(m.cloud.boundary).where),
    "choose_solver": ("closed", "problem", lambda m: js.choose_solver(m.problem) and None),
    "step_preconditioner": (
        "closed",
        "problem",
        lambda m: js.step_preconditioner(m.problem, m.u)(0.1 * m.number).mv(m.u),
    ),
    "steady_state": (
        "closed",
        "problem",
        lambda m: js.integrate(
            m.problem, 1 + m.cloud.points[:, 2], t1=1e3, event=js.steady_state(rtol=1e-3 * m.number)
        ).ys,
    ),
    "integrate, SDIRK": (
        "closed",
        "problem",
        lambda m: js.integrate(
            m.problem, m.u, t1=0.05 * m.number, solver=js.SDIRK(order=3), dt0=0.01
        ).ys,
    ),
    "integrate, waves": (
        "closed",
        "laplacian",
        lambda m: js.integrate(
            js.WaveEquation(m.laplacian, speed=m.number), (m.u, 0 * m.u), t1=0.05
        ).ys,
    ),
    "integrate, Cahn-Hilliard": (
        "closed",
        "laplacian",
        lambda m: js.integrate(
            js.CahnHilliard(m.laplacian, width=0.3 * m.number), 0.1 * m.u, t1=1e-3, dt0=5e-4,
            solver=js.IMEX(order=3),
        ).ys,
    ),
    "integrate, biharmonic": (
        "closed",
        "laplacian",
        lambda m: js.integrate(
            js.BiharmonicDiffusion(m.laplacian, stiffness=m.number), m.u, t1=1e-3, dt0=5e-4,
            solver=js.SDIRK(order=3),
        ).ys,
    ),
}  # fmt: skip


def _nonlinear(u, args):
    return -u - args * u**3


def before(name: str, n: int) -> tuple[Callable, Made, Made]:
    """A call and what it needs, also for another surface and other numbers."""
    surface, needs, call = CALLS[name]
    cloud = js.sphere(n) if surface == "closed" else js.graph(_saddle, n)
    clouds = [cloud, stretched(cloud)]
    if surface == "open":  # the same points, of the same border
        clouds = [cloud, js.PointCloud(1.1 * cloud.points, cloud.normals, boundary=cloud.boundary)]
    made, other = (Made(c, number) for c, number in zip(clouds, (1.0, 1.1)))
    for need in needs.split():
        jax.block_until_ready((getattr(made, need), getattr(other, need)))
    return call, made, other


def one(name: str, n: int) -> dict:
    """First call, five more, and one with another surface and other numbers."""
    call, made, other = before(name, n)
    compiler = _Compiler()
    first = clock(lambda: call(made))
    programs = compiler.programs
    again, above = [], []
    for _ in range(5):
        spent = compiler.seconds
        again.append(clock(lambda: call(made)))
        above.append(min(again[-1], compiler.seconds - spent))
    repeated = compiler.programs - programs
    new = clock(lambda: call(other))
    return {"first s": first, "again s": statistics.median(again),
            "above ms": 1e3 * statistics.median(above), "programs": programs,
            "programs again": repeated, "new s": new,
            "programs new": compiler.programs - programs - repeated}  # fmt: skip


def plan(quick: bool) -> list[tuple[str, list]]:
    n = 500 if quick else N
    todo: list[tuple[str, list]] = [("prompt.one", [name, n]) for name in CALLS]
    return (
        todo
        if quick
        else [*todo, ("prompt.one", ["L(u)", 10_000]), ("prompt.one", ["G(u)", 10_000])]
    )


def rows(results: list[dict]) -> list[Row]:
    """The bounds that all of it must keep."""
    found = []
    for r in results:
        (name, n), v = r["arguments"], r["result"]
        setting = {"call": name, "n": n}
        found += [
            Row("first call, s", v["first s"], setting, bound=_FIRST),
            Row("again, s", v["again s"], setting),
            Row("again: tracing and compiling, ms", v["above ms"], setting, bound=_ABOVE),
            Row("again: programs compiled", v["programs again"], setting, bound=0),
            Row("other values, s", v["new s"], setting),
            Row("other values: programs compiled", v["programs new"], setting, bound=0),
        ]
    return found
