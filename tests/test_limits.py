"""Limits of contact forces and joint torques: infinite, huge, exactly reached, and of mixed sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import ball

import jaxgrasp as jg
from jaxgrasp import Status

INF = np.inf
POSITION = np.array([[-1.0, 0.0], [1.0, 0.0]])
LOAD = np.array([0.0, -10.0, 0.0])
JACOBIAN = np.array(
    [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]
)  # torque j is the normal force of finger j
CRITERIA = {
    "gentlest": jg.Gentlest(),
    "smallest sum": jg.SmallestSum(),
    "sum of squares": jg.SumOfSquares(),
    "least norm": jg.LeastNorm(),
    "robust": jg.Robust(0.1),
}


def pinches(count):
    """A planar pinch of a disc, mu = 0.5, that must squeeze with 10 N, ``count`` times."""
    position = np.tile(POSITION, (count, 1, 1))
    return jg.Grasp(position, -position, jg.HardFinger(0.5)), np.tile(LOAD, (count, 1))


def proved(grasp, wrench, criterion, **limits):
    """The answer, once the checker has accepted all of it."""
    answer = jg.optimize_forces(grasp, wrench, criterion=criterion, **limits)
    assert np.all(jg.check(grasp, answer, wrench=wrench, criterion=criterion, **limits))
    return answer


TORQUES = {
    Status.OPTIMAL: [
        [INF, 20], [INF, INF], [INF, 10], [1e9, 10], [1e9, 20], [10, 10], [1e4, 10], [1e5, 10], [1e6, 10], [1e12, 10],
        [1e300, 10], [1e9, 1e9], [10, 20],
    ],
    Status.INFEASIBLE: [[INF, 9.9], [1e9, 9.9], [1e-300, 10], [1e-9, 1e9], [1e-3, INF]],
    Status.INVALID: [[-INF, 10], [0, 10], [np.nan, 10], [INF, 0], [INF, -1]],
}  # fmt: skip


def test_torque_limits_of_every_size():
    tau = np.array([x for rows in TORQUES.values() for x in rows])
    expected = [int(status) for status, rows in TORQUES.items() for _ in rows]
    grasp, wrench = pinches(len(tau))
    answer = proved(grasp, wrench, jg.Gentlest(), torque_limits=(np.tile(JACOBIAN, (len(tau), 1, 1)), tau))
    np.testing.assert_array_equal(answer.status, expected)
    held = np.array(expected) == Status.OPTIMAL.value
    np.testing.assert_allclose(np.asarray(answer.cost)[held], 10.0, rtol=2e-8)
    assert np.all(np.asarray(answer.gap)[held] <= 4e-7)
    free = held[:, None] & np.isinf(tau)
    np.testing.assert_array_equal(np.asarray(answer.joint_rates)[free], 0.0)  # no limit, no multiplier


def test_caps_of_every_size():
    caps = [
        [INF, INF],
        [INF, 10],
        [1e9, 10],
        [1e12, 10],
        [1e5, 10],
        [10, 10],
        [1e12, 1e12],
        [1e8, 11],
        [1e300, 10],
    ]
    grasp, wrench = pinches(len(caps))
    answer = proved(grasp, wrench, jg.Gentlest(), max_normal=np.array(caps))
    np.testing.assert_array_equal(answer.status, Status.OPTIMAL.value)
    np.testing.assert_allclose(answer.cost, 10.0, rtol=2e-8)
    refused = [[INF, 9.9], [1e9, 9.9], [np.nan, 10], [0, INF]]
    grasp, wrench = pinches(len(refused))
    answer = proved(grasp, wrench, jg.Gentlest(), max_normal=np.array(refused))
    np.testing.assert_array_equal(answer.status, [Status.INFEASIBLE.value] * 2 + [Status.INVALID.value] * 2)


def random_problems(seed, count):
    """Grasps that hold, loads, Jacobians of three joints, and the forces without limits."""
    rng = np.random.default_rng(seed)
    position, normal, _ = ball(rng, count, 3, 0.2, 2)
    grasp = jg.Grasp(position, normal, jg.HardFinger(0.8))
    grasp = grasp[np.asarray(jg.wrench_resistance(grasp).status) == Status.RESISTANT.value]
    count = grasp.batch_shape[0]
    return grasp, rng.normal(size=(count, 3)), rng.normal(size=(count, 6, 3)), rng


@pytest.mark.slow("test_torque_limits_of_every_size", "test_caps_of_every_size")
@pytest.mark.parametrize("name", CRITERIA)
def test_huge_and_infinite_limits_are_none(name):
    """Limits from 10^4 to 10^14 times the forces, some infinite: as without; one reached among them: as alone."""
    criterion = CRITERIA[name]
    grasp, wrench, J, rng = random_problems(0, 128)
    count = grasp.batch_shape[0]
    assert count > 30
    free = proved(grasp, wrench, criterion)
    force = np.asarray(free.force)
    np.testing.assert_array_equal(free.status, Status.OPTIMAL.value)

    def huge(columns):
        size = 10.0 ** rng.uniform(4, 14, (count, columns)) * np.abs(force).max(1, keepdims=True)
        return np.where(rng.random(size.shape) < 0.3, INF, size)

    for limits in ({"max_normal": huge(3)}, {"torque_limits": (J, huge(3))}):
        answer = proved(grasp, wrench, criterion, **limits)
        np.testing.assert_array_equal(answer.status, Status.OPTIMAL.value)
        np.testing.assert_allclose(answer.cost, free.cost, rtol=1e-7)

    # The first joint at 97 % of what it would take: the others' limits, huge or infinite, change nothing.
    tau, without = huge(3), np.full((count, 3), INF)
    tau[:, 0] = without[:, 0] = 0.97 * np.abs(np.einsum("bij,bi->bj", J, force))[:, 0]
    mixed = proved(grasp, wrench, criterion, torque_limits=(J, tau))
    alone = proved(grasp, wrench, criterion, torque_limits=(J, without))
    one = proved(grasp, wrench, criterion, torque_limits=(J[..., :1], tau[:, :1]))
    same = np.asarray(mixed.status) == Status.OPTIMAL.value
    assert same.sum() > 20
    np.testing.assert_array_equal(np.asarray(mixed.status)[same], np.asarray(alone.status)[same])
    np.testing.assert_allclose(np.asarray(alone.cost)[same], np.asarray(mixed.cost)[same], rtol=1e-7)
    np.testing.assert_allclose(np.asarray(one.cost)[same], np.asarray(mixed.cost)[same], rtol=1e-7)


def test_derivatives_beside_an_infinite_limit():
    """Those of the problem without the joint; none with respect to the limit that is none."""
    grasp, _ = pinches(1)
    load = np.array([[1.0, -10.0, 0.0]])  # finger 0 carries 10.5 N, finger 1 9.5 N

    def cost(tau, scale):
        limits = (JACOBIAN[None], tau[None])
        return jg.optimize_forces(
            grasp, scale * load, criterion=jg.SumOfSquares(), torque_limits=limits
        ).cost[0]

    tau = jnp.array([INF, 30.0])
    by_tau, by_scale = jax.grad(cost, argnums=(0, 1))(tau, 1.0)
    np.testing.assert_allclose(by_tau, 0.0, atol=1e-6)
    np.testing.assert_allclose(by_scale, 2 * cost(tau, 1.0), rtol=1e-6)


def test_a_multiplier_of_an_infinite_limit_is_refused():
    grasp, wrench = pinches(1)
    limits = (JACOBIAN[None], np.array([[INF, 20.0]]))
    problem = {"wrench": wrench, "criterion": jg.Gentlest(), "torque_limits": limits}
    answer = jg.optimize_forces(grasp, wrench, torque_limits=limits)
    assert np.all(jg.check(grasp, answer, **problem))
    for rate in (1e-9, -1e-300, np.nan):
        forged = jg.OptimalForces(**(vars(answer) | {"joint_rates": answer.joint_rates.at[0, 0].set(rate)}))
        assert not np.any(jg.check(grasp, forged, **problem))


def test_limits_in_body_axes_beside_padding():
    """A contact that is none has no frame; what its rows of J and its numbers are does not matter."""
    position = np.concatenate([POSITION, [[np.nan, 0.0]]])
    grasp = jg.Grasp(position, -position, jg.HardFinger(0.5), np.array([True, True, False]))
    body = np.zeros((6, 2))
    body[0, 0], body[2, 1] = 1.0, -1.0  # along the normals +x and -x
    limits = jg.TorqueLimits(body, np.array([INF, 10.0]), axes="body")
    answer = proved(grasp, LOAD, jg.Gentlest(), torque_limits=limits)
    assert int(answer.status) == Status.OPTIMAL.value
    np.testing.assert_allclose(answer.cost, 10.0, rtol=2e-8)
    frames = np.asarray(jg.contact_frames(grasp))
    np.testing.assert_array_equal(frames[2], np.eye(2))
    np.testing.assert_allclose(frames[0], [[0.0, 1.0], [-1.0, 0.0]])  # columns t, n: t x n = +e_z
    own = np.einsum("kdn,kdq->knq", frames, body.reshape(3, 2, 2)).reshape(6, 2)
    np.testing.assert_allclose(own[:4], JACOBIAN)
