"""What `test_mask.py` calls on clouds with and without rows that are switched off: a table."""

import warnings
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

import jaxsurf as js

from .helpers import jittered_sphere

# As many blocks of stencils either way: few programs are compiled twice.
N, ALL = 166, 249
ROWS = np.sort(np.random.default_rng(0).permutation(ALL)[:N])
ON = np.isin(np.arange(ALL), ROWS)
METHOD = js.GFDM(degree=2)


class Case(NamedTuple):
    """A cloud, and how what is known of its points is given to it.

    Args:
        cloud: with or without rows that are switched off.
        rows: of the N points.
    """

    cloud: js.PointCloud
    rows: np.ndarray

    def field(self, values):
        """Values of the points, and NaN elsewhere."""
        values = np.asarray(values)
        out = np.full((self.cloud.n, *values.shape[1:]), np.nan)
        out[self.rows] = values
        return jnp.asarray(out)

    def names(self, points):
        return self.rows[np.asarray(points)]

    def mask(self, values):
        out = np.zeros(self.cloud.n, bool)
        out[self.rows] = values
        return out

    @property
    def neighbors(self):
        return js.find_neighbors(self.cloud, min(METHOD.neighbor_count(self.cloud.dim), N))

    @property
    def laplacian(self):
        return js.laplace_beltrami(self.cloud, self.neighbors, method=METHOD)

    @property
    def gradient(self):
        return js.surface_gradient(self.cloud, self.neighbors, method=METHOD)

    @property
    def surface(self):
        return js.discretize(self.cloud, self.neighbors, method=METHOD)

    @property
    def u(self):
        return self.field(smooth(self.x))

    @property
    def x(self):
        """The points that are on."""
        return np.asarray(self.cloud.points)[self.rows]


def smooth(x):
    return np.sin(x[:, 0] + 2 * x[:, 1]) + x[:, -1]


def without(cloud: js.PointCloud) -> tuple[Case, Case]:
    """The cloud, and one that has it in some of its rows."""
    plain = Case(cloud, np.arange(cloud.n))
    if cloud.boundary is not None:
        boundary = np.ones(ALL, bool)
        boundary[ROWS] = np.asarray(cloud.boundary)
    spread = Case(js.PointCloud(np.zeros((ALL, cloud.dim)), np.eye(cloud.dim)[[0] * ALL]), ROWS)
    full = js.PointCloud(
        spread.field(cloud.points),
        spread.field(cloud.normals),
        boundary=None if cloud.boundary is None else boundary,
        active=ON,
    )
    return plain, Case(full, ROWS)


