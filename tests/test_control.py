"""(11.27) in closed loop: designed decay, forces in their cones, infeasibility told; regulation below two fingers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion import random_bodies, random_states
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

import jaxgrasp as jg
from jaxgrasp.contacts.friction_cones import cone_use, into_cones, nearest_admissible
from jaxgrasp.motion.computed_torque import tracking_error
from jaxgrasp.motion.regulator import riccati

C = jg.Status
pytestmark = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="loops are compared in float64")

PLANAR = jg.RigidBody(0.2, 1e-4)
LANES, STEPS = 16, 500  # one shape for all planar loops, so that they compile once


def ring(friction=0.8, lanes=LANES, tilt=0.0):
    """Three fingers around a planar body; two of them opposite, turned by ``tilt`` rad from their line."""
    angle = np.array([0.0, np.pi, -np.pi / 2])
    p = 0.03 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    inward = angle + np.pi + np.array([tilt, -tilt, 0])
    n = np.stack([np.cos(inward), np.sin(inward)], axis=-1)
    mu = np.broadcast_to(np.asarray(friction, float).reshape(-1, 1), (lanes, 3))
    active = np.broadcast_to([True, True, tilt == 0.0], (lanes, 3))
    return jg.Grasp(np.broadcast_to(p, (lanes, 3, 2)), n, jg.HardFinger(mu), active)


def slack(grasp, force):
    """The least ``f_n - psi`` of all contacts, N."""
    n = grasp.model.force_size(grasp.dimension)
    parts = np.asarray(force).reshape(*force.shape[:-1], grasp.contacts, n)
    mu = np.asarray(grasp.model.friction_coefficient)
    index = grasp.model.normal_index(grasp.dimension)
    tangential = np.linalg.norm(np.delete(parts, index, -1), axis=-1)
    return (parts[..., index] - tangential / mu).min()


def rested(displacement, lanes=LANES, dimension=2):
    return jg.BodyState.at_rest(dimension, (lanes,)).displaced(jnp.asarray(displacement))


def loop(grasp, state, rate=10.0, h=0.002, body=PLANAR, reference=None, disturbance=None, max_normal=np.inf):
    """Always the same kinds of arguments: one compilation."""
    limit = np.broadcast_to(max_normal, (LANES, 3))
    controller = jg.ComputedTorque(jg.Gains.of_rate(rate), max_normal=limit)
    if reference is None:
        hold = jg.motion.Reference.hold(jg.BodyState.at_rest(2))
        reference = jax.tree.map(lambda x: jnp.broadcast_to(x, (STEPS, *x.shape)), hold)
    push = np.zeros((STEPS, 3)) if disturbance is None else disturbance
    return jg.close_loop(
        grasp,
        body,
        controller=controller,
        state=state,
        simulation=jg.motion.Simulation(STEPS, timestep=h, record=True),
        reference=reference,
        disturbance=push,
    )


# Computed torque ---------------------------------------------------------------------------------------


def test_errors_decay_at_the_designed_rate_with_forces_in_their_cones():
    """``|e| = |e_0| (1 + l t) exp(-l t)`` to 1 %, until it has fallen to 1 %; every force in its cone to 1e-9 N."""
    rng = np.random.default_rng(43)
    shift = 0.01 * rng.normal(size=(LANES, 3)) * [1, 1, 30]
    rate, h = 67.0, 2e-4
    out = loop(ring(), rested(shift), rate, h)
    assert set(np.unique(out.status).tolist()) == {C.COMMANDED.value}
    t = h * np.arange(STEPS)[:, None]
    for error, start in (
        (out.position_error, np.linalg.norm(shift[:, :2], axis=1)),
        (out.orientation_error, np.abs(shift[:, 2])),
    ):
        wanted = start * (1 + rate * t) * np.exp(-rate * t)
        assert (wanted[-1] < 0.01 * start).all()
        early = t[:, 0] <= 6.6 / rate  # where it reaches 1 %
        ratio = np.asarray(error)[early] / wanted[early]
        # rates of semi-implicit Euler differ by h l / 2 of themselves: 0.7 % here
        measured = -np.log(np.asarray(error)[early] / start / (1 + rate * t[early])) / np.maximum(t[early], h)
        np.testing.assert_allclose(measured[20:], rate, rtol=0.01)
        assert np.abs(ratio - 1).max() < 0.05
    assert slack(ring(), out.force) > -1e-9
    assert np.asarray(out.cone_use).max() < 1 + 1e-9


def test_friction_below_the_critical_value_is_reported_not_cheated():
    """Two planar fingers at 20 degrees to their line hold iff mu > tan 20 = 0.364 (Nguyen)."""
    friction = np.linspace(0.2, 0.5, LANES)
    grasp = ring(friction, tilt=np.deg2rad(20))
    out = loop(grasp, rested(np.zeros((LANES, 3))))
    low = friction < np.tan(np.deg2rad(20))
    np.testing.assert_array_equal(out.infeasible, low)
    assert set(np.asarray(out.status)[0, low].tolist()) == {C.INFEASIBLE.value}
    assert slack(grasp, out.force) > -1e-9
    # and the object falls: what is applied is what moves it
    fallen = np.asarray(out.final.position)[:, 1]
    np.testing.assert_allclose(fallen[low], -9.81 * 0.002**2 * STEPS * (STEPS + 1) / 2, rtol=1e-9)
    assert np.abs(fallen[~low]).max() < 1e-6


def test_limits_of_the_fingers_are_kept_and_their_lack_reported():
    grasp = ring(0.3, tilt=0.001)
    weight = 0.2 * 9.81
    limit = np.broadcast_to(np.linspace(0.5, 1.5, LANES)[:, None] * weight / 0.6, (LANES, 3))
    out = loop(grasp, rested(np.zeros((LANES, 3))), max_normal=limit)
    enough = limit[:, 0] > 1.01 * weight / 0.6
    short = limit[:, 0] < 0.99 * weight / 0.6
    assert not np.asarray(out.infeasible)[enough].any()
    assert np.asarray(out.infeasible)[short].all()
    assert (np.asarray(out.largest_normal) <= limit[:, 0] + 1e-12).all()


def test_joint_torques_stay_under_their_limits():
    """One joint presses both of two opposite fingers, which carry the weight by friction: they must press with
    weight / mu together. The forces stay under the limit, and below that one the step says there are none."""
    grasp, weight = ring(0.8, tilt=0.001), 0.2 * 9.81
    J = np.zeros((6, 1))
    index = grasp.model.normal_index(2)
    J[[index, 2 + index], 0] = 1.0
    limit = np.linspace(0.5, 1.5, LANES) * weight / 0.8
    controller = jg.ComputedTorque(jg.Gains.of_rate(10.0), torque_limits=(J, limit[:, None]))
    out = jg.close_loop(
        grasp,
        PLANAR,
        controller=controller,
        state=rested(np.zeros((LANES, 3))),
        simulation=jg.motion.Simulation(200, timestep=0.002, record=True),
    )
    torque = (np.asarray(out.force) @ J)[..., 0]
    assert (torque <= limit * (1 + 1e-9)).all() and slack(grasp, out.force) > -1e-9
    enough, short = limit > 1.01 * weight / 0.8, limit < 0.99 * weight / 0.8
    assert enough.sum() == short.sum() == 8
    assert (np.asarray(out.status)[:, enough] == C.COMMANDED.value).all()
    assert (torque[:, enough].min(0) > 0.99 * weight / 0.8).all()
    assert (np.asarray(out.status)[:, short] == C.INFEASIBLE.value).all()


def test_a_disturbed_grasp_recovers_and_settling_is_counted():
    push = np.zeros((STEPS, 3))
    push[50:60] = [1.0, 2.0, 0.01]
    out = loop(ring(), rested(np.zeros((LANES, 3))), 30.0, disturbance=push)
    error = np.asarray(out.position_error)[:, 0]
    assert error[:51].max() < 1e-7 < 1e-3 < error.max() and error[-1] < 1e-5
    step = int(out.settled(position=1e-4, orientation=1e-2)[0])
    assert error[step:].max() <= 1e-4 < error[step - 1]
    assert int(out.settled(position=1e-12, orientation=1e-12)[0]) == STEPS


def test_a_trajectory_is_followed():
    def path(t):
        return jnp.stack([0.02 * jnp.sin(3 * t), 0.01 * (1 - jnp.cos(5 * t)), 0.5 * jnp.sin(2 * t)])

    reference = jg.motion.Reference.along(path, 0.002 * np.arange(STEPS))
    start = rested(np.zeros((LANES, 3)))
    start = jg.BodyState(
        start.position, start.orientation, jnp.broadcast_to(reference.velocity[0], (LANES, 3))
    )
    out = loop(ring(), start, 30.0, reference=reference)
    assert not np.asarray(out.infeasible).any()
    moved = np.asarray(out.states.position)[:, 0]
    assert np.ptp(moved[:, 0]) > 0.015
    assert np.asarray(out.position_error).max() < 2e-4 and np.asarray(out.orientation_error).max() < 5e-3


def test_bad_lanes_say_so_and_harm_no_other():
    good = loop(ring(), rested(np.full((LANES, 3), 0.001)))
    shift = np.full((LANES, 3), 0.001)
    shift[1, 0] = np.nan
    mass, inertia = np.full(LANES, 0.2), np.full(LANES, 1e-4)
    mass[2], inertia[3] = -1.0, np.nan
    friction = np.full(LANES, 0.8)
    friction[4] = np.nan
    out = loop(ring(friction), rested(shift), body=jg.RigidBody(mass, inertia))
    assert (np.asarray(out.status)[:, 1:5] == C.INVALID.value).all()
    np.testing.assert_array_equal(np.asarray(out.force)[:, 1:5], 0)
    others = np.r_[0, 5:LANES]
    for name in ("status", "position_error", "cone_use", "force"):
        np.testing.assert_allclose(
            np.asarray(getattr(out, name))[:, others], np.asarray(getattr(good, name))[:, others], atol=1e-12
        )
    assert np.isfinite(np.asarray(out.final.position)[[0, 2, 3, 4]]).all()


@pytest.mark.slow(
    "test_errors_decay_at_the_designed_rate_with_forces_in_their_cones",
    "test_simulation.py::test_one_step_is_semi_implicit_euler",
)
def test_large_rotations_obey_the_same_linear_equation_and_mujoco_agrees():
    """In space: two-radian errors, gyroscopic bodies, matrix gains; the exponential coordinates follow
    e'' + K_v e' + K_p e = 0, and the loop around MJX is the loop around the analytic step."""
    lanes, h, steps = 16, 2e-4, 1500
    rng = np.random.default_rng(7)
    normal = rng.normal(size=(lanes, 4, 3))
    normal[:] = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    normal += 0.2 * rng.normal(size=normal.shape)
    grasp = jg.Grasp(-0.03 * normal, normal, jg.SoftFinger(1.0, 0.01))
    body = random_bodies(rng, lanes, 3, mass=(0.1, 0.3), size=0.03)
    turn = rng.normal(size=(lanes, 6))
    turn[:, 3:] *= 2.0 / np.linalg.norm(turn[:, 3:], axis=1, keepdims=True)
    turn[:, :3] *= 0.02
    start = jg.BodyState.at_rest(3, (lanes,)).displaced(
        jnp.asarray(turn), 0.5 * jnp.asarray(rng.normal(size=(lanes, 6)))
    )
    square = rng.normal(size=(2, 6, 6))
    K_p, K_v = (scale * (np.eye(6) + 0.1 * s @ s.T) for scale, s in zip((60.0, 12.0), square, strict=True))
    controller = jg.ComputedTorque(jg.Gains(K_p, K_v))
    out = jg.close_loop(
        grasp,
        body,
        controller=controller,
        state=start,
        simulation=jg.motion.Simulation(steps, timestep=h, record=True),
    )
    assert not np.asarray(out.infeasible).any()
    assert slack_soft(grasp, out.force) > -1e-9
    at = tracking_error(start, jg.motion.Reference.hold(jg.BodyState.at_rest()))
    e, rate = np.asarray(at.error), np.asarray(at.rate)
    errors = []
    for _ in range(steps):
        errors.append(e)
        rate = rate - h * (rate @ K_v + e @ K_p)
        e = e + h * rate
    wanted = np.stack(errors)
    for error, part in ((out.position_error, wanted[..., :3]), (out.orientation_error, wanted[..., 3:])):
        size = np.linalg.norm(part, axis=-1)
        assert np.abs(np.asarray(error) - size).max() < 0.005 * size.max()

    plant = jg.motion.mujoco_plant(body, timestep=h)
    other = jg.close_loop(
        grasp,
        body,
        controller=controller,
        state=start,
        simulation=jg.motion.Simulation(steps, timestep=h, plant=plant),
    )
    np.testing.assert_allclose(other.final.position, out.final.position, atol=1e-6)
    np.testing.assert_allclose(other.final.orientation, out.final.orientation, atol=1e-6)


