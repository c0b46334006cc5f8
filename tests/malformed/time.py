"""Problems in time, solvers, integration."""

import functools
import tempfile
import warnings
from pathlib import Path

import diffrax as dfx
import jax.numpy as jnp
import lineax as lx
import numpy as np

import jaxsurf as js

from ..helpers import ring
from . import Case

N = 12


@functools.cache
def parts():
    return ring(N)


def laplacian():
    return parts()[1]


def gradient():
    return parts()[2]


def heat(**settings):
    return js.AdvectionDiffusionReaction(laplacian(), **settings)


def moved(**settings):
    normals = js.circle(N).normals
    along = jnp.stack([-normals[:, 1], normals[:, 0]], axis=1)
    settings = dict(gradient=gradient(), velocity=along) | settings
    return js.AdvectionDiffusionReaction(**settings)


def wave(**settings):
    return js.WaveEquation(laplacian(), **settings)


U = np.linspace(0.0, 1.0, N)


def integrate(problem=None, u0=U, t1=1.0, **settings):
    return js.integrate(heat() if problem is None else problem, u0, t1=t1, **settings)


def closure(n=N):
    cloud = js.circle(n)
    return js.eliminate(cloud, js.dirichlet(jnp.arange(n) < 2, 0.0))


def case(function, label, call, *words, right=None):
    return Case(function, label, call, words, right)


def bad_file(content):
    path = Path(tempfile.mkdtemp()) / "run.npz"
    path.write_bytes(content)
    return integrate(checkpoint=js.Checkpoint(path, every=0.5))


def single(array):
    return jnp.asarray(array, jnp.float32)


def quiet(call):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return call()


nan, inf = float("nan"), float("inf")

