"""MuJoCo against the analytic dynamics: accelerations, steps, their derivatives in tangent coordinates, roll-outs."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import random_contacts
from motion import random_bodies, random_states

import jaxgrasp as jg
from jaxgrasp.motion.linearization import _blocks
from jaxgrasp.motion.mujoco import tangent, tangent_difference

pytestmark = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="both engines are compared in float64")
H = 0.002
N, K = 1000, 4


def relative(a, b):
    """Largest difference of each lane, relative to the lane's largest entry or 1."""
    a, b = np.asarray(a).reshape(len(a), -1), np.asarray(b).reshape(len(b), -1)
    return np.abs(a - b).max(1) / np.maximum(1, np.abs(b).max(1))


@pytest.fixture(scope="module")
def scene():
    """1 000 bodies of 0.05 to 2 kg and about 4 cm with four fingers, in equilibrium under gravity of any direction."""
    rng = np.random.default_rng(42)
    body = random_bodies(rng, N, 3, mass=(0.05, 2.0), size=0.04)
    position, normal, _ = random_contacts(rng, N, K, 3)
    grasp = jg.Grasp(0.04 * position, normal, jg.HardFinger(0.5))
    gravity = np.array([1.0, -2.0, -9.0])
    load = np.concatenate([np.asarray(body.mass)[:, None] * gravity, np.zeros((N, 3))], axis=1)
    G = np.asarray(jg.grasp_map(grasp))
    held = np.linalg.matrix_rank(G, 1e-6) == 6
    assert held.sum() > 500  # the rest are pushed by forces that do not balance
    force = -np.einsum("nij,nj->ni", np.linalg.pinv(G, rcond=1e-9), load)
    force += 0.2 * rng.normal(size=force.shape) * ~held[:, None]
    return (
        body,
        grasp,
        jnp.asarray(force),
        gravity,
        held,
        jg.motion.mujoco_plant(body, timestep=H, gravity=gravity),
    )


def test_accelerations_agree_in_any_state(scene):
    body, grasp, force, gravity, _, plant = scene
    state = random_states(np.random.default_rng(1), N, 3, speed=3.0)
    wrench = jnp.einsum("nij,nj->ni", jg.motion.world_grasp_map(grasp, state.orientation), force)
    ours = jg.motion.acceleration(body, state, wrench, gravity=gravity)
    assert relative(plant.acceleration(state, wrench), ours).max() < 1e-9


def test_one_step_is_semi_implicit_euler(scene):
    body, grasp, force, gravity, _, plant = scene
    state = random_states(np.random.default_rng(2), N, 3, speed=3.0)
    wrench = jnp.einsum("nij,nj->ni", jg.motion.world_grasp_map(grasp, state.orientation), force)
    theirs, ours = (
        plant.advance(state, wrench),
        jg.motion.advance(body, state, wrench, timestep=H, gravity=gravity),
    )
    assert relative(tangent_difference(theirs, ours), np.zeros((N, 12))).max() < 1e-9


@pytest.fixture(scope="module")
def derivatives(scene):
    _, grasp, force, _, _, plant = scene
    rest = jg.BodyState.at_rest(3, (N,))
    return (
        plant.acceleration_derivatives(rest, grasp, force),
        plant.step_derivatives(rest, grasp, force),
    )


@pytest.mark.slow("test_derivatives_hold_in_motion_too")
def test_A_and_B_are_mujocos(scene, derivatives):
    """(11.29) against d qacc / d (tangent, f) on 1 000 bodies and grasps, 1e-6; the factor g included."""
    body, grasp, _, gravity, held, _ = scene
    A_c, B_c = _blocks(grasp, body, jnp.broadcast_to(jnp.asarray(gravity), (N, 3)))
    by_state, by_force = derivatives[0]
    analytic = jnp.concatenate([A_c, jnp.zeros((N, 6, 6))], axis=-1)
    assert relative(by_state, analytic)[held].max() < 1e-6
    assert relative(by_force, B_c).max() < 1e-6
    assert relative(0.9 * by_state, analytic)[held].min() > 1e-3  # the test can fail


@pytest.mark.slow("test_one_step_is_semi_implicit_euler", "test_derivatives_hold_in_motion_too")
def test_mujocos_step_is_their_semi_implicit_image(scene, derivatives):
    """``[[I + h^2 A_c, h I], [h A_c, I]]`` and ``[h^2 B_c; h B_c]`` to 1e-6."""
    body, grasp, _, gravity, held, _ = scene
    A_c, B_c = _blocks(grasp, body, jnp.broadcast_to(jnp.asarray(gravity), (N, 3)))
    unit = jnp.broadcast_to(jnp.eye(6), (N, 6, 6))
    A = jnp.concatenate(
        [jnp.concatenate([unit + H**2 * A_c, H * unit], -1), jnp.concatenate([H * A_c, unit], -1)], -2
    )
    by_state, by_force = derivatives[1]
    assert relative(by_state, A)[held].max() < 1e-6
    B = jnp.concatenate([H**2 * B_c, H * B_c], axis=1)
    assert relative(by_force, B).max() < 1e-6