def ellipsoid():
    """No two modes alike, and points that serve every method."""
    x = np.asarray(jittered_sphere(N, fraction=0.1).points)
    axes = np.array([1.0, 1.25, 1.5])
    normals = x / axes
    return js.PointCloud(x * axes, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def cap():
    bowl = lambda s: (jnp.sin(s), -jnp.cos(s))
    found = js.surface_of_revolution(bowl, N)
    # As many points as asked for.
    inner = np.flatnonzero(~np.asarray(found.boundary))
    drop = inner[: found.n - N] if found.n > N else []
    keep = ~np.isin(np.arange(found.n), drop)
    return js.PointCloud(found.points[keep], found.normals[keep], boundary=found.boundary[keep])


CLOSED, OPEN = without(ellipsoid()), None


def opened():
    global OPEN
    OPEN = OPEN or without(cap())
    return OPEN


# --- the table: what is called on a case, and what of it is compared ------------------------------

# Round-off, amplified by operators; what linear solves leave; where the step sizes differ by
# round-off; preconditioners in single precision.
EXACT, SOLVED, LOOSE, SINGLE = 1e-9, 1e-7, 1e-5, 1e-4


class Row(NamedTuple):
    """Of the table.

    Args:
        call: of a case, to arrays with a row for each point, and others.
        rtol: relative to the largest value.
        zero: whether results are zero at points that are off.
        core: whether it is tried by default.
        open: whether on a surface with a border.
    """

    call: object
    rtol: float = EXACT
    zero: bool = True
    core: bool = False
    open: bool = False


def listed(c: Case, neighbors: js.Neighbors):
    """Lists by the names that points have without the others."""
    place = np.zeros(c.cloud.n, int)
    place[c.rows] = np.arange(len(c.rows))
    indices, mask = np.asarray(neighbors.indices)[c.rows], np.asarray(neighbors.mask)
    assert mask[c.rows].any() and not np.delete(mask, c.rows, axis=0).any()
    return np.where(mask[c.rows], place[indices], -1).astype(float)


def applied(operator, c: Case, u=None):
    return operator(c.u if u is None else u)


def velocity(c: Case):
    return c.field(np.cross(np.asarray(c.cloud.normals)[c.rows], c.x))


def tensor(c: Case):
    return c.field(np.eye(3) * (1.5 + smooth(c.x) ** 2)[:, None, None])


def given(c: Case):
    """A right-hand side of mean zero."""
    f = c.u
    return f - c.surface.mean(f)


def screened(c: Case):
    return c.field(1 + smooth(c.x) ** 2) - c.laplacian


def stencil_parts(c: Case):
    a, u = screened(c), jnp.where(jnp.isnan(c.u), 0, c.u)
    matrix = lambda operator: jnp.asarray(operator.to_scipy() @ np.asarray(u))
    return {
        "transpose": a.transpose()(c.u),
        "matrix": matrix(a),
        "transposed matrix": matrix(a.transpose()),
        "vector": c.gradient.transpose()(c.field(np.asarray(c.x))),
        "lineax": a.to_lineax().mv(u),
        "diagonal": jnp.where(jnp.isnan(a.diagonal), 0, a.diagonal),
    }


def saved(c: Case, tmp):
    c.laplacian.save(tmp / "stencil.npz")
    return js.Stencil.load(tmp / "stencil.npz")(c.u)


def discretized(c: Case):
    s = c.surface
    v = c.field(c.x)
    at = c.x[::7] * 1.001
    moved = s.moved(c.field(1.1 * c.x + 0.01 * c.x**2))
    return {
        "areas": s.areas,
        "integrate": s.integrate(v),
        "mean": s.mean(v),
        "inner": s.inner(v, v),
        "interpolate": s.interpolate(c.u, jnp.asarray(at)),
        "laplacian": s.laplacian(c.u),
        "gradient": s.gradient(c.u),
        "divergence": s.divergence(v),
        "biharmonic": s.biharmonic(c.u),
        "directional": s.directional_derivative(velocity(c))(c.u),
        "diffusion": s.diffusion(c.field(1 + smooth(c.x) ** 2))(c.u),
        "shape": s.shape_tensor,
        "mean curvature": s.mean_curvature,
        "expected error": s.expected_error,
        "gauss": s.gauss_curvature,
        "principal": s.principal_curvatures,
        "moved": moved.laplacian(c.u),
        "moved normals": moved.cloud.seen.normals * c.mask(True)[:, None],
        "code": moved.code.astype(float),
    }


def steady(c: Case, **options):
    found = js.solve(c.laplacian, given(c), rtol=1e-11, project=True, **options)
    return found.value, found.stats["incompatible"]


def nonlinear(c: Case):
    operator = -c.laplacian
    reaction = lambda u, a: a * u + u**3 + 1
    options = dict(args=2.0, rhs=c.u, rtol=1e-11)
    return js.solve_nonlinear(operator, reaction, c.field(np.zeros(len(c.rows))), **options).value


def modes(c: Case, k=5, **options):
    found = js.eigenmodes(js.laplace_beltrami(c.cloud, c.neighbors, method=METHOD), k, **options)
    return found.values, found.functions, found.groups.astype(float)


def searched(c: Case):
    points = c.cloud.points
    capacity = js.allocate_search(points, 0.8, active=c.cloud.active)
    options = dict(radius=0.8, capacity=capacity, normals=c.cloud.normals, active=c.cloud.active)
    neighbors, report = js.search_neighbors(points, **options)
    return listed(c, neighbors), np.array([capacity.k, report.k_needed], float)


def of_points(c: Case, values):
    """In place of those of the points, for what has no rows of others."""
    out = np.zeros((c.cloud.n, *np.shape(values)[1:]))
    out[c.rows] = values
    return out


def ordered(c: Case):
    tidy, order = js.sort_cloud(c.cloud)
    return np.asarray(tidy.points)[:N], smooth(np.asarray(c.cloud.points)[order[:N]])


def project(x):
    """Onto the ellipsoid, along the radius."""
    axes = jnp.array([1.0, 1.25, 1.5])
    x = x / jnp.linalg.norm(x / axes, axis=-1, keepdims=True)
    normals = x / axes**2
    return x, normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)


