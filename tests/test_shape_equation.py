"""The reference of the experiment on vesicles."""

import numpy as np
import pytest

from experiments.shape_equation import branch, equal_energy


@pytest.mark.parametrize(("v", "axis"), [(0.65, 1.3), (0.9, 1.3), (0.65, 0.75), (0.9, 0.75)])
def test_forces_are_derivatives_of_the_energy(v, axis):
    """Pressure that of the energy in the volume; with the tension, that in size, which is zero."""
    less, found, more = (branch(volume, axis)[-1] for volume in (v - 1e-3, v, v + 1e-3))
    change = (more.energy - less.energy) / (more.v - less.v)
    np.testing.assert_allclose(change, -found.pressure / 6, rtol=1e-4)
    np.testing.assert_allclose(2 * found.tension, -found.pressure * v, rtol=1e-6)


def test_close_to_the_sphere():
    """By perturbation: 1 + 2 (1 - v), and the next power, of 3 / 2, is odd in the two branches."""
    prolate, oblate = (branch(0.99, axis)[-1] for axis in (1.3, 0.75))
    slope = ((prolate.energy + oblate.energy) / 2 - 1) / 0.01
    np.testing.assert_allclose(slope, 2, rtol=5e-3)
    assert prolate.energy < oblate.energy


def test_profiles_have_the_volume_asked_for():
    for axis in (1.3, 0.75):
        found = branch(0.65, axis)[-1]
        r, z = found.r, found.z
        cones = (z[:-1] - z[1:]) * (r[:-1] ** 2 + r[:-1] * r[1:] + r[1:] ** 2) / 3
        area = np.sum((r[:-1] + r[1:]) * np.hypot(np.diff(r), np.diff(z)))
        np.testing.assert_allclose([1.5 * np.sum(cones), area / 2], [0.65, 1], rtol=1e-5)


def test_branches_cross_where_published():
    """Seifert, Berndl and Lipowsky 1991: biconcave below 0.651, prolate above 0.652."""
    assert 0.651 < equal_energy(0.64, 0.66, 1.3, 0.75) < 0.652