INTEGRATE = [
    case("integrate", "a bare operator", lambda: js.integrate(laplacian(), U, t1=1.0),
         "problem", "Stencil", "Evolution"),
    case("integrate", "an array as problem", lambda: js.integrate(np.eye(N), U, t1=1.0),
         "problem", "(12, 12)", "Evolution"),
    case("integrate", "a function as problem", lambda: js.integrate(lambda u: u, U, t1=1.0),
         "problem", "function"),
    case("integrate", "problem None", lambda: js.integrate(None, U, t1=1.0), "problem", "None"),
    case("integrate", "u0 a list", lambda: integrate(u0=list(U)), "u0", "list", "array (12, ...)"),
    case("integrate", "u0 a number", lambda: integrate(u0=1.0), "u0", "float", "array (12, ...)"),
    case("integrate", "u0 None", lambda: integrate(u0=None), "u0", "None"),
    case("integrate", "u0 text", lambda: integrate(u0="u"), "u0", "str"),
    case("integrate", "u0 a pair for a single field", lambda: integrate(u0=(U, U)), "u0", "tuple"),
    case("integrate", "u0 of another length", lambda: integrate(u0=U[:5]), "u0", "(5,)", "(12,)"),
    case("integrate", "u0 transposed", lambda: integrate(u0=np.ones((2, N))), "(2, 12)", "(12,"),
    case("integrate", "u0 with three axes", lambda: integrate(u0=np.ones((N, 2, 2))), "(12, 2, 2)"),
    case("integrate", "u0 complex", lambda: integrate(u0=U + 1j), "u0", "complex"),
    case("integrate", "u0 NaN", lambda: integrate(u0=np.where(U == 1, nan, U)), "point 11", "nan"),
    case("integrate", "u0 infinite", lambda: integrate(u0=np.where(U == 0, inf, U)), "point 0"),
    case("integrate", "u0 empty", lambda: integrate(u0=np.zeros(0)), "u0", "(0,)"),
    case("integrate", "single state, double operator", lambda: integrate(u0=single(U)),
         "u0", "float32", "float64"),
    case("integrate", "whole numbers as state", lambda: integrate(u0=np.arange(N), t1=0.01),
         right=lambda s: s.ys.dtype == jnp.float64),
    case("integrate", "t1 text", lambda: integrate(t1="1"), "t1", "'1'"),
    case("integrate", "t1 None", lambda: integrate(t1=None), "t1", "None"),
    case("integrate", "t1 NaN", lambda: integrate(t1=nan), "t1", "nan"),
    case("integrate", "t1 infinite", lambda: integrate(t1=inf), "t1", "inf"),
    case("integrate", "t1 complex", lambda: integrate(t1=1j), "t1", "complex"),
    case("integrate", "t1 an array", lambda: integrate(t1=np.ones(2)), "t1", "(2,)"),
    case("integrate", "t1 True", lambda: integrate(t1=True), "t1", "True"),
    case("integrate", "t0 text", lambda: integrate(t0="0"), "t0", "'0'"),
    case("integrate", "diffusion backwards", lambda: integrate(t0=1.0, t1=0.0),
         "t1 = 0", "t0 = 1", "backwards"),
    case("integrate", "no time at all", lambda: integrate(t0=1.0),
         right=lambda s: np.allclose(s.ys[-1], U)),
    case("integrate", "dt0 zero", lambda: integrate(dt0=0.0), "dt0 = 0.0"),
    case("integrate", "dt0 negative", lambda: integrate(dt0=-0.1), "dt0 = -0.1"),
    case("integrate", "dt0 NaN", lambda: integrate(dt0=nan), "dt0", "nan"),
    case("integrate", "dt0 text", lambda: integrate(dt0="0.1"), "dt0", "'0.1'"),
    case("integrate", "dt0 tiny", lambda: integrate(dt0=1e-12), "dt0 = 1e-12", "1e+12 steps",
         "10000000"),
    case("integrate", "dt0 small, every step stored",
         lambda: integrate(dt0=1e-4, saveat=dfx.SaveAt(steps=True)), "1e+04 steps", "4096"),
    case("integrate", "unstable Euler", lambda: integrate(dt0=0.5, solver=dfx.Euler()),
         "dt0 = 0.5", "Euler", "stable up to", "spectral radius"),
    case("integrate", "rtol one", lambda: integrate(rtol=1.0), "rtol = 1", "below 1"),
    case("integrate", "rtol zero", lambda: integrate(rtol=0.0), "rtol = 0", "above 0"),
    case("integrate", "rtol negative", lambda: integrate(rtol=-1e-3), "rtol = -0.001", "above 0"),
    case("integrate", "rtol NaN", lambda: integrate(rtol=nan), "rtol", "nan"),
    case("integrate", "rtol text", lambda: integrate(rtol="tight"), "rtol", "'tight'"),
    case("integrate", "rtol below round-off", lambda: integrate(rtol=1e-17), "rtol", "float64"),
    case("integrate", "atol negative", lambda: integrate(atol=-1.0), "atol = -1", "at least 0"),
    case("integrate", "atol NaN", lambda: integrate(atol=nan), "atol", "nan"),
    case("integrate", "solver as text", lambda: integrate(solver="RKC2"), "solver", "'RKC2'"),
    case("integrate", "a class as solver", lambda: integrate(solver=js.RKC2), "solver", "RKC2()"),
    case("integrate", "controller a number", lambda: integrate(controller=0.1), "controller"),
    case("integrate", "saveat a list", lambda: integrate(saveat=[0.0, 1.0]), "saveat", "SaveAt"),
    case("integrate", "saveat outside", lambda: integrate(saveat=dfx.SaveAt(ts=jnp.array([2.0]))),
         "saveat.ts", "2.0", "within 0 and 1"),
    case("integrate", "saveat out of order",
         lambda: integrate(saveat=dfx.SaveAt(ts=jnp.array([0.5, 0.2]))), "saveat.ts", "order"),
    case("integrate", "saveat NaN", lambda: integrate(saveat=dfx.SaveAt(ts=jnp.array([nan]))),
         "saveat.ts", "nan"),
    case("integrate", "event a function", lambda: integrate(event=lambda *a: True), "event"),
    case("integrate", "adjoint as text", lambda: integrate(adjoint="forward"), "adjoint"),
    case("integrate", "an adjoint that solves backwards",
         lambda: integrate(adjoint=dfx.BacksolveAdjoint()), "BacksolveAdjoint", "DirectAdjoint"),
    case("integrate", "an adjoint of what is at rest",
         lambda: integrate(adjoint=dfx.ImplicitAdjoint()), "ImplicitAdjoint", "DirectAdjoint"),
    case("integrate", "a solver of two unknowns",
         lambda: integrate(solver=dfx.SemiImplicitEuler(), dt0=0.1), "SemiImplicitEuler", "2"),
    case("integrate", "checkpoint a path", lambda: integrate(checkpoint="x"), "checkpoint", "'x'"),
    case("integrate", "max_steps broken", lambda: integrate(max_steps=2.5), "max_steps", "2.5"),
    case("integrate", "max_steps zero", lambda: integrate(max_steps=0), "max_steps = 0"),
    case("integrate", "reaction in NumPy",
         lambda: integrate(heat(reaction=lambda t, u, a: np.sin(u))), "reaction", "jax.numpy"),
    case("integrate", "reaction with an if",
         lambda: integrate(heat(reaction=lambda t, u, a: u if u[0] > 0 else -u)), "reaction", "if"),
    case("integrate", "reaction of another shape",
         lambda: integrate(heat(reaction=lambda t, u, a: u[:2])), "reaction", "(2,)", "(12,)"),
    case("integrate", "reaction that gives text",
         lambda: integrate(heat(reaction=lambda t, u, a: "u")), "reaction", "'u'"),
    case("integrate", "reaction complex",
         lambda: integrate(heat(reaction=lambda t, u, a: 1j * u)), "reaction", "complex"),
    case("integrate", "reaction None",
         lambda: integrate(heat(reaction=lambda t, u, a: None)), "reaction", "None"),
    case("integrate", "velocity in NumPy", lambda: quiet(lambda: integrate(
         moved(velocity=lambda t: np.float64(t) * np.ones((N, 2)), conservative=False))),
         "velocity", "jax.numpy"),
    case("integrate", "diffusivity negative in time",
         lambda: integrate(heat(diffusivity=lambda t: 0.5 - t)), "diffusivity", "-0.5", "t = 1"),
    case("integrate", "diffusivity per nothing", lambda: integrate(heat(diffusivity=np.ones(5))),
         "diffusivity", "(5,)", "(12,)"),
    case("integrate", "a wave of one field", lambda: js.integrate(wave(), U, t1=1.0), "u0", "pair"),
    case("integrate", "a wave of three", lambda: js.integrate(wave(), (U, U, U), t1=1.0), "pair"),
    case("integrate", "a wave of unequal fields",
         lambda: js.integrate(wave(), (U, np.ones((N, 2))), t1=1.0), "u0", "(12,)", "(12, 2)"),
    case("integrate", "a wave of speeds of another length",
         lambda: js.integrate(wave(speed=np.ones(5)), (U, U), t1=1.0), "(5,)", "12"),
]  # fmt: skip