def jittered(c: Case):
    moved = js.jitter(c.cloud, project, spacing=0.1)
    return np.asarray(moved.points)[c.rows], np.asarray(moved.normals)[c.rows]


def refitted(c: Case):
    lists = js.find_neighbors(c.cloud, 30)
    found = js.refit_normals(c.cloud.points, c.cloud.normals, lists, degree=2)
    assert bool(jnp.isnan(jnp.delete(found, c.rows, axis=0)).all())  # keeps what is given
    return np.asarray(found)[c.rows]


def files(c: Case, tmp):
    found = []
    for kind in ("vtu", "ply", "vtk", "xyz"):
        path = tmp / f"cloud.{kind}"
        js.write(path, c.cloud, {} if kind == "xyz" else {"u": c.u})
        back = js.read(path)
        rows = c.rows if back.n == c.cloud.n else np.arange(N)
        found += [np.asarray(back.points)[rows], np.asarray(back.normals)[rows]]
        if kind != "xyz":
            assert back.n == c.cloud.n and (back.host_active == c.cloud.host_active).all()
            found.append(js.read_fields(path)["u"][rows])
    return found


def picture(c: Case, **kinds):
    from matplotlib import pyplot

    ax = js.plot_cloud(c.cloud, c.u, pixels=60)
    figure = js.plot_fields(c.cloud, {"u": c.u, "shape": None}, pixels=60)
    sheet = js.plot_series(c.cloud, [c.u, c.u], pixels=60)
    shown = (ax, *figure.axes, *sheet.axes)
    images = [np.asarray(a.images[0].get_array()) for a in shown if a.images]
    assert len(images) == 5
    pyplot.close("all")
    return images


# In time.

QUICK = dict(t1=0.02, dt0=0.005)


def evolved(c: Case, problem, u0=None, **options):
    u0 = c.u if u0 is None else u0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = js.integrate(problem, u0, **(QUICK | options))
    return jax.tree.map(lambda y: y[-1], found.ys)


def diffused(c: Case, **options):
    # A reaction that would move what is zero.
    react = lambda t, u, args: 1 - u**2
    d = c.field(1 + 0.5 * smooth(c.x) ** 2)
    problem = js.AdvectionDiffusionReaction(c.laplacian, diffusivity=d, reaction=react)
    return evolved(c, problem, **options)


def carried(c: Case):
    """Heat on a surface that grows and shears."""
    shear = lambda t, surface, fields, args: surface.cloud.points * surface.cloud.points[:, :1]
    heat = lambda surface: js.AdvectionDiffusionReaction(surface.laplacian)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = js.evolve(
            js.Motion(shear), c.surface, fields=c.u, problem=heat, solver=dfx.Heun(), **QUICK
        )
    surface, fields = found.rows[-1]
    return surface.cloud.points[c.rows], fields


def thinned(c: Case):
    """Sums over all points: those put into holes take the first rows that are free."""
    found = js.adapt_points(c.surface, js.Adaptation(0.25, hole=0.8), c.u)
    of_all = lambda x: jnp.sum(jnp.abs(x), axis=0)
    sums = of_all(found.surface.cloud.points), of_all(found.fields)
    return jnp.array([found.added, found.merged], float), *sums


def measured(c: Case):
    targets = np.array([[1.5, 0.0, 0.2], [0.0, -1.2, 0.4]])
    s, u = c.surface, c.u
    numbers = (
        js.volume(s),
        js.willmore_energy(s),
        js.moments(s),
        js.compliance(s, u),
        js.chamfer_distance(s, targets),
    )
    values = js.eigenvalues(s, 4)
    own = c.cloud.points[c.rows[:5]] * jnp.array([1.0, 1.02, 0.98])
    radii = js.medial_radius(s)[c.rows]
    return *numbers, values, js.tangent_point_energy(s), radii, js.signed_distance(s, own)


def adapted(c: Case, **options):
    problem = js.AdvectionDiffusionReaction(c.laplacian, reaction=lambda t, u, args: 1 - u)
    found = js.integrate(problem, c.u, t1=0.05, **options)
    return found.ys[-1], jnp.asarray(found.stats["num_accepted_steps"], float)