def slack_soft(grasp, force):
    parts = np.asarray(force).reshape(*force.shape[:-1], grasp.contacts, 4)
    mu, gamma = (np.asarray(x) for x in (grasp.model.friction_coefficient, grasp.model.torsion_coefficient))
    psi = np.sqrt((parts[..., 0] ** 2 + parts[..., 1] ** 2) / mu**2 + parts[..., 3] ** 2 / gamma**2)
    return (parts[..., 2] - psi).min()


# The error ---------------------------------------------------------------------------------------------


def test_the_error_and_its_rate_in_motion():
    """Against scipy's logarithm along two tumbling motions, by finite differences."""
    rng = np.random.default_rng(43)
    a, b = random_states(rng, 10, 3), random_states(rng, 10, 3)
    ref = jg.motion.Reference(b.position, b.orientation, b.velocity, jnp.zeros((10, 6)))
    at = tracking_error(a, ref)

    def logs(t):
        def turned(state):
            q = Rotation.from_quat(np.asarray(state.orientation)[:, [1, 2, 3, 0]])
            return Rotation.from_rotvec(t * np.asarray(state.velocity)[:, 3:]) * q

        return (turned(a) * turned(b).inv()).as_rotvec()

    np.testing.assert_allclose(at.error[:, 3:], logs(0.0), atol=1e-12)
    far = np.linalg.norm(logs(0.0), axis=1) < 3.0
    np.testing.assert_allclose(at.rate[far, 3:], (logs(1e-5) - logs(-1e-5))[far] / 2e-5, atol=1e-6)


