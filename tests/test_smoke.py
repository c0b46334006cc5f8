"""One call of each kind, which also has to run on the lowest versions of `pyproject.toml`."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxsurf as js

N = 300


def test_one_call_of_each_kind(tmp_path):
    cloud = js.sphere(N)
    laplacian = js.laplace_beltrami(cloud)
    z = cloud.points[:, 2]
    assert jnp.abs(laplacian(z) + 2 * z).max() < 0.1
    assert jnp.abs(js.mean_curvature(cloud) - 1).max() < 0.05
    ball = js.level_set(lambda x: jnp.sum(x**2) - 1, n=200, bounds=((-1.2,) * 3, (1.3,) * 3))
    assert abs(ball.n - 200) < 40

    square, slope = jax.value_and_grad(lambda u: jnp.sum(laplacian(u) ** 2))(z)
    assert abs(float(jnp.vdot(slope, z) / (2 * square)) - 1) < 1e-12
    found = js.solve(laplacian, -2 * z).value
    assert jnp.abs(found - z).max() < 0.1
    assert abs(float(js.eigenmodes(laplacian, 2).values[1]) - 2) < 0.1
    end = js.integrate(js.AdvectionDiffusionReaction(laplacian), z, t1=0.1).ys[-1]
    assert jnp.abs(end - np.exp(-0.2) * z).max() < 0.02
    top = int(jnp.argmax(z))
    distance = js.geodesic_distance(cloud, jnp.array([top]))
    assert abs(float(distance[jnp.argmin(z)]) - np.pi) < 0.3

    js.write(tmp_path / "cloud.xyz", cloud)
    assert js.read(tmp_path / "cloud.xyz").n == N
    laplacian.save(tmp_path / "laplacian.npz")
    assert jnp.all(js.Stencil.load(tmp_path / "laplacian.npz")(z) == laplacian(z))