def advected(c: Case):
    moving = dict(gradient=c.gradient, velocity=velocity(c), mass=c.surface.areas)
    damping = js.hyperviscosity(c.laplacian, 1.0)
    problem = js.AdvectionDiffusionReaction(stabilization=damping, **moving)
    turning = moving | dict(velocity=lambda t: jnp.cos(t) * velocity(c), conservative=False)
    other = js.AdvectionDiffusionReaction(c.laplacian, **turning)
    options = dict(solver=dfx.Tsit5(), dt0=0.002, t1=0.004)
    return evolved(c, problem, **options), evolved(c, other, **options)


def parted(c: Case, tmp):
    problem = js.AdvectionDiffusionReaction(c.laplacian)
    path = js.Checkpoint(tmp / f"run{c.cloud.n}.npz", every=0.01)
    first = evolved(c, problem, checkpoint=path, dt0=None)
    return first, evolved(c, problem, checkpoint=path, dt0=None)


def stilled(c: Case):
    problem = js.AdvectionDiffusionReaction(c.laplacian, reaction=lambda t, u, a: -u)
    event = js.steady_state(rtol=0.0, atol=0.05)
    solver = js.RKC2(spectral_radius=300.0)
    found = js.integrate(problem, c.u, t1=50.0, dt0=0.05, solver=solver, event=event)
    return found.ts[-1:], found.ys[-1]


def stepped(c: Case):
    problem = js.AdvectionDiffusionReaction(c.laplacian, diffusivity=0.7)
    inverse = js.step_preconditioner(problem, c.u)
    solver = js.IMEX(order=2, preconditioner=inverse)
    u = jnp.where(jnp.isnan(c.u), 0, c.u)
    return evolved(c, problem, solver=solver), inverse(0.01).mv(u)


def estimated(c: Case):
    return np.array(js.spectral_estimate(c.laplacian)[:2])


def preconditioned(c: Case, make):
    inverse = make(screened(c))
    r = c.surface.integrate(c.u) * 0 + jnp.where(jnp.isnan(c.u), 0, c.u)
    return inverse(r), inverse.transpose()(r)


# With a border.


def unflowing(c: Case):
    return {"values": js.without_flux(c.surface)(c.u)[c.rows]}


def bounded(c: Case, kind=js.eliminate):
    border = c.cloud.boundary & c.cloud.host_active
    x = np.asarray(c.cloud.points)[np.asarray(border)]
    half = x[:, 0] > 0
    rim = np.flatnonzero(np.asarray(border))
    warm = js.robin(rim[half], jnp.asarray(x[half, 1]), a=1.0, b=0.5)
    cold = js.dirichlet(rim[~half], jnp.asarray(x[~half, 2]))
    return [warm, cold]


def closed(c: Case):
    closure = js.eliminate(c.cloud, bounded(c), neighbors=None, method=METHOD)
    u = jnp.where(jnp.isnan(c.u), 0, c.u)
    return {
        "values": closure(c.u)[c.rows],
        "linear": closure.homogeneous(c.u)[c.rows],
        "offset": closure.offset(),
        "solved": js.solve(screened(c), c.u, closure=closure, rtol=1e-11).value,
        "jacobi": js.jacobi(screened(c), closure=closure)(u),
        "in time": evolved(
            c,
            js.AdvectionDiffusionReaction(c.laplacian, closure=closure),
            solver=js.IMEX(order=2),
        ),
        "modes": modes(c, closure=closure)[:2],
    }


def mirrored(c: Case):
    border = c.cloud.boundary & c.cloud.host_active
    wide, closure = js.with_ghosts(c.cloud, js.neumann(border, 0.3), method=METHOD)
    ghosts = slice(c.cloud.n, None)
    operator = 1 - js.laplace_beltrami(wide, method=METHOD)
    rhs = closure.extend(c.u)
    found = js.solve(operator, rhs, closure=closure, rtol=1e-11).value
    return {
        "ghosts": wide.points[ghosts],
        "values": rhs[ghosts],
        "solved": found[c.rows],
        "beyond": found[ghosts],
        "off": found[: c.cloud.n],
    }


def marked(c: Case):
    border = js.find_border(c.cloud)
    place = np.zeros(c.cloud.n, int)
    place[c.rows] = np.arange(N)
    return {
        "order": place[np.asarray(border.points)].astype(float),
        "conormals": js.border_conormals(c.cloud),
        "detected": np.asarray(js.detect_boundary(c.cloud), float),
    }


def shore(c: Case):
    s = js.discretize(c.cloud, js.find_neighbors(c.cloud, 36), method=METHOD)
    return s.areas, s.mean(c.u)