def test_references_have_exact_rates():
    def path(t):
        return jnp.concatenate([jnp.stack([t, t**2, jnp.sin(t)]), jnp.stack([jnp.sin(t), t, 0.5 * t**2])])

    times = jnp.linspace(0, 1, 5)
    reference, h = jg.motion.Reference.along(path, times), 1e-5

    def turn(t):
        return Rotation.from_rotvec(np.stack([np.asarray(path(x))[3:] for x in t]))

    omega = (turn(times + h) * turn(times - h).inv()).as_rotvec() / (2 * h)
    np.testing.assert_allclose(reference.velocity[:, 3:], omega, atol=1e-8)
    ahead, behind = jg.motion.Reference.along(path, times + h), jg.motion.Reference.along(path, times - h)
    np.testing.assert_allclose(
        reference.acceleration, (ahead.velocity - behind.velocity) / (2 * h), atol=1e-8
    )


# Cones -------------------------------------------------------------------------------------------------


def test_the_nearest_admissible_forces_are_nearest():
    rng = np.random.default_rng(43)
    grasp = jg.Grasp(
        np.eye(3), -np.eye(3), jg.SoftFinger(np.array([0.5, 0.0, 1.0]), np.array([0.1, 0.2, 0.0]))
    )
    force = jnp.asarray(rng.normal(size=(200, 12)))
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (200, *x.shape)), grasp)
    near = nearest_admissible(batch, force)
    assert float(cone_use(batch, near).max()) <= 1 + 1e-12
    np.testing.assert_allclose(nearest_admissible(batch, near), near, atol=1e-15)
    np.testing.assert_allclose(into_cones(batch, near), near, atol=1e-15)
    # the residual lies in the polar cone and is orthogonal to the projection (Moreau), in scaled coordinates
    scale = np.asarray(grasp.model.scaling(3))
    live = scale > 0
    safe = np.where(live, scale, 1)
    s, q = (np.where(live, np.asarray(f).reshape(200, 3, 4) / safe, 0) for f in (force, near))
    r = s - q
    np.testing.assert_allclose((r * q).sum(-1), 0, atol=1e-12)
    assert (np.linalg.norm(np.delete(r, 2, -1), axis=-1) <= -r[..., 2] + 1e-12).all()
    cut = into_cones(batch, force)
    assert float(cone_use(batch, cut).max()) <= 1 + 1e-12