PROBLEMS = [
    case(kind, label, call, *words)
    for kind, make in (
        ("AdvectionDiffusionReaction", js.AdvectionDiffusionReaction),
        ("BiharmonicDiffusion", js.BiharmonicDiffusion),
        ("CahnHilliard", functools.partial(js.CahnHilliard, width=0.1)),
        ("WaveEquation", js.WaveEquation),
    )
    for label, call, words in (
        ("an array as operator", lambda make=make: make(np.eye(N)), ("laplacian", "(12, 12)")),
        ("a SciPy matrix", lambda make=make: make(laplacian().to_scipy()),
         ("laplacian", "(12, 12)")),
        ("text as operator", lambda make=make: make("L"), ("laplacian", "'L'", "Operator")),
        ("a gradient as Laplacian", lambda make=make: make(gradient()), ("laplacian", "(2,)")),
        ("a condition", lambda make=make: make(laplacian(), closure=js.dirichlet([0], 1.0)),
         ("closure", "Closure", "eliminate")),
        ("conditions of other points", lambda make=make: make(laplacian(), closure=closure(20)),
         ("closure", "20", "12")),
    )
]  # fmt: skip

SPECIAL = [
    case("AdvectionDiffusionReaction", label, call, *words)
    for label, call, words in (
        ("nothing", lambda: js.AdvectionDiffusionReaction(), ("laplacian", "velocity")),
        ("diffusivity negative", lambda: heat(diffusivity=-1.0), ("diffusivity = -1",)),
        ("diffusivity NaN", lambda: heat(diffusivity=nan), ("diffusivity", "nan")),
        ("diffusivity negative at a point", lambda: heat(diffusivity=U - 0.05),
         ("diffusivity at point 0", "-0.05")),
        ("diffusivity text", lambda: heat(diffusivity="1"), ("diffusivity", "'1'")),
        ("diffusivity complex", lambda: heat(diffusivity=1j * U), ("diffusivity", "complex")),
        ("diffusivity None", lambda: heat(diffusivity=None), ("diffusivity", "None")),
        ("minus a laplacian", lambda: integrate(js.AdvectionDiffusionReaction(-laplacian())),
         ("laplacian", "diagonal", "below 0")),
        ("reaction no function", lambda: heat(reaction=U), ("reaction", "function")),
        ("velocity without gradient", lambda: moved(gradient=None), ("velocity", "gradient")),
        ("velocity scalar", lambda: moved(velocity=1.0), ("velocity", "()", "(12, 2)")),
        ("velocity in space", lambda: moved(velocity=np.ones((N, 3))), ("(12, 3)", "(12, 2)")),
        ("velocity NaN", lambda: moved(velocity=np.full((N, 2), nan)), ("velocity", "point 0")),
        ("velocity along normals", lambda: moved(velocity=js.circle(N).normals),
         ("velocity", "point 0", "normal part 1", "0.05")),
        ("velocity along normals at times", lambda: integrate(moved(
            velocity=lambda t: jnp.asarray(js.circle(N).normals))), ("velocity", "normal part 1")),
        ("velocity complex", lambda: moved(velocity=1j * np.ones((N, 2))), ("velocity", "complex")),
        ("gradient an array", lambda: moved(gradient=np.ones((N, 2))), ("gradient", "(12, 2)")),
        ("gradient of other points", lambda: heat(gradient=ring(20)[2]), ("gradient", "20", "12")),
        ("stabilization text", lambda: heat(stabilization="yes"), ("stabilization", "'yes'")),
        ("mass of other length", lambda: heat(mass=np.ones(5)), ("mass", "(5,)", "(12,)")),
        ("mass zero", lambda: heat(mass=np.zeros(N)), ("mass", "0.0")),
        ("mass NaN", lambda: heat(mass=np.full(N, nan)), ("mass", "nan")),
        ("mass with conditions", lambda: heat(mass=np.ones(N), closure=closure()),
         ("mass", "conditions")),
    )
] + [
    case("BiharmonicDiffusion", label, lambda s=settings: js.BiharmonicDiffusion(laplacian(), **s),
         *words)
    for label, settings, words in (
        ("stiffness negative", dict(stiffness=-1.0), ("stiffness = -1", "at least 0")),
        ("stiffness an array", dict(stiffness=np.ones(3)), ("stiffness", "(3,)")),
        ("stiffness text", dict(stiffness="1"), ("stiffness", "'1'")),
        ("reaction a number", dict(reaction=1.0), ("reaction", "float")),
        ("mass None of zeros", dict(mass=np.zeros(N)), ("mass", "0.0")),
    )
] + [
    case("CahnHilliard", label, lambda s=settings: js.CahnHilliard(
         laplacian(), **dict(width=0.1) | s), *words)
    for label, settings, words in (
        ("width negative", dict(width=-1.0), ("width = -1", "at least 0")),
        ("width None", dict(width=None), ("width", "None")),
        ("mobility negative", dict(mobility=-1.0), ("mobility = -1",)),
        ("mobility NaN", dict(mobility=nan), ("mobility", "nan")),
        ("splitting infinite", dict(splitting=inf), ("splitting", "inf")),
        ("potential None", dict(potential=None), ("potential", "None")),
        ("potential a number", dict(potential=1.0), ("potential", "float")),
    )
] + [
    case("WaveEquation", label, lambda s=settings: wave(**s), *words)
    for label, settings, words in (
        ("speed text", dict(speed="fast"), ("speed", "'fast'")),
        ("speed NaN", dict(speed=nan), ("speed", "nan")),
        ("speed infinite at a point", dict(speed=np.where(U == 1, inf, U)), ("speed", "point 11")),
        ("speed complex", dict(speed=1j), ("speed", "complex")),
        ("damping None", dict(damping=None), ("damping", "None")),
        ("forcing an array", dict(forcing=U), ("forcing", "function")),
        ("stabilization an array", dict(stabilization=np.eye(N)), ("stabilization", "(12, 12)")),
    )
]  # fmt: skip