L = js.laplace_beltrami
TABLE = {
    "laplace_beltrami": Row(lambda c: L(c.cloud, method=js.DCPSE(order=2))(c.u), core=True),
    "surface_gradient": Row(lambda c: js.surface_gradient(c.cloud, method=METHOD)(c.u), core=True),
    "surface_divergence": Row(
        lambda c: js.surface_divergence(c.cloud, method=METHOD)(c.field(c.x)), core=True
    ),
    "directional_derivative": Row(
        lambda c: js.directional_derivative(c.cloud, velocity(c), method=METHOD)(c.u)
    ),
    "diffusion": Row(
        lambda c: [
            js.diffusion(c.cloud, d, neighbors=c.neighbors, method=METHOD)(c.u)
            for d in (c.field(1 + smooth(c.x) ** 2), tensor(c))
        ],
        core=True,
    ),
    "biharmonic": Row(lambda c: js.biharmonic(c.cloud, c.neighbors, method=METHOD)(c.u)),
    "Stencil": Row(stencil_parts, core=True),
    "Composition": Row(lambda c: (c.laplacian @ screened(c)).transpose()(c.u), core=True),
    "Sum": Row(
        lambda c: (c.field(smooth(c.x)) * (c.laplacian @ screened(c)) - 2 * c.laplacian + c.u).T(
            c.u
        ),
        core=True,
    ),
    "shape_tensor": Row(lambda c: js.shape_tensor(c.cloud, method=METHOD), core=True),
    "mean_curvature": Row(lambda c: js.mean_curvature(c.cloud, method=METHOD), core=True),
    "gauss_curvature": Row(lambda c: js.gauss_curvature(c.cloud, method=METHOD), core=True),
    "principal_curvatures": Row(lambda c: js.principal_curvatures(c.cloud, method=METHOD)),
    "mean_curvature_vector": Row(lambda c: js.mean_curvature_vector(c.cloud, method=METHOD)),
    "tube_ratio": Row(lambda c: js.tube_ratio(c.cloud, c.neighbors), core=True),
    "find_neighbors": Row(lambda c: listed(c, c.neighbors), core=True),
    "choose_neighbors": Row(
        lambda c: listed(c, js.choose_neighbors(c.cloud, method=METHOD)), core=True
    ),
    "search_neighbors": Row(searched, core=True),
    "discretize": Row(discretized, core=True),
    "solve": Row(steady, SOLVED, core=True),
    "jacobi": Row(lambda c: preconditioned(c, js.jacobi), core=True),
    "multigrid": Row(lambda c: preconditioned(c, js.multigrid), SINGLE),
    "conservative_weights": Row(
        lambda c: js.conservative_weights(c.laplacian, c.surface.areas.sum()), SOLVED, core=True
    ),
    "solve_nonlinear": Row(nonlinear, SOLVED, core=True),
    "eigenmodes": Row(modes, SOLVED, core=True),
    "geodesic_distance": Row(
        lambda c: js.geodesic_distance(c.cloud, c.names([3, 70])), SOLVED, core=True
    ),
    "spectral_estimate": Row(estimated, SOLVED, core=True),
    "hyperviscosity": Row(lambda c: js.hyperviscosity(c.laplacian, 1.0)(c.u), SOLVED),
    "upwind_viscosity": Row(
        lambda c: js.upwind_viscosity(c.cloud, velocity(c), method=METHOD)(c.u)
    ),
    "refit_normals": Row(refitted),
    "sort_cloud": Row(ordered, core=True),
    "jitter": Row(jittered),
    "write": Row(files),
    "plot_cloud": Row(picture),
    "integrate": Row(lambda c: diffused(c, solver=dfx.Euler(), dt0=0.002), core=True),
    "RKC2": Row(lambda c: diffused(c, solver=js.RKC2(spectral_radius=300.0))),
    "AdamsBashforth2": Row(lambda c: diffused(c, solver=js.AdamsBashforth2(), dt0=0.002)),
    "IMEX": Row(lambda c: diffused(c, solver=js.IMEX(order=2)), SOLVED),
    "SDIRK": Row(lambda c: diffused(c, solver=js.SDIRK(order=3)), SOLVED),
    "controller": Row(lambda c: adapted(c, solver=dfx.Tsit5(), atol=0.0), SOLVED, core=True),
    "AdvectionDiffusionReaction": Row(advected),
    "evolve": Row(carried, SOLVED),
    "adapt_points": Row(thinned, SOLVED),
    "volume": Row(measured, SOLVED),
    "BiharmonicDiffusion": Row(
        lambda c: evolved(c, js.BiharmonicDiffusion(c.laplacian), solver=js.IMEX(order=2)), SOLVED
    ),
    "CahnHilliard": Row(
        lambda c: evolved(
            c, js.CahnHilliard(c.laplacian, width=0.2, mass=c.surface.areas), solver=js.IMEX()
        ),
        SOLVED,
    ),
    "WaveEquation": Row(
        lambda c: evolved(
            c, js.WaveEquation(c.laplacian, damping=0.1), (c.u, c.u), solver=dfx.Tsit5()
        )
    ),
    "step_preconditioner": Row(stepped, SINGLE),
    "Checkpoint": Row(parted, LOOSE),
    "steady_state": Row(stilled, LOOSE),
    "eliminate": Row(closed, SOLVED, open=True),
    "without_flux": Row(unflowing, open=True),
    "with_ghosts": Row(mirrored, SOLVED, open=True),
    "find_border": Row(marked, open=True),
    "Discretization": Row(shore, open=True),
}