# Regulation ---------------------------------------------------------------------------------------------


def test_the_riccati_equation_is_scipys():
    rng = np.random.default_rng(43)
    A, B = np.eye(4) + 0.1 * rng.normal(size=(5, 4, 4)), rng.normal(size=(5, 4, 2))
    found = riccati(jnp.asarray(A), jnp.asarray(B), jnp.broadcast_to(jnp.eye(4), (5, 4, 4)), 0.7)
    for i in range(5):
        np.testing.assert_allclose(
            found[i], solve_discrete_are(A[i], B[i], np.eye(4), 0.7 * np.eye(2)), rtol=1e-8
        )


def two_fingers(heights, squeeze=20.0):
    """Two hard fingers pinch a body ``heights`` above its centre of mass; and the forces that hold it."""
    n = len(heights)
    p, normal = np.zeros((n, 2, 3)), np.zeros((n, 2, 3))
    p[:, 0, 0], p[:, 1, 0], p[..., 2] = -0.03, 0.03, np.asarray(heights)[:, None]
    normal[:, 0, 0], normal[:, 1, 0] = 1, -1
    grasp = jg.Grasp(p, normal, jg.HardFinger(0.5))
    G = np.asarray(jg.grasp_map(grasp))
    carry = -np.einsum("nij,j->ni", np.linalg.pinv(G, rcond=1e-9), [0, 0, -0.2 * 9.81, 0, 0, 0])
    push = np.tile([0, 0, squeeze], 2)
    return grasp, carry + push - np.einsum("nij,njk,k->ni", np.linalg.pinv(G, rcond=1e-9), G, push)