SOLVERS = [
    case("RKC2", "no stages", lambda: js.RKC2(max_stages=1), "max_stages = 1", "at least 2"),
    case("RKC2", "broken stages", lambda: js.RKC2(max_stages=2.5), "max_stages", "2.5"),
    case("RKC2", "stages as text", lambda: js.RKC2(max_stages="9"), "max_stages", "'9'"),
    case("RKC2", "radius negative", lambda: js.RKC2(-1.0), "spectral_radius = -1", "above 0"),
    case("RKC2", "radius NaN", lambda: js.RKC2(nan), "spectral_radius", "nan"),
    case("RKC2", "radius an array", lambda: js.RKC2(np.ones(3)), "spectral_radius", "(3,)"),
    case("integrate", "no step of Euler's", lambda: integrate(solver=dfx.Euler()), "Euler", "dt0"),
    case("AdamsBashforth2", "no step", lambda: integrate(solver=js.AdamsBashforth2()), "dt0"),
    case(
        "AdamsBashforth2", "a step that is unstable",
        lambda: integrate(solver=js.AdamsBashforth2(), t1=50.0, dt0=1.0),
        "AdamsBashforth2 is stable up to", "dt0 = 1",
    ),
    case(
        "AdamsBashforth2", "a step that is no number",
        lambda: integrate(solver=js.AdamsBashforth2(), dt0=nan), "dt0", "nan",
    ),
    case("RKC2", "unknown loop", lambda: js.RKC2(loop="fast"), "loop", "'fast'", "checkpointed"),
] + [
    case(name, label, lambda make=make, s=settings: make(**s), *words)
    for name, make in (("IMEX", js.IMEX), ("SDIRK", js.SDIRK))
    for label, settings, words in (
        ("order seven", dict(order=7), ("order = 7", "4")),
        ("order broken", dict(order=2.5), ("order", "2.5")),
        ("order as text", dict(order="3"), ("order", "'3'")),
        ("tolerance negative", dict(tolerance=-1.0), ("tolerance = -1", "above 0")),
        ("tolerance NaN", dict(tolerance=nan), ("tolerance", "nan")),
        ("tolerance large", dict(tolerance=2.0), ("tolerance = 2", "below 1")),
        ("solver a class", dict(solver=lx.GMRES), ("solver", "GMRES")),
        ("solver as text", dict(solver="gmres"), ("solver", "'gmres'")),
        ("preconditioner an array", dict(preconditioner=np.eye(N)), ("preconditioner", "function")),
    )
] + [
    case("SDIRK", "no Newton steps", lambda: js.SDIRK(newton_steps=0), "newton_steps = 0"),
]  # fmt: skip