@pytest.mark.slow("test_dynamics.py::test_rotations_have_derivatives_at_zero")
def test_mjx_alone_forgets_how_a_resting_body_starts_to_turn():
    """Why the plant integrates rotations below 1e-8 rad/s itself. Fails when MJX no longer needs that."""
    from jaxgrasp.motion.mujoco import _mjx

    plant = jg.motion.mujoco_plant(jg.RigidBody(1.0, np.eye(3)), timestep=H)

    def turned_by(omega):
        data = plant.template.replace(qvel=jnp.concatenate([jnp.zeros(3), omega]))
        with jax.numpy_dtype_promotion("standard"):
            return _mjx().step(plant.model, data).qpos[4:]

    assert np.abs(jax.jacfwd(turned_by)(jnp.zeros(3))).max() == 0
    np.testing.assert_allclose(jax.jacfwd(turned_by)(jnp.full(3, 1e-7)), H / 2 * np.eye(3), atol=1e-9)


def test_derivatives_hold_in_motion_too(scene):
    """At any state, against automatic derivatives of the analytic acceleration in the same coordinates."""
    body, grasp, force, gravity, _, plant = scene
    few = jax.tree.map(lambda x: x[:20], (body, grasp, force))
    state = random_states(np.random.default_rng(3), 20, 3, speed=3.0)
    plant = jg.motion.mujoco_plant(few[0], timestep=H, gravity=gravity)

    def one(body, grasp, force, state):
        def motion(x, f):
            moved = tangent(state, x)
            return jg.motion.acceleration(
                body, moved, jg.motion.world_grasp_map(grasp, moved.orientation) @ f, gravity=gravity
            )

        return jax.jacfwd(motion, argnums=(0, 1))(jnp.zeros(12), force)

    wanted = jax.vmap(one)(*few, state)
    found = plant.acceleration_derivatives(state, few[1], few[2])
    for a, b in zip(found, wanted, strict=True):
        assert relative(a, b).max() < 1e-8


@pytest.mark.slow("test_derivatives_hold_in_motion_too")
def test_reverse_mode_gives_the_same(scene):
    body, grasp, force, gravity, _, _ = scene
    one = jax.tree.map(lambda x: x[0], (body, grasp, force))
    plant, state = jg.motion.mujoco_plant(one[0], timestep=H, gravity=gravity), jg.BodyState.at_rest()

    def fallen(force):
        wrench = jg.motion.world_grasp_map(one[1], state.orientation) @ force
        return jnp.sum(plant.advance(state, wrench).velocity ** 2)

    direction = jnp.ones(12)
    forward = jax.jvp(fallen, (one[2],), (direction,))[1]
    np.testing.assert_allclose(jax.grad(fallen)(one[2]) @ direction, forward, rtol=1e-10)


def c_engine(body, grasp, force, start, gravity):
    """States (T, N) of MuJoCo's C engine, one body after the other; ``force`` (T, N, k n) turns with the bodies."""
    import mujoco

    G, R = np.asarray(jg.grasp_map(grasp)), np.zeros(9)
    wrench = np.einsum("nij,tnj->tni", G, np.asarray(force))
    states = np.zeros((len(force), len(G), 13))
    for i in range(len(G)):
        model = jg.motion.mujoco_model(jax.tree.map(lambda x, i=i: x[i], body), timestep=H, gravity=gravity)
        data = mujoco.MjData(model)
        data.qpos[:] = np.concatenate([start.position[i], start.orientation[i]])
        mujoco.mju_quat2Mat(R, data.qpos[3:])
        data.qvel[:3], data.qvel[3:] = start.velocity[i, :3], R.reshape(3, 3).T @ start.velocity[i, 3:]
        for step in range(len(force)):
            data.xfrc_applied[1] = (R.reshape(3, 3) @ wrench[step, i].reshape(2, 3).T).T.ravel()
            mujoco.mj_step(model, data)
            mujoco.mju_quat2Mat(R, data.qpos[3:])
            spin = R.reshape(3, 3) @ data.qvel[3:]
            states[step, i] = np.concatenate([data.qpos, data.qvel[:3], spin])
    return jg.BodyState(*(jnp.asarray(x) for x in np.split(states, [3, 7], axis=-1)))