BODY = jg.RigidBody(0.2, 1e-4 * np.diag([1.0, 1.2, 1.5])) if jax.config.jax_enable_x64 else None


def test_an_object_hanging_below_two_fingers_is_brought_to_rest():
    """Rank 5: no computed torque exists. The fingers swing it to rest, above or below their line; not on it."""
    grasp, force = two_fingers([0.02, 0.01, -0.02, 0.0])
    reg = jg.regulator(grasp, BODY, timestep=0.002, force=force, effort=3.0)
    assert reg.stabilizes.tolist() == [True, True, True, False]
    swing = np.zeros((4, 6))
    swing[:, 3:] = [0.05, 0.02, -0.03]
    swing[:, 0] = 0.002
    start = jg.BodyState.at_rest(3, (4,)).displaced(jnp.asarray(swing))
    out = jg.close_loop(
        grasp,
        BODY,
        controller=reg,
        state=start,
        simulation=jg.motion.Simulation(6000, timestep=0.002, record=True),
    )
    assert float(out.cone_use.max()) <= 1 + 1e-9
    assert np.asarray(out.position_error)[-1, :3].max() < 1e-5
    assert np.asarray(out.orientation_error)[-1, :3].max() < 1e-4
    assert set(np.asarray(out.status)[:, 3].tolist()) == {C.UNREGULATED.value}
    assert np.asarray(out.orientation_error)[-1, 3] > 0.04  # nothing turns it about the fingers' line
    # the forces that would be needed from far away leave the cones: said, and cut
    far = start.displaced(jnp.zeros((4, 6)), jnp.asarray([2.0, 1, 1, 0, 0, 0]))
    _, light = two_fingers([0.02, 0.01, -0.02, 0.0], 2.2)
    reg = jg.regulator(grasp, BODY, timestep=0.002, force=light, effort=3.0)
    rough = jg.close_loop(
        grasp,
        BODY,
        controller=reg,
        state=far,
        simulation=jg.motion.Simulation(6000, timestep=0.002, record=True),
    )
    assert C.PROJECTED.value in np.asarray(rough.status)[:, 0]
    assert float(rough.cone_use.max()) <= 1 + 1e-9