REST = [
    case("choose_solver", label, lambda x=x: js.choose_solver(x), "problem", *words)
    for label, x, words in (
        ("an operator", None, ("None",)), ("text", "heat", ("'heat'",)),
        ("an array", np.eye(3), ("(3, 3)",)), ("a list", [1], ("list",)),
        ("a class", js.WaveEquation, ("WaveEquation",)), ("a number", 1.0, ("1.0",)),
    )
] + [
    case("steady_state", "rtol one", lambda: js.steady_state(rtol=1.0), "rtol = 1", "below 1"),
    case("steady_state", "rtol negative", lambda: js.steady_state(rtol=-1.0), "rtol = -1"),
    case("steady_state", "rtol text", lambda: js.steady_state(rtol="x"), "rtol", "'x'"),
    case("steady_state", "rtol NaN", lambda: js.steady_state(rtol=nan), "rtol", "nan"),
    case("steady_state", "atol negative", lambda: js.steady_state(atol=-1.0), "atol = -1"),
    case("steady_state", "atol None", lambda: js.steady_state(atol=None), "atol", "None"),
    case("Checkpoint", "no time", lambda: js.Checkpoint("x", every=0), "every = 0", "above 0"),
    case("Checkpoint", "time negative", lambda: js.Checkpoint("x", every=-1.0), "every = -1"),
    case("Checkpoint", "time NaN", lambda: js.Checkpoint("x", every=nan), "every", "nan"),
    case("Checkpoint", "time as text", lambda: js.Checkpoint("x", every="1"), "every", "'1'"),
    case("Checkpoint", "path None", lambda: js.Checkpoint(None, every=1.0), "path", "None"),
    case("Checkpoint", "path a number", lambda: js.Checkpoint(3, every=1.0), "path", "int"),
    case("Checkpoint", "text in the file", lambda: bad_file(b"text"), "does not hold a checkpoint"),
    case("Checkpoint", "an empty file", lambda: bad_file(b""), "does not hold a checkpoint"),
    case("Checkpoint", "no time at all", lambda: integrate(
         t1=0.0, checkpoint=js.Checkpoint("x", every=1.0)), "t1 > t0", "0.0"),
    case("AbstractEvolution", "abstract", lambda: js.AbstractEvolution(), "AbstractEvolution"),
    case("step_preconditioner", "a wave", lambda: js.step_preconditioner(wave(), U), "Wave"),
    case("step_preconditioner", "an operator", lambda: js.step_preconditioner(laplacian(), U),
         "problem", "Stencil"),
    case("step_preconditioner", "no diffusion", lambda: js.step_preconditioner(moved(), U),
         "diffusion"),
    case("step_preconditioner", "u0 a list", lambda: js.step_preconditioner(heat(), list(U)),
         "u0", "list"),
    case("step_preconditioner", "u0 of other length", lambda: js.step_preconditioner(heat(), U[:3]),
         "u0", "(3,)", "(12,)"),
    case("step_preconditioner", "renewed for what has no plan", lambda: js.step_preconditioner(
         heat(), U).renewed(heat()), "renewable=True"),
    case("step_preconditioner", "renewed for an operator", lambda: js.step_preconditioner(
         heat(), U, renewable=True).renewed(laplacian()), "problem", "Stencil"),
    case("step_preconditioner", "problem None", lambda: js.step_preconditioner(None, U),
         "problem", "None"),
] + [
    case("hyperviscosity", label, call, *words)
    for label, call, words in (
        ("power zero", lambda: js.hyperviscosity(laplacian(), 1.0, power=0), ("power = 0", "1")),
        ("power broken", lambda: js.hyperviscosity(laplacian(), 1.0, power=1.5), ("power", "1.5")),
        ("strength negative", lambda: js.hyperviscosity(laplacian(), 1.0, strength=-1),
         ("strength = -1", "above 0")),
        ("strength NaN", lambda: js.hyperviscosity(laplacian(), 1.0, strength=nan), ("strength",)),
        ("speed negative", lambda: js.hyperviscosity(laplacian(), -1.0), ("speed = -1",)),
        ("speed an array", lambda: js.hyperviscosity(laplacian(), U), ("speed", "(12,)")),
        ("an array", lambda: js.hyperviscosity(np.eye(N), 1.0), ("laplacian", "(12, 12)")),
        ("a gradient", lambda: js.hyperviscosity(gradient(), 1.0), ("laplacian", "(2,)")),
        ("radius zero", lambda: js.hyperviscosity(laplacian(), 1.0, spectral_radius=0.0),
         ("spectral_radius = 0", "above 0")),
    )
] + [
    case("upwind_viscosity", label, call, *words)
    for label, call, words in (
        ("an array as cloud", lambda: js.upwind_viscosity(np.ones((N, 2)), np.ones((N, 2))),
         ("cloud", "(12, 2)", "PointCloud")),
        ("velocity of other shape", lambda: js.upwind_viscosity(js.circle(N), np.ones((N, 3))),
         ("velocity", "(12, 3)", "(12, 2)")),
        ("velocity a number", lambda: js.upwind_viscosity(js.circle(N), 1.0), ("velocity", "()")),
        ("velocity NaN", lambda: js.upwind_viscosity(js.circle(N), np.full((N, 2), nan)),
         ("velocity", "point 0")),
        ("velocity text", lambda: js.upwind_viscosity(js.circle(N), "v"), ("velocity", "'v'")),
        ("strength negative", lambda: js.upwind_viscosity(
            js.circle(N), np.ones((N, 2)), strength=-1.0), ("strength = -1",)),
        ("method as text", lambda: js.upwind_viscosity(
            js.circle(N), np.ones((N, 2)), method="DCPSE"), ("method", "'DCPSE'")),
    )
]  # fmt: skip

