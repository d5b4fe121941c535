"""Grasps: construction and its errors, the grasp map, rank, null space, internal forces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg

MODELS = [
    pytest.param(jg.Frictionless(), 2, id="frictionless-planar"),
    pytest.param(jg.Frictionless(), 3, id="frictionless"),
    pytest.param(jg.HardFinger(0.4), 2, id="hard-planar"),
    pytest.param(jg.HardFinger(0.4), 3, id="hard"),
    pytest.param(jg.SoftFinger(0.4, 0.3), 3, id="soft"),
]


def tolerance(dtype):
    return 1e-12 if dtype == "float64" else 3e-5


def contacts(seed, shape, dimension, dtype):
    rng = np.random.default_rng(seed)
    position = rng.normal(size=(*shape, dimension))
    return position.astype(dtype), (-position + 0.4 * rng.normal(size=position.shape)).astype(dtype)


def rotation(seed, dimension):
    Q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(dimension, dimension)))
    Q[:, 0] *= np.sign(np.linalg.det(Q))
    return Q


def null_dimension(V):
    return np.sum(np.linalg.norm(np.asarray(V), axis=-2) > 0.5, axis=-1)


# Construction ------------------------------------------------------------------------------------------


def test_shapes_dtypes_and_broadcasting(dtype):
    position, normal = contacts(0, (5, 1, 4), 3, dtype)
    grasp = jg.Grasp(position, np.broadcast_to(normal[0, 0], (2, 4, 3)), jg.HardFinger(0.5))
    assert grasp.batch_shape == (5, 2)
    assert (grasp.contacts, grasp.dimension, grasp.dtype) == (4, 3, jnp.dtype(dtype))
    assert grasp.model.friction.shape == grasp.active.shape == (5, 2, 4)
    assert bool(grasp.active.all())
    one = grasp[3, 1]
    assert one.batch_shape == ()
    np.testing.assert_array_equal(one.position, position[3, 0])
    with pytest.raises(IndexError, match="no batch axis"):
        one[0]


def test_integers_become_floats():
    grasp = jg.Grasp([[1, 0, 0], [-1, 0, 0]], [[-1, 0, 0], [1, 0, 0]], jg.HardFinger(1))
    assert grasp.dtype == jnp.zeros(()).dtype
    assert grasp.model.friction.dtype == grasp.dtype


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"position": np.ones((4, 4))},
            r"shape \(\*batch, k, 3\) in space or \(\*batch, k, 2\) in the plane",
        ),
        ({"position": np.ones(3)}, r"position must have shape \(\*batch, k, 3\)"),
        ({"position": np.ones((0, 3)), "normal": np.ones((0, 3))}, "k >= 1 contacts"),
        ({"normal": np.ones((4, 2))}, "normal must agree in contacts and dimension"),
        ({"normal": np.ones((3, 3))}, r"got \(4, 3\) and \(3, 3\)"),
        ({"position": np.ones((2, 4, 3)), "normal": np.ones((5, 4, 3))}, "do not broadcast"),
        ({"position": "here"}, "position must be an array of shape"),
        ({"position": np.ones((4, 3), complex)}, "position must hold real numbers, got dtype complex"),
        ({"normal": np.ones((4, 3), bool)}, "normal must hold real numbers, got dtype bool"),
        ({"model": "hard"}, r"contact model such as jaxgrasp.HardFinger\(friction=0.5\), got 'hard'"),
        (
            {"model": jg.HardFinger(np.ones(3))},
            r"friction must be a number or broadcast .* shape \(4,\), got \(3,\)",
        ),
        ({"model": jg.SoftFinger(0.5, np.ones((2, 4)))}, r"torsion .* shape \(4,\), got \(2, 4\)"),
        ({"active": np.ones(4)}, "active must be boolean"),
        ({"active": np.ones(3, bool)}, r"active .* shape \(4,\), got \(3,\)"),
        (
            {"position": np.ones((4, 2)), "normal": np.ones((4, 2)), "model": jg.SoftFinger()},
            "planar soft finger does not exist",
        ),
    ],
)
def test_wrong_structure_raises_with_the_expected_shape(change, message):
    arguments = {
        "position": np.ones((4, 3)),
        "normal": np.ones((4, 3)),
        "model": jg.HardFinger(0.5),
        "active": None,
    }
    jg.Grasp(**arguments)
    with pytest.raises(ValueError, match=message):
        jg.Grasp(**{**arguments, **change})


def test_wrong_structure_raises_under_jit_too():
    with pytest.raises(ValueError, match="contacts and dimension"):
        jax.jit(lambda p, n: jg.grasp_map(jg.Grasp(p, n, jg.HardFinger(0.5))))(
            jnp.ones((4, 3)), jnp.ones((3, 3))
        )


# The grasp map -----------------------------------------------------------------------------------------


def test_planar_map_against_hand_written_values():
    """Contacts at (2, 1) pushing along -x and at (-1, 3) pushing along +y: t = (n_y, -n_x), torque p x f."""
    grasp = jg.Grasp([[2.0, 1.0], [-1.0, 3.0]], [[-1.0, 0.0], [0.0, 2.0]], jg.HardFinger(0.5))
    expected = [[0, -1, 1, 0], [1, 0, 0, 1], [2, 1, -3, -1]]
    np.testing.assert_allclose(jg.grasp_map(grasp), expected, atol=1e-7)
    folded = np.array(expected) * [0.5, 1, 0.5, 1]
    np.testing.assert_allclose(jg.contacts.folded_grasp_map(grasp), folded, atol=1e-7)
    frictionless = jg.Grasp([[2.0, 1.0], [-1.0, 3.0]], [[-1.0, 0.0], [0.0, 2.0]], jg.Frictionless())
    np.testing.assert_allclose(jg.grasp_map(frictionless), np.array(expected)[:, 1::2], atol=1e-7)


def test_spatial_map_against_hand_written_values():
    """n = e_z gives t1 = e_x, t2 = e_y; p = (1, 2, 3) has p x e_x = (0, 3, -2), p x e_y = (-3, 0, 1)."""
    grasp = jg.Grasp([[1.0, 2.0, 3.0]], [[0.0, 0.0, 5.0]], jg.SoftFinger(0.5, 0.25))
    expected = np.array(
        [
            [1, 0, 0, 0],
            [0, 1, 0, 0],
            [0, 0, 1, 0],
            [0, -3, 2, 0],
            [3, 0, -1, 0],
            [-2, 1, 0, 1],
        ]
    )
    np.testing.assert_allclose(jg.grasp_map(grasp), expected, atol=1e-7)
    np.testing.assert_allclose(jg.contacts.folded_grasp_map(grasp), expected * [0.5, 0.5, 1, 0.25], atol=1e-7)
    hard = jg.Grasp([[1.0, 2.0, 3.0]], [[0.0, 0.0, 5.0]], jg.HardFinger(0.5))
    np.testing.assert_allclose(jg.grasp_map(hard), expected[:, :3], atol=1e-7)


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_columns_are_wrenches_and_the_normal_column_needs_no_tangents(model, dimension, dtype):
    position, normal = contacts(1, (6, 3), dimension, dtype)
    grasp = jg.Grasp(position, normal, model)
    n = model.force_size(dimension)
    G = np.asarray(jg.grasp_map(grasp)).reshape(6, -1, 3, n)
    unit = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    torque = (
        np.cross(position, unit)
        if dimension == 3
        else np.linalg.det(np.stack([position, unit], -2))[..., None]
    )
    column = np.moveaxis(G[..., model.normal_index(dimension)], 1, -1)
    np.testing.assert_allclose(column, np.concatenate([unit, torque], -1), atol=tolerance(dtype))
    force = G[:, :dimension]
    np.testing.assert_allclose(np.linalg.norm(force, axis=1)[..., : min(n, 3)], 1.0, atol=tolerance(dtype))


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_rank_is_invariant_and_the_wrench_covariant_under_rotation(model, dimension, dtype):
    """R G_i(p, n) spans what G_i(R p, R n) spans: only the spin of the tangents differs."""
    position, normal = contacts(2, (6, 3), dimension, dtype)
    R = rotation(3, dimension).astype(dtype)
    before = jg.Grasp(position, normal, model)
    after = jg.Grasp(position @ R.T, normal @ R.T, model)
    wrench = np.eye(3 if dimension == 2 else 6, dtype=dtype)
    wrench[:dimension, :dimension] = R
    if dimension == 3:
        wrench[3:, 3:] = R
    A, B = (
        wrench @ np.asarray(jg.contacts.folded_grasp_map(before)),
        np.asarray(jg.contacts.folded_grasp_map(after)),
    )
    np.testing.assert_allclose(
        A @ np.swapaxes(A, -1, -2), B @ np.swapaxes(B, -1, -2), atol=10 * tolerance(dtype)
    )
    np.testing.assert_array_equal(jg.grasp_rank(before), jg.grasp_rank(after))
    np.testing.assert_allclose(
        jg.contacts.grasp_singular_values(before),
        jg.contacts.grasp_singular_values(after),
        atol=10 * tolerance(dtype),
    )


def test_tangent_spin_turns_tangential_columns_among_themselves(dtype):
    """A normal on either side of n_z = 0 flips the frame; the set of wrenches of equal psi stays."""
    position = np.array([[0.3, -0.2, 0.1]], dtype)
    above, below = (np.array([[0.6, 0.8, z]], dtype) for z in (1e-7, -1e-7))
    grasps = [jg.Grasp(position, n, jg.SoftFinger(0.4, 0.3)) for n in (above, below)]
    first, second = (np.asarray(jg.contacts.folded_grasp_map(g)) for g in grasps)
    assert np.max(np.abs(first - second)) > 0.1
    np.testing.assert_allclose(first @ first.T, second @ second.T, atol=1e-6)
    spin = first.T @ np.linalg.pinv(first @ first.T, rcond=1e-5) @ second
    np.testing.assert_allclose(spin @ spin.T, np.eye(4), atol=1e-5)


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_rank_and_singular_values_have_no_unit(model, dimension, dtype):
    position, normal = contacts(4, (6, 3), dimension, dtype)
    scaled = model.with_coefficients(model.friction_coefficient, 1e3 * model.torsion_coefficient)
    metres, millimetres = jg.Grasp(position, normal, model), jg.Grasp(1e3 * position, normal, scaled)
    np.testing.assert_array_equal(jg.grasp_rank(metres), jg.grasp_rank(millimetres))
    np.testing.assert_allclose(
        jg.contacts.grasp_singular_values(metres),
        jg.contacts.grasp_singular_values(millimetres),
        atol=10 * tolerance(dtype),
    )


def test_mixed_grasps_are_what_their_coefficients_say(dtype):
    position, normal = contacts(5, (6, 3), 3, dtype)
    zero_torsion = jg.Grasp(position, normal, jg.SoftFinger(0.4, 0.0))
    hard = jg.Grasp(position, normal, jg.HardFinger(0.4))
    A = np.asarray(jg.contacts.folded_grasp_map(zero_torsion)).reshape(6, 6, 3, 4)
    np.testing.assert_array_equal(A[..., 3], 0.0)
    np.testing.assert_array_equal(A[..., :3].reshape(6, 6, 9), jg.contacts.folded_grasp_map(hard))
    np.testing.assert_array_equal(jg.grasp_rank(zero_torsion), jg.grasp_rank(hard))
    bare = jg.Grasp(position, normal, jg.SoftFinger(0.0, 0.0))
    frictionless = jg.Grasp(position, normal, jg.Frictionless())
    np.testing.assert_array_equal(
        np.asarray(jg.contacts.folded_grasp_map(bare)).reshape(6, 6, 3, 4)[..., 2],
        jg.contacts.folded_grasp_map(frictionless),
    )
    np.testing.assert_array_equal(jg.grasp_rank(bare), 3)
    np.testing.assert_array_equal(jg.grasp_rank(bare), jg.grasp_rank(frictionless))


def test_per_contact_coefficients(dtype):
    position, normal = contacts(6, (3,), 3, dtype)
    mu = np.array([0.0, 0.5, 1.0], dtype)
    A = np.asarray(jg.contacts.folded_grasp_map(jg.Grasp(position, normal, jg.HardFinger(mu)))).reshape(
        6, 3, 3
    )
    G = np.asarray(jg.grasp_map(jg.Grasp(position, normal, jg.HardFinger(9.0)))).reshape(6, 3, 3)
    np.testing.assert_allclose(A[..., :2], G[..., :2] * mu[:, None], atol=tolerance(dtype))
    np.testing.assert_array_equal(A[..., 2], G[..., 2])


# Padding -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_padding_changes_nothing_whatever_it_holds(model, dimension, dtype):
    position, normal = contacts(7, (6, 3), dimension, dtype)
    rubbish = np.full((6, 2, dimension), np.nan, dtype)
    rubbish[::2] = 1e6
    active = np.broadcast_to(np.array([True, True, True, False, False]), (6, 5))
    padded = jg.Grasp(
        np.concatenate([position, rubbish], 1), np.concatenate([normal, rubbish], 1), model, active
    )
    plain = jg.Grasp(position, normal, model)
    n = model.force_size(dimension)
    for of in (jg.grasp_map, jg.contacts.folded_grasp_map):
        np.testing.assert_array_equal(of(padded)[..., : 3 * n], of(plain))
        np.testing.assert_array_equal(of(padded)[..., 3 * n :], 0.0)
    np.testing.assert_array_equal(jg.grasp_rank(padded), jg.grasp_rank(plain))
    V, W = np.asarray(jg.null_space(padded)), np.asarray(jg.null_space(plain))
    np.testing.assert_array_equal(null_dimension(V), null_dimension(W))
    np.testing.assert_allclose(V[:, 3 * n :], 0.0, atol=tolerance(dtype))
    projector = V[:, : 3 * n] @ np.swapaxes(V[:, : 3 * n], -1, -2)
    np.testing.assert_allclose(projector, W @ np.swapaxes(W, -1, -2), atol=10 * tolerance(dtype))


# Null space and internal forces ------------------------------------------------------------------------


@pytest.mark.parametrize(("model", "dimension"), MODELS)
@pytest.mark.parametrize("k", [1, 3])
def test_null_space_is_orthonormal_complete_and_null(model, dimension, k, dtype):
    position, normal = contacts(8, (6, k), dimension, dtype)
    grasp = jg.Grasp(position, normal, model)
    V, G = np.asarray(jg.null_space(grasp)), np.asarray(jg.grasp_map(grasp))
    count = k * model.force_size(dimension) - np.linalg.matrix_rank(G, tol=1e-4)
    np.testing.assert_array_equal(null_dimension(V), count)
    np.testing.assert_allclose(G @ V, 0.0, atol=20 * tolerance(dtype))
    gram = np.swapaxes(V, -1, -2) @ V
    np.testing.assert_allclose(
        gram, np.eye(V.shape[-1]) * (np.arange(V.shape[-1]) < count[:, None])[:, None], atol=1e-5
    )


def test_missing_components_carry_no_internal_force(dtype):
    """mu = 0 drops f_x and f_y, gamma = 0 drops tau_n; G V = 0 still holds."""
    position, normal = contacts(9, (6, 5), 3, dtype)
    mu, gamma = np.array([0.0, 0.3, 0.3, 0.0, 0.7], dtype), np.array([0.2, 0.0, 0.2, 0.0, 0.1], dtype)
    grasp = jg.Grasp(position, normal, jg.SoftFinger(mu, gamma))
    V = np.asarray(jg.null_space(grasp))
    parts = V.reshape(6, 5, 4, 20)
    np.testing.assert_allclose(parts[:, mu == 0, :2], 0.0, atol=tolerance(dtype))
    np.testing.assert_allclose(parts[:, gamma == 0, 3], 0.0, atol=tolerance(dtype))
    np.testing.assert_allclose(np.asarray(jg.grasp_map(grasp)) @ V, 0.0, atol=20 * tolerance(dtype))
    existing = 3 * 3 + 2 * 1 + 3
    np.testing.assert_array_equal(null_dimension(V), existing - np.asarray(jg.grasp_rank(grasp)))
    assert np.max(np.abs(parts[:, mu == 0, 2])) > 0.01


def test_internal_force_part_is_a_projection_onto_the_squeezes(dtype):
    position, normal = contacts(10, (6, 4), 3, dtype)
    grasp = jg.Grasp(position, normal, jg.HardFinger(0.4))
    force = jnp.asarray(np.random.default_rng(11).normal(size=(6, 12)), dtype)
    part = jg.contacts.internal_force_part(grasp, force)
    G = np.asarray(jg.grasp_map(grasp))
    np.testing.assert_allclose(np.einsum("bij,bj->bi", G, part), 0.0, atol=20 * tolerance(dtype))
    np.testing.assert_allclose(jg.contacts.internal_force_part(grasp, part), part, atol=20 * tolerance(dtype))
    rest = np.asarray(force - part)
    np.testing.assert_allclose(np.sum(rest * np.asarray(part), -1), 0.0, atol=20 * tolerance(dtype))
    expected = np.asarray(force) - np.einsum("bij,bj->bi", np.linalg.pinv(G) @ G, force)
    np.testing.assert_allclose(part, expected, atol=20 * tolerance(dtype))


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_jit_and_vmap_agree_with_the_batch_and_keep_the_dtype(model, dimension, dtype):
    position, normal = contacts(12, (6, 3), dimension, dtype)
    grasp = jg.Grasp(position, normal, model, np.arange(18).reshape(6, 3) % 5 != 4)

    def answers(grasp):
        V = jg.null_space(grasp)
        return (
            jg.grasp_map(grasp),
            jg.contacts.folded_grasp_map(grasp),
            jg.contacts.grasp_singular_values(grasp),
            V @ jnp.swapaxes(V, -1, -2),
            jg.contacts.internal_force_part(grasp, jnp.ones(V.shape[:-1], dtype)),
        )

    for a, b in zip(answers(grasp), jax.jit(jax.vmap(answers))(grasp), strict=True):
        assert a.dtype == b.dtype == jnp.dtype(dtype)
        np.testing.assert_allclose(a, b, atol=10 * tolerance(dtype))
    np.testing.assert_array_equal(jg.grasp_rank(grasp), jax.jit(jax.vmap(jg.grasp_rank))(grasp))


def test_float32_grasps_stay_float32_beside_x64():
    position, normal = contacts(13, (4, 3), 3, np.float32)
    grasp = jg.Grasp(position, normal, jg.SoftFinger(0.4, 0.3))
    for answer in (
        jg.grasp_map(grasp),
        jg.contacts.folded_grasp_map(grasp),
        jg.contacts.grasp_singular_values(grasp),
        jg.null_space(grasp),
    ):
        assert answer.dtype == jnp.float32