def test_regulators_say_where_there_is_none():
    grasp, force = two_fingers([0.02, 0.02, 0.02])
    force[1] *= 2  # does not carry the weight
    mass = np.array([0.2, 0.2, -1.0])
    inertia = np.broadcast_to(np.asarray(BODY.inertia), (3, 3, 3))
    reg = jg.regulator(grasp, jg.RigidBody(mass, inertia), force=force)
    assert reg.stabilizes.tolist() == [True, False, False]
    assert np.isfinite(reg.gain).all()
    assert [jg.Status(int(p)).name for p in reg.point] == ["NON_MARGINAL", "NOT_BALANCED", "INVALID"]


# Bad input ----------------------------------------------------------------------------------------------


def test_wrong_settings_raise():
    grasp, state = ring(), rested(np.zeros((LANES, 3)))
    control = jg.ComputedTorque(jg.Gains.of_rate(10.0))
    with pytest.raises(ValueError, match="too large for these gains"):
        jg.close_loop(
            grasp,
            PLANAR,
            controller=jg.ComputedTorque(jg.Gains.of_rate(500.0)),
            state=state,
            simulation=jg.motion.Simulation(10, timestep=0.01),
        )
    with pytest.raises(ValueError, match="must be a ComputedTorque"):
        jg.close_loop(
            grasp, PLANAR, controller=jg.Gains.of_rate(1.0), state=state, simulation=jg.motion.Simulation(10)
        )
    with pytest.raises(ValueError, match="all planar"):
        jg.close_loop(grasp, BODY, controller=control, state=state, simulation=jg.motion.Simulation(10))
    with pytest.raises(ValueError, match="disturbance must have shape"):
        jg.close_loop(
            grasp,
            PLANAR,
            controller=control,
            state=state,
            simulation=jg.motion.Simulation(10),
            disturbance=np.zeros((9, 3)),
        )
    with pytest.raises(ValueError, match="one a step"):
        reference = jg.motion.Reference.along(lambda t: jnp.stack([t, t, t]), jnp.arange(7.0))
        jg.close_loop(
            grasp,
            PLANAR,
            controller=control,
            state=state,
            simulation=jg.motion.Simulation(10),
            reference=reference,
        )
    with pytest.raises(ValueError, match="6 numbers"):
        jg.motion.Reference.along(lambda t: jnp.stack([t, t]), jnp.arange(7.0))
    for wrong in ((-1.0, 1.0), (np.diag([1.0, -1, 1]), 1.0), (np.ones((2, 3)), 1.0)):
        with pytest.raises(ValueError, match="must be"):
            jg.Gains(*wrong)
    two, force = two_fingers([0.02])
    reg = jg.regulator(two, BODY, timestep=0.002, force=force)
    with pytest.raises(ValueError, match="made for steps"):
        jg.close_loop(
            two,
            BODY,
            controller=reg,
            state=jg.BodyState.at_rest(3, (1,)),
            simulation=jg.motion.Simulation(10, timestep=0.001),
        )
    with pytest.raises(ValueError, match="effort must be"):
        jg.regulator(two, BODY, force=force, effort=0.0)