TOLERANCES = [
    Case("integrate", label, call, words)
    for label, call, words in (
        ("a controller that no step meets", lambda: js.integrate(
            heat(), np.ones(N), t1=0.1, controller=dfx.PIDController(0.0, 0.0)),
         ("controller.rtol = 0", "above 0")),
        ("a controller below zero", lambda: js.integrate(
            heat(), np.ones(N), t1=0.1, controller=dfx.PIDController(1e-3, -1.0)),
         ("controller.atol = -1", "at least 0")),
        ("a controller that is no number", lambda: js.integrate(
            heat(), np.ones(N), t1=0.1, controller=dfx.PIDController(nan, 1e-3)),
         ("controller.rtol = nan", "at least 0")),
        ("a controller below round-off", lambda: js.integrate(
            heat(), np.ones(N), t1=0.1, controller=dfx.PIDController(1e-18, 0.0)),
         ("controller.rtol = 1e-18", "at least")),
    )
] + [
    Case("Checkpoint", "in a folder that is not there", lambda: js.Checkpoint(
        "not/there/run.npz", every=1.0), ("path", "no folder", "not/there")),
    Case("AdvectionDiffusionReaction", "text for conservative", lambda:
        js.AdvectionDiffusionReaction(heat().laplacian, conservative="no"),
        ("conservative is 'no'", "True or False")),
]  # fmt: skip

CASES = TOLERANCES + INTEGRATE + PROBLEMS + SPECIAL + SOLVERS + REST
