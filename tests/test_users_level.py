"""The kernels at the level of optimisation that users get: the other tests compile quickly, without optimisation.

In the plane: the kernels are the same, and compile in a third of the time. Verdicts are equal, proofs hold, values
agree to the width that the solver was asked for.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import USERS_OPTIONS
from grasps import ball
from shapes import PLANAR
from smooth_problems import as_arrays, direction, grasp_of, planar_problem

import jaxgrasp as jg

pytestmark = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="compares to 1e-9")
TOLERANCE = 1e-11


def at_users_level(function, *arguments):
    """What ``function`` gives, compiled as users compile it."""
    return jax.jit(function).lower(*arguments).compile(USERS_OPTIONS)(*arguments)


@pytest.fixture(scope="module")
def grasp():
    position, normal, friction = ball(np.random.default_rng(6), 200, PLANAR, dimension=2)
    return jg.Grasp(position, normal, jg.HardFinger(friction))


def test_margins(grasp):
    users = at_users_level(lambda g: jg.wrench_resistance(g, tolerance=TOLERANCE), grasp)
    tests = jg.wrench_resistance(grasp, tolerance=TOLERANCE)
    counts = np.bincount(np.asarray(users.status), minlength=3)
    assert counts[jg.Status.RESISTANT] > 50 and counts[jg.Status.NOT_RESISTANT] > 50
    for name in ("status", "rank", "stop"):
        np.testing.assert_array_equal(getattr(users, name), getattr(tests, name))
    width = np.maximum(users.gap, tests.gap)  # both are lower ends of brackets around one number
    assert np.quantile(width, 0.95) < 3e-10
    assert (np.abs(np.asarray(users.margin - tests.margin)) <= width + 1e-12).all()
    assert jg.check(grasp, users).all()


def test_forces(grasp):
    load, asked = np.random.default_rng(7).normal(size=(200, 3)), jg.Gentlest()
    users = at_users_level(
        lambda g, w: jg.optimize_forces(g, w, criterion=asked, tolerance=TOLERANCE), grasp, load
    )
    tests = jg.optimize_forces(grasp, load, criterion=asked, tolerance=TOLERANCE)
    optimal = np.asarray(users.status) == jg.Status.OPTIMAL
    assert 50 < optimal.sum() < 200
    np.testing.assert_array_equal(users.status, tests.status)
    np.testing.assert_allclose(np.asarray(users.cost)[optimal], np.asarray(tests.cost)[optimal], rtol=1e-9)
    assert jg.check(grasp, users, wrench=load, criterion=asked).all()


def test_derivatives():
    problem = as_arrays(
        {k: v for k, v in planar_problem().items() if k in ("position", "normal", "friction")}
    )
    change = direction(problem)

    def slope(x, t):
        def margin(x):
            return jg.wrench_resistance(grasp_of(x), tolerance=TOLERANCE).margin

        return jax.jvp(margin, (x,), (t,))

    users, tests = at_users_level(slope, problem, change), jax.jit(slope)(problem, change)
    assert jnp.isfinite(users[0]).all()
    for one, other in zip(users, tests, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
