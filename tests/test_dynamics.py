"""(11.18)-(11.24): rotations, mass matrix, Coriolis and gravity terms, G^W, bodies that are none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import random_rotation
from motion import random_bodies, random_states
from scipy.spatial.transform import Rotation

import jaxgrasp as jg
from jaxgrasp.core.rotations import (
    jacobian_product,
    jacobian_solve,
    orientation_matrix,
    rotate,
    rotation_between,
    turned,
)

pytestmark = pytest.mark.f32


def close(dtype):
    return 1e-12 if dtype == "float64" else 2e-5


ANGLES = np.array([0.0, 1e-9, 1e-4, 0.1, 0.2235, 0.2237, 1.0, 2.0, 3.0, 3.14159])


def rotation_vectors(dtype):
    rng = np.random.default_rng(41)
    axes = rng.normal(size=(len(ANGLES), 3))
    return (ANGLES[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True)).astype(dtype)


# Rotations -------------------------------------------------------------------------------------------


def test_the_exponential_and_the_matrix_are_scipys(dtype):
    rng = np.random.default_rng(40)
    v = rotation_vectors(dtype)
    start = jg.BodyState.at_rest(3, (len(v),), dtype).orientation
    q = turned(start, jnp.asarray(v))
    wanted = Rotation.from_rotvec(v.astype(float)).as_matrix()
    np.testing.assert_allclose(orientation_matrix(q), wanted, atol=close(dtype))
    x = rng.normal(size=v.shape).astype(dtype)
    np.testing.assert_allclose(
        rotate(q, jnp.asarray(x)), np.einsum("nij,nj->ni", wanted, x), atol=close(dtype)
    )
    np.testing.assert_allclose(rotate(q, rotate(q, jnp.asarray(x)), inverse=True), x, atol=close(dtype))


def test_the_logarithm_undoes_the_exponential(dtype):
    v = rotation_vectors(dtype)
    reference = Rotation.random(len(v), random_state=1).as_quat()[:, [3, 0, 1, 2]].astype(dtype)
    q = turned(jnp.asarray(reference), jnp.asarray(v))
    np.testing.assert_allclose(rotation_between(q, jnp.asarray(reference)), v, atol=20 * close(dtype))
    # a quaternion and its negative are one rotation
    np.testing.assert_allclose(rotation_between(-q, jnp.asarray(reference)), v, atol=20 * close(dtype))


def test_the_jacobian_is_the_derivative_of_the_exponential(dtype):
    rng = np.random.default_rng(40)
    if dtype != "float64":
        pytest.skip("finite differences need float64")
    v, rate, h = rotation_vectors(dtype)[:-1], rng.normal(size=(len(ANGLES) - 1, 3)), 1e-5
    after = Rotation.from_rotvec(v + h * rate) * Rotation.from_rotvec(v - h * rate).inv()
    omega = jacobian_product(jnp.asarray(v), jnp.asarray(rate))
    np.testing.assert_allclose(omega, after.as_rotvec() / (2 * h), atol=1e-8)
    np.testing.assert_allclose(jacobian_solve(jnp.asarray(v), omega), rate, atol=1e-10)


def test_rotations_have_derivatives_at_zero(dtype):
    zero, start = jnp.zeros(3, dtype), jg.BodyState.at_rest(3, (), dtype).orientation
    for function in (
        lambda v: rotation_between(turned(start, v), start),
        lambda v: jacobian_product(v, jnp.ones(3, dtype)),
        lambda v: jacobian_solve(v, jnp.ones(3, dtype)),
    ):
        assert np.isfinite(jax.jit(jax.jacfwd(jax.jacrev(function)))(zero)).all()
    np.testing.assert_allclose(
        jax.jacrev(lambda v: rotation_between(turned(start, v), start))(zero), np.eye(3), atol=close(dtype)
    )


def test_planar_rotations_are_angles(dtype):
    angle = jnp.asarray([[0.3], [4.0]], dtype)
    turn = turned(angle, jnp.asarray([[0.1], [0.1]], dtype))
    np.testing.assert_allclose(rotation_between(turn, angle), 0.1, atol=close(dtype))
    c, s = np.cos(0.3), np.sin(0.3)
    np.testing.assert_allclose(orientation_matrix(angle)[0], [[c, -s], [s, c]], atol=close(dtype))


# Equations of motion ---------------------------------------------------------------------------------


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_equation_of_motion_holds(dimension, dtype):
    """M q'' + B + G = G^W f with every term from its own function, forces in random poses."""
    rng = np.random.default_rng(40)
    n, k = 20, 3
    body = random_bodies(rng, n, dimension, dtype)
    state = random_states(rng, n, dimension, dtype)
    position = rng.normal(size=(n, k, dimension)).astype(dtype)
    grasp = jg.Grasp(position, -position, jg.HardFinger(jnp.asarray(0.5, dtype)))
    force = jnp.asarray(rng.normal(size=(n, k * dimension)).astype(dtype))
    wrench = jnp.einsum("nij,nj->ni", jg.motion.world_grasp_map(grasp, state.orientation), force)
    qdd = jg.motion.acceleration(body, state, wrench)
    left = jnp.einsum("nij,nj->ni", jg.motion.mass_matrix(body, state.orientation), qdd)
    left += jg.motion.coriolis(body, state) + jg.motion.gravity_term(body)
    np.testing.assert_allclose(left, wrench, atol=50 * close(dtype))


def test_the_terms_are_newtons_and_eulers(dtype):
    """In numpy, from R, I and omega alone."""
    rng = np.random.default_rng(40)
    body, state = random_bodies(rng, 5, 3, dtype), random_states(rng, 5, 3, dtype)
    R = Rotation.from_quat(np.asarray(state.orientation, float)[:, [1, 2, 3, 0]]).as_matrix()
    inertia = R @ np.asarray(body.inertia, float) @ R.transpose(0, 2, 1)
    omega = np.asarray(state.velocity[:, 3:], float)
    torque = np.cross(omega, np.einsum("nij,nj->ni", inertia, omega))
    np.testing.assert_allclose(jg.motion.coriolis(body, state)[:, 3:], torque, atol=close(dtype))
    np.testing.assert_allclose(jg.motion.coriolis(body, state)[:, :3], 0)
    M = jg.motion.mass_matrix(body, state.orientation)
    np.testing.assert_allclose(M[:, 3:, 3:], inertia, atol=close(dtype))
    np.testing.assert_allclose(
        M[:, :3, :3], np.asarray(body.mass)[:, None, None] * np.eye(3), atol=close(dtype)
    )
    np.testing.assert_allclose(M[:, :3, 3:], 0)
    weight = jg.motion.gravity_term(body, gravity=(0.0, 0.0, -10.0))
    np.testing.assert_allclose(weight[:, 2], 10 * np.asarray(body.mass), rtol=1e-6)


def test_contact_forces_turn_with_the_body(dtype):
    position = np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.1, 0]], dtype)
    grasp = jg.Grasp(position, -position, jg.HardFinger(jnp.asarray(0.5, dtype)))
    quarter = turned(jg.BodyState.at_rest(3, (), dtype).orientation, jnp.asarray([0, 0, np.pi / 2], dtype))
    G, R = np.asarray(jg.grasp_map(grasp)), np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    wanted = np.concatenate([R @ G[:3], R @ G[3:]])
    np.testing.assert_allclose(jg.motion.world_grasp_map(grasp, quarter), wanted, atol=close(dtype))


def test_a_free_body_keeps_momentum_and_nearly_its_energy(dtype):
    rng = np.random.default_rng(40)
    if dtype != "float64":
        pytest.skip("drift over a thousand steps is measured in float64")
    body, state = random_bodies(rng, 4, 3, dtype), random_states(rng, 4, 3, dtype)
    none, h = jnp.zeros((4, 6)), 1e-4

    def momentum(s):
        return jnp.einsum("nij,nj->ni", jg.motion.mass_matrix(body, s.orientation), s.velocity)

    def step(_, s):
        return jg.motion.advance(body, s, none, timestep=h, gravity=(0.0, 0.0, 0.0))

    after = jax.jit(lambda s: jax.lax.fori_loop(0, 1000, step, s))(state)
    scale = np.abs(momentum(state)).max()
    np.testing.assert_allclose(momentum(after), momentum(state), atol=2e-3 * scale)
    energies = [0.5 * jnp.sum(s.velocity * momentum(s), -1) for s in (state, after)]
    np.testing.assert_allclose(energies[1], energies[0], rtol=5e-3)


def test_falling_is_exact(dtype):
    """v = g t, and semi-implicit Euler's p = g h^2 n (n + 1) / 2."""
    body = jg.RigidBody(jnp.asarray(0.2, dtype), 1e-4 * jnp.eye(3, dtype=dtype))
    state = jg.BodyState.at_rest(3, (), dtype)
    for _ in range(10):
        state = jg.motion.advance(body, state, jnp.zeros(6, dtype), timestep=0.01)
    np.testing.assert_allclose(state.velocity, [0, 0, -0.981, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(state.position, [0, 0, -9.81 * 0.01**2 * 55], atol=1e-6)


def test_a_body_from_a_mesh(dtype):
    import trimesh

    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.apply_translation((1, 2, 3))
    body = jg.RigidBody.from_mesh(box, density=1000)
    assert float(body.mass) == pytest.approx(6.0)
    wanted = 6 / 12 * np.array([0.2**2 + 0.3**2, 0.1**2 + 0.3**2, 0.1**2 + 0.2**2])
    np.testing.assert_allclose(body.inertia, np.diag(wanted), atol=1e-7)
    np.testing.assert_allclose(jg.RigidBody.from_mesh(box, mass=6.0).inertia, body.inertia, rtol=1e-6)
    assert float(body.gyration_radius) == pytest.approx(np.sqrt(wanted.sum() / 6))


def test_derivatives_reach_mass_and_inertia(dtype):
    rng = np.random.default_rng(40)
    state = random_states(rng, 1, 3, dtype)
    state = jax.tree.map(lambda x: x[0], state)
    inertia = jnp.diag(jnp.asarray([1.0, 1.2, 1.5], dtype))

    def speed(mass, inertia):
        body = jg.RigidBody(mass, inertia)
        return jnp.sum(jg.motion.acceleration(body, state, jnp.ones(6, dtype)) ** 2)

    grads = jax.grad(speed, argnums=(0, 1))(jnp.asarray(2.0, dtype), inertia)
    h = 1e-6 if dtype == "float64" else 1e-2
    numeric = (speed(jnp.asarray(2 + h, dtype), inertia) - speed(jnp.asarray(2 - h, dtype), inertia)) / (
        2 * h
    )
    np.testing.assert_allclose(grads[0], numeric, rtol=1e-6 if dtype == "float64" else 1e-2)
    assert np.isfinite(grads[1]).all() and np.abs(grads[1]).max() > 0


# Bodies that are none --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mass", "inertia", "words"),
    [
        (-1.0, np.eye(3), "mass must be a positive"),
        (0.0, np.eye(3), "mass must be a positive"),
        (float("nan"), np.eye(3), "mass must be a positive"),
        (1.0, np.diag([1.0, 1.0, -1.0]), "positive definite"),
        (1.0, np.zeros((3, 3)), "positive definite"),
        (1.0, np.diag([1.0, 1.0, 3.0]), "triangle"),
        (1.0, np.eye(3) + np.triu(np.ones((3, 3)), 1), "symmetric"),
        (1.0, np.full((3, 3), np.nan), "finite"),
        (1.0, -1.0, "positive definite"),
        (1.0, np.ones((2, 2)), "must have shape"),
        (np.ones(3), np.ones((4, 3, 3)), "do not broadcast"),
        ("heavy", np.eye(3), "mass must"),
    ],
)
def test_a_single_wrong_body_raises(mass, inertia, words):
    with pytest.raises(ValueError, match=words):
        jg.RigidBody(mass, inertia)


def test_wrong_bodies_in_a_batch_are_marked_and_harm_no_other(dtype):
    good = np.diag([1.0, 2.0, 2.5])
    lanes = [
        good,
        np.diag([1, 1, 3.0]),
        good,
        np.full((3, 3), np.nan),
        np.diag([0, 1, 1.0]),
        good,
        1e-9 * good,
    ]
    mass = np.array([1.0, 1, -1, 1, 1, np.inf, 1e-9])
    body = jg.RigidBody(jnp.asarray(mass.astype(dtype)), jnp.asarray(np.stack(lanes).astype(dtype)))
    assert body.valid.tolist() == [True, False, False, False, False, False, True]
    flat = jg.RigidBody(1.0, jnp.asarray(np.diag([1.0, 2.0, 3.0]), dtype))
    assert bool(flat.valid)
    safe = body.where(body.valid)
    assert np.isfinite(safe.inertia).all() and np.isfinite(safe.mass).all()
    np.testing.assert_array_equal(safe.inertia[0], good.astype(dtype))


def test_wrong_meshes_raise():
    import trimesh

    box = trimesh.creation.box()
    with pytest.raises(ValueError, match="density"):
        jg.RigidBody.from_mesh(box)
    box.update_faces(np.arange(len(box.faces)) > 0)
    with pytest.raises(ValueError, match="no volume"):
        jg.RigidBody.from_mesh(box, density=1.0)


def test_gravity_must_be_a_vector(dtype):
    body = jg.RigidBody(1.0, np.eye(3))
    with pytest.raises(ValueError, match="gravity must be a vector of 3"):
        jg.motion.gravity_term(body, gravity=(0.0, -9.81))


def test_rotating_everything_rotates_the_answer(dtype):
    """The equations do not know where the axes point."""
    rng = np.random.default_rng(40)
    turn = random_rotation(rng)
    q = Rotation.from_matrix(turn).as_quat()[[3, 0, 1, 2]].astype(dtype)
    body, state = random_bodies(rng, 3, 3, dtype), random_states(rng, 3, 3, dtype)
    from jaxgrasp.core.rotations import quaternion_product

    wrench, g = rng.normal(size=(3, 6)).astype(dtype), rng.normal(size=3).astype(dtype)
    both = np.kron(np.eye(2), turn).astype(dtype)
    moved = jg.BodyState(
        state.position @ turn.T.astype(dtype),
        quaternion_product(jnp.broadcast_to(jnp.asarray(q), (3, 4)), state.orientation),
        state.velocity @ both.T,
    )
    first = jg.motion.acceleration(body, state, jnp.asarray(wrench), gravity=g)
    second = jg.motion.acceleration(
        body, moved, jnp.asarray(wrench @ both.T), gravity=jnp.asarray(turn.astype(dtype) @ g)
    )
    np.testing.assert_allclose(second, first @ both.T, atol=50 * close(dtype))
