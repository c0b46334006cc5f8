"""The picture of an optimisation while it runs."""

import functools

import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxsurf as js

pytest.importorskip("matplotlib")


@functools.cache
def shape():
    surface = js.discretize(js.sphere(100), method=js.GFDM(degree=2))
    return js.MappedShape(lambda x, a: a * x, surface)


def bowl(surface):
    return (jnp.mean(surface.cloud.points**2) - 0.5) ** 2


def run(live, steps=4):
    options = dict(optimizer=optax.sgd(0.2), steps=steps, rtol=0.0)
    return js.optimize_shape(bowl, shape(), 1.0, callback=live, **options)


def test_it_shows_the_surface_and_the_way_there_every_so_many_steps():
    drawn = []
    live = js.LivePlot(lambda s: drawn.append(s) or s.cloud.points[:, 2], every=3, pixels=60)
    found = run(live)
    assert len(drawn) == 2  # after three steps, and where it ends
    left, right, _ = live.figure.axes
    assert left.get_title() == f"step 4: {float(found.objective):.5g}"
    np.testing.assert_allclose(right.lines[0].get_ydata(), found.history["objective"])
    assert [line.get_label() for line in right.lines] == ["objective", "gradient"]


def test_in_a_notebook_one_output_changes_in_place(monkeypatch):
    shown = []

    class Handle:
        def update(self, figure):
            shown.append("update")

    def display(figure, display_id):
        shown.append("display")
        return Handle()

    pytest.importorskip("IPython")
    monkeypatch.setattr("IPython.display.display", display)
    monkeypatch.setattr("jaxsurf.live._in_notebook", lambda: True)
    run(js.LivePlot(pixels=60), steps=3)
    assert shown == ["display", "update", "update"]