# Tried with those of the table that they are named beside.
BESIDE = {
    "allocate_search": "search_neighbors", "SearchCapacity": "search_neighbors",
    "border_conormals": "find_border", "detect_boundary": "find_border", "Border": "find_border",
    "Closure": "eliminate", "Condition": "eliminate", "dirichlet": "eliminate",
    "robin": "eliminate", "neumann": "with_ghosts", "VCycle": "multigrid",
    "JacobiPreconditioner": "jacobi",
    "BiCGStab": "solve", "Modes": "eigenmodes", "Spectrum": "spectral_estimate",
    "plot_fields": "plot_cloud", "plot_series": "plot_cloud", "animate": "plot_cloud",
    "read": "write", "read_fields": "write",
    "GFDM": "surface_gradient", "RBFFD": "surface_gradient",
    "DCPSE": "laplace_beltrami", "Diagnostics": "laplace_beltrami",
    "PointCloud": "find_neighbors", "Neighbors": "find_neighbors",
    "AbstractOperator": "Stencil", "AbstractMethod": "laplace_beltrami",
    "AbstractPreconditioner": "jacobi", "AbstractEvolution": "integrate",
    "Motion": "evolve", "AbstractMotion": "evolve", "MeanCurvatureFlow": "evolve",
    "SurfaceDiffusionFlow": "evolve", "WillmoreFlow": "evolve", "Redistribution": "evolve",
    "Evolution": "evolve", "Adaptation": "adapt_points", "Adapted": "adapt_points",
    "Contact": "evolve",
    "willmore_energy": "volume", "moments": "volume",
    "compliance": "volume", "eigenvalues": "volume",
    "chamfer_distance": "volume", "tangent_point_energy": "volume", "medial_radius": "volume",
    "signed_distance": "volume",
}  # fmt: skip

# Take bare points, of which none can be switched off, or none at all.
EXEMPT = {
    "bare points": {"estimate_normals", "from_points", "partial_derivative", "FlatDCPSE"},
    "normals of one point each": {"tangent_frames"},
    "makes clouds, of which all points are on": {
        "circle", "double_torus", "ellipsoid", "graph", "level_set", "level_set_curvature",
        "level_set_normals", "poisson_disk", "project_to_level_set", "sphere",
        "surface_of_revolution", "torus",
    },
    "meshes": {"TriangleMesh", "clean_mesh", "sample_mesh"},
    "moves the points of a surface, as `moved` does": {
        "AbstractShape", "LevelSetShape", "MappedShape", "NormalShape", "rigid_motion",
        "star_shape", "spherical_harmonics", "optimize_shape", "ShapeOptimization", "LivePlot",
    },
    "takes any function": {"taylor_remainders", "TaylorRemainders", "solve_inverse", "Inversion"},
    "of any unknowns, fields or not": {"Posterior", "AbstractPrior", "GaussianPrior"},
    "compared in test_inverse.py, a third of the points off": {"MaternPrior"},
    "looks at the kind of a problem": {"choose_solver"},
    "an error": {"IntegrationError", "OptimizationError"},
    "names points that are on": {"free"},
    "compared in test_sobolev.py, a third of the points off": {"sobolev_gradient"},
    "compared in test_renew.py, a third of the points off": {"NeighborSearch"},
    "know no cloud: what is made with operators takes their mask": {"Diagonal", "identity"},
}  # fmt: skip
