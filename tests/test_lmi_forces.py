"""Force optimisation by linear matrix inequalities: known answers, and the structured solver on random problems."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from force_problems import CRITERIA, problems

import jaxgrasp as jg
from jaxgrasp import Status

WEIGHT = 10.0
PINCH = np.array([[-1.0, 0, 0], [1.0, 0, 0]])
LIFT = np.array([0, 0, -WEIGHT, 0, 0, 0])


def solved_to(dtype):
    return 5e-8 if dtype == "float64" else 2e-3


def pinch(dtype, mu=0.5):
    return jg.Grasp(PINCH.astype(dtype), -PINCH.astype(dtype), jg.HardFinger(jnp.asarray(mu, dtype)))


@pytest.mark.parametrize(
    ("criterion", "cost"),
    [
        (jg.Gentlest(), 10.0),
        (jg.SmallestSum(), 20.0),
        (jg.SumOfSquares(), 200.0),
        (jg.LeastNorm(), 250.0),
    ],
    ids=["gentlest", "smallest-sum", "squares", "least-norm"],
)
def test_the_pinch(criterion, cost, dtype):
    """W / (2 mu) = 10 N each; every force on the edge of its cone."""
    out = jg.lmi.lmi_forces(pinch(dtype), LIFT.astype(dtype), criterion=criterion)
    assert out.status == Status.OPTIMAL
    np.testing.assert_allclose(out.upper, cost, rtol=2 * solved_to(dtype))
    assert float(out.lower) <= cost * (1 + solved_to(dtype))
    np.testing.assert_allclose(np.asarray(out.force)[[2, 5]], [10, 10], rtol=1e-3)


def test_limits_bind_at_their_bound_and_forbid_beyond_it(dtype):
    limit = np.array([10.1, 9.9], dtype)
    grasps = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), pinch(dtype))
    out = jg.lmi.lmi_forces(grasps, LIFT.astype(dtype), criterion=jg.SmallestSum(), max_normal=limit[:, None])
    np.testing.assert_array_equal(out.status, [Status.OPTIMAL, Status.INFEASIBLE])
    np.testing.assert_allclose(out.upper[0], 20.0, rtol=2 * solved_to(dtype))
    assert float(out.upper[1]) == np.inf
    assert float(out.gap[1]) == 0.0


@pytest.mark.parametrize(
    ("name", "limits", "criterion", "count"),
    [
        ("planar hard", True, "robust", 12),
        pytest.param("planar hard", True, "robust", 60, marks=pytest.mark.slow),
        pytest.param("hard", False, "sum of squares", 60, marks=pytest.mark.slow),
        pytest.param("frictionless", False, "gentlest", 60, marks=pytest.mark.slow),
        pytest.param("hard", False, "gentlest", 60, marks=pytest.mark.slow),
        pytest.param("planar hard", True, "smallest sum", 60, marks=pytest.mark.slow),
        pytest.param("soft", True, "least norm", 60, marks=pytest.mark.slow),
        pytest.param("soft", True, "robust", 60, marks=pytest.mark.slow),
        pytest.param("soft", True, "gentlest", 60, marks=pytest.mark.slow),
    ],
)
def test_both_roads_agree(name, limits, criterion, count):
    """Random problems: costs to 1e-6 where both are optimal, no contradiction, the brackets overlap."""
    grasp, _, wrench, cap, limit = problems(name, limits, count, seed=77)
    make, parameter = CRITERIA[criterion]
    one = jg.optimize_forces(grasp, wrench, criterion=make(parameter), max_normal=cap, torque_limits=limit)
    two = jg.lmi.lmi_forces(grasp, wrench, criterion=make(parameter), max_normal=cap, torque_limits=limit)
    status = np.asarray(one.status)
    found = np.isin(two.status, [Status.OPTIMAL, Status.STALLED])
    optimal, infeasible = status == Status.OPTIMAL, status == Status.INFEASIBLE
    both = optimal & found
    assert both.sum() > 0.3 * count
    assert (infeasible & np.isposinf(two.upper)).sum() > 0.05 * count
    assert not np.any(optimal & np.isposinf(two.upper))
    assert not np.any(infeasible & found)
    size = np.abs(np.asarray(one.cost))
    if criterion == "robust":
        size = size + parameter + np.abs(np.asarray(one.force)).max(-1)
    error = np.abs(np.asarray(two.upper)[both] - np.asarray(one.cost)[both]) / size[both]
    assert error.max() < 1e-6, np.sort(error)[-5:]
    assert np.all(np.asarray(two.lower)[both] <= np.asarray(one.cost)[both] + 1e-7 * size[both])
    # Components that do not exist (mu = 0, gamma = 0) carry nothing.
    scaling = np.asarray(grasp.model.scaling(grasp.dimension)).reshape(count, -1)
    assert np.all(np.asarray(two.force)[(scaling == 0) & found[:, None]] == 0.0)


def test_many_loads_for_one_grasp_and_lanes_that_are_no_problem(dtype):
    loads = np.array([LIFT, 2 * LIFT, np.full(6, np.nan)], dtype)
    out = jg.lmi.lmi_forces(pinch(dtype), loads, criterion=jg.Gentlest())
    np.testing.assert_allclose(np.asarray(out.upper)[:2], [10, 20], rtol=2 * solved_to(dtype))
    assert np.isnan(out.upper[2])
    np.testing.assert_array_equal(out.status, [Status.OPTIMAL, Status.OPTIMAL, Status.INVALID])


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match="criterion must be one such as"):
        jg.lmi.lmi_forces(pinch("float32"), LIFT.astype("float32"), criterion="gentlest")
    with pytest.raises(ValueError, match=r"wrench must have shape"):
        jg.lmi.lmi_forces(pinch("float32"), np.ones(5, np.float32), criterion=jg.Gentlest())
    with pytest.raises(ValueError, match=r"max_normal must broadcast to shape \(2,\)"):
        jg.lmi.lmi_forces(
            pinch("float32"), LIFT.astype("float32"), criterion=jg.Gentlest(), max_normal=np.ones(3)
        )