@pytest.mark.slow("test_one_step_is_semi_implicit_euler")
def test_rollouts_are_those_of_the_c_engine(scene):
    """125 bodies, 100 steps, random forces that turn with the body, from a tumbling start: MJX and the analytic step,
    to 1e-6 at every step."""
    rng = np.random.default_rng(4)
    body, grasp, held, gravity = *jax.tree.map(lambda x: x[::8], scene[:3]), scene[3]
    count = len(held)
    start = random_states(rng, count, 3, speed=2.0)
    size = np.asarray(body.mass)[:, None]  # each step another force, of about a tenth of the weight
    force = held + jnp.asarray(size * rng.normal(size=(100, *held.shape)))
    path = jg.motion.mujoco_plant(body, timestep=H, gravity=gravity).roll_out(start, grasp, force)

    def step(now, f):
        wrench = jnp.einsum("nij,nj->ni", jg.motion.world_grasp_map(grasp, now.orientation), f)
        after = jg.motion.advance(body, now, wrench, timestep=H, gravity=gravity)
        return after, after

    ours = jax.lax.scan(step, start, force)[1]
    engine = c_engine(body, grasp, force, start, gravity)
    moved = np.abs(tangent_difference(jax.tree.map(lambda x: x[-1], engine), start)).max(1)
    assert count == 125 and moved.min() > 0.1
    scale = np.maximum(1, moved)
    mjx, analytic = (np.abs(tangent_difference(x, engine)).max(2) / scale for x in (path, ours))
    print(f"largest difference from the C engine: MJX {mjx.max():.1e}, analytic {analytic.max():.1e}")
    assert mjx.max() < 1e-6 and analytic.max() < 1e-6


def test_the_model_has_no_contacts_and_shows_the_mesh():
    import mujoco
    import trimesh

    box = trimesh.creation.box((0.04, 0.05, 0.06))
    body = jg.RigidBody.from_mesh(box, mass=0.3)
    model = jg.motion.mujoco_model(body, mesh=box)
    assert (model.ngeom, model.nv, model.body_mass[1]) == (1, 6, pytest.approx(0.3))
    assert model.geom_contype[0] == 0 and model.geom_conaffinity[0] == 0
    np.testing.assert_allclose(np.sort(model.body_inertia[1]), np.sort(np.diag(body.inertia)), rtol=1e-12)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qacc, [0, 0, -9.81, 0, 0, 0], atol=1e-12)


SHAPES = {
    "block": (0.4, 0.6, 0.8),
    "plate": (1, 0.7, 1e-5),
    "square plate": (1, 1, 1e-3),
    "rod": (1, 1e-4, 1e-4),
}


@pytest.mark.parametrize("scale", [1e-6, 1e-4, 1e-3, 0.1, 1e3])
@pytest.mark.parametrize("shape", list(SHAPES))
def test_bodies_of_any_size(shape, scale):
    """Exact principal moments, turned and far from the origin; or one line that says too small."""
    import trimesh

    sides = scale * np.array(SHAPES[shape])
    mesh = trimesh.creation.box(sides)
    turn = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))
    mesh.apply_transform(turn)
    mesh.apply_translation((3 * scale, -2 * scale, scale))
    mass = 1000 * sides.prod()
    squares = sides**2
    moments = np.sort(mass / 12 * (squares.sum() - squares))
    body = jg.RigidBody.from_mesh(mesh, density=1000)
    assert float(body.mass) == pytest.approx(mass, rel=1e-9)
    axes = turn[:3, :3]
    inertia = axes @ np.diag(mass / 12 * (squares.sum() - squares)) @ axes.T
    np.testing.assert_allclose(body.inertia, inertia, rtol=1e-8, atol=1e-9 * moments[2])
    np.testing.assert_allclose(np.linalg.eigvalsh(body.inertia), moments, rtol=1e-7)
    if min(mass, moments[0]) > 1e-15:
        model = jg.motion.mujoco_model(body)
        np.testing.assert_allclose(np.sort(model.body_inertia[1]), moments, rtol=1e-7)
        plant = jg.motion.mujoco_plant(body)
        np.testing.assert_allclose(np.sort(plant.model.body_inertia[1]), moments, rtol=1e-7)
        return
    for make in (jg.motion.mujoco_model, jg.motion.mujoco_plant):
        with pytest.raises(ValueError, match="too small for MuJoCo: mass") as error:
            make(body)
        assert len(str(error.value).splitlines()) == 1


def test_wrong_models_raise():
    body = jg.RigidBody(1.0, np.eye(3))
    with pytest.raises(ValueError, match="spatial bodies"):
        jg.motion.mujoco_plant(jg.RigidBody(1.0, 1.0))
    with pytest.raises(ValueError, match="timestep must be"):
        jg.motion.mujoco_plant(body, timestep=-0.1)
    with pytest.raises(ValueError, match="holds one body"):
        jg.motion.mujoco_model(jg.RigidBody(np.ones(2), np.stack([np.eye(3)] * 2)))
    with pytest.raises(ValueError, match=r"body \[1\] is none"):
        jg.motion.mujoco_plant(jg.RigidBody(np.array([1.0, -1.0]), np.stack([np.eye(3)] * 2)))


def test_nothing_is_printed_and_nothing_imported_before_it_is_needed():
    code = (
        "import sys, numpy as np, jaxgrasp as jg; assert 'mujoco' not in sys.modules; "
        "jg.motion.mujoco_plant(jg.RigidBody(1.0, np.eye(3))); assert 'mujoco' in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
