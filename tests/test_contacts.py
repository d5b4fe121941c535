"""Contact models: friction function, dual cone, LMI matrices, conventions for mu = 0 and gamma = 0."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.contacts.models import Component

MU, GAMMA = 0.4, 0.02
MODELS = [
    pytest.param(jg.Frictionless(), 2, id="frictionless-planar"),
    pytest.param(jg.Frictionless(), 3, id="frictionless"),
    pytest.param(jg.HardFinger(MU), 2, id="hard-planar"),
    pytest.param(jg.HardFinger(MU), 3, id="hard"),
    pytest.param(jg.SoftFinger(MU, GAMMA), 3, id="soft"),
]


def tolerance(dtype):
    return 1e-12 if dtype == "float64" else 2e-5


@eqx.filter_jit
def ask(model, question, *arguments):
    return getattr(model, question)(*arguments)


@eqx.filter_jit
def sized(model, shape, dtype):
    """The model with one coefficient per contact, as a grasp holds it."""
    return model.with_coefficients(
        jnp.broadcast_to(model.friction_coefficient.astype(dtype), shape),
        jnp.broadcast_to(model.torsion_coefficient.astype(dtype), shape),
    )


def lmi(model, force, dimension):
    return np.einsum("...j,...jab->...ab", force, ask(model, "lmi_matrices", dimension))


def random_forces(model, dimension, count, dtype, seed=0):
    rng = np.random.default_rng(seed)
    scale = np.asarray(ask(model, "scaling", dimension))
    force = rng.normal(size=(count, model.force_size(dimension))) * scale
    force[..., model.normal_index(dimension)] = rng.normal(1.0, 1.0, size=count)
    return jnp.asarray(force, dtype)


@pytest.mark.parametrize(
    ("model", "dimension", "names"),
    [
        (jg.Frictionless(), 2, ["f_n"]),
        (jg.Frictionless(), 3, ["f_n"]),
        (jg.HardFinger(), 2, ["f_x", "f_n"]),
        (jg.HardFinger(), 3, ["f_x", "f_y", "f_n"]),
        (jg.SoftFinger(), 3, ["f_x", "f_y", "f_n", "tau_n"]),
    ],
)
def test_components_are_in_the_order_of_the_chapter(model, dimension, names):
    components = model.components(dimension)
    assert [c.value for c in components] == names
    assert model.force_size(dimension) == len(names)
    assert components[model.normal_index(dimension)] is Component.NORMAL


def test_friction_function_known_values():
    soft = jg.SoftFinger(0.5, 0.1)
    force = jnp.asarray([0.3, 0.4, 2.0, 0.0])
    np.testing.assert_allclose(ask(soft, "friction_function", force, 3), 1.0, rtol=1e-6)
    np.testing.assert_allclose(ask(soft, "feasibility_slack", force, 3), 1.0, rtol=1e-6)
    np.testing.assert_allclose(
        ask(soft, "friction_function", force.at[3].set(0.1), 3), np.sqrt(2.0), rtol=1e-6
    )
    np.testing.assert_allclose(
        jg.HardFinger(0.5).feasibility_slack(jnp.asarray([0.6, 0.8, 2.0]), 3), 0.0, atol=1e-6
    )
    np.testing.assert_allclose(
        jg.HardFinger(0.5).feasibility_slack(jnp.asarray([-1.0, 3.0]), 2), 1.0, rtol=1e-6
    )
    np.testing.assert_allclose(jg.Frictionless().feasibility_slack(jnp.asarray([3.0]), 3), 3.0)


def test_a_component_without_coefficient_is_infeasible_and_a_zero_one_is_not():
    model = jg.SoftFinger(jnp.asarray([0.0, 0.5]), jnp.asarray([0.1, 0.0]))
    with_it = jnp.asarray([[0.1, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.01]])
    np.testing.assert_array_equal(ask(model, "friction_function", with_it, 3), [np.inf, np.inf])
    without = jnp.asarray([[0.0, 0.0, 1.0, 0.05], [0.3, 0.4, 1.0, 0.0]])
    np.testing.assert_allclose(ask(model, "friction_function", without, 3), [0.5, 1.0], rtol=1e-6)


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_lmi_holds_exactly_where_the_force_is_feasible(model, dimension, dtype):
    model = sized(model, (60,), dtype)
    force = random_forces(model, dimension, 60, dtype)
    slack = np.asarray(ask(model, "feasibility_slack", force, dimension))
    eigenvalues = np.linalg.eigvalsh(lmi(model, force, dimension))
    assert 10 < np.sum(slack > 0) <= 50
    np.testing.assert_array_equal(eigenvalues[:, 0] >= 0, slack >= 0)


def test_eigenvalues_of_11_4(dtype):
    """(11.6)-(11.8): mu f_n and mu f_n -+ |f_t|; in the plane only the pair."""
    for dimension in (2, 3):
        model = sized(jg.HardFinger(MU), (60,), dtype)
        force = random_forces(model, dimension, 60, dtype, seed=1)
        tangential = np.linalg.norm(np.asarray(force)[:, :-1], axis=-1)
        middle = MU * np.asarray(force)[:, -1]
        expected = [middle - tangential, middle, middle + tangential]
        if dimension == 2:
            del expected[1]
        eigenvalues = np.linalg.eigvalsh(lmi(model, force, dimension))
        np.testing.assert_allclose(eigenvalues, np.stack(expected, -1), atol=tolerance(dtype))
        slack = np.asarray(ask(model, "feasibility_slack", force, dimension))
        np.testing.assert_allclose(eigenvalues[:, 0], MU * slack, atol=tolerance(dtype))


def test_eigenvalues_of_11_35(dtype):
    """f_n twice and f_n -+ psi; the determinant is (11.36)."""
    model = sized(jg.SoftFinger(MU, GAMMA), (60,), dtype)
    force = random_forces(model, 3, 60, dtype, seed=2)
    f_x, f_y, f_n, tau = np.asarray(force, np.float64).T
    psi = np.sqrt((f_x**2 + f_y**2) / MU**2 + tau**2 / GAMMA**2)
    eigenvalues = np.linalg.eigvalsh(lmi(model, force, 3))
    np.testing.assert_allclose(
        eigenvalues, np.stack([f_n - psi, f_n, f_n, f_n + psi], -1), atol=tolerance(dtype)
    )
    determinant = f_n**2 * (f_n**2 - tau**2 / GAMMA**2 - (f_x**2 + f_y**2) / MU**2)
    np.testing.assert_allclose(np.prod(eigenvalues, -1), determinant, atol=30 * tolerance(dtype))


def test_matrices_as_printed():
    x, y, n = np.asarray(jg.HardFinger(0.5).lmi_matrices(3))
    np.testing.assert_array_equal(x, [[0, 0, 1], [0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(y, [[0, 0, 0], [0, 0, 1], [0, 1, 0]])
    np.testing.assert_array_equal(n, 0.5 * np.eye(3))
    spin = np.asarray(jg.SoftFinger(0.5, 0.25).lmi_matrices(3))[3]
    np.testing.assert_array_equal(
        spin, 4.0 * (np.eye(4)[[2]].T @ np.eye(4)[[3]] + np.eye(4)[[3]].T @ np.eye(4)[[2]])
    )
    np.testing.assert_array_equal(jg.Frictionless().lmi_matrices(3), [[[1.0]]])


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_hard_finger_without_friction_has_lambda_min_f_n(dimension):
    S = np.asarray(jg.HardFinger(0.0).lmi_matrices(dimension))
    np.testing.assert_array_equal(S[:-1], 0.0)
    np.testing.assert_array_equal(S[-1], np.eye(dimension))


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_dual_slack_is_the_least_work_of_a_unit_normal_force(model, dimension, dtype):
    """x_n - |(mu x_t, gamma x_tau)| = min of f.x over feasible f with f_n = 1, reached at the cone's
    boundary."""
    rng = np.random.default_rng(3)
    model = sized(model, (60,), dtype)
    x = jnp.asarray(rng.normal(size=(60, model.force_size(dimension))), dtype)
    slack = np.asarray(ask(model, "dual_slack", x, dimension))
    index, scale = model.normal_index(dimension), np.asarray(ask(model, "scaling", dimension))
    scaled = np.asarray(x) * scale
    scaled[:, index] = 0.0
    size = np.linalg.norm(scaled, axis=-1, keepdims=True)
    worst = -scale * scaled / np.where(size > 0, size, 1.0)
    worst[:, index] = 1.0
    np.testing.assert_allclose(np.sum(worst * np.asarray(x), -1), slack, atol=tolerance(dtype))
    force = random_forces(model, dimension, 60, dtype, seed=4)
    feasible = np.asarray(ask(model, "feasibility_slack", force, dimension)) >= 0
    work = np.sum(np.asarray(force) * np.asarray(x), -1)
    bound = np.asarray(force)[:, index] * slack
    assert np.all(work[feasible] >= bound[feasible] - tolerance(dtype))


def test_soft_without_torsion_is_hard_and_without_friction_frictionless(dtype):
    force = random_forces(sized(jg.HardFinger(MU), (60,), dtype), 3, 60, dtype, seed=5)
    padded = jnp.concatenate([force, jnp.zeros_like(force[:, :1])], -1)
    soft, hard = jg.SoftFinger(MU, 0.0), jg.HardFinger(MU)
    np.testing.assert_allclose(
        ask(sized(soft, (60,), dtype), "feasibility_slack", padded, 3),
        ask(sized(hard, (60,), dtype), "feasibility_slack", force, 3),
        atol=tolerance(dtype),
    )
    np.testing.assert_allclose(
        ask(sized(soft, (60,), dtype), "dual_slack", padded.at[:, 3].set(9.0), 3),
        ask(sized(hard, (60,), dtype), "dual_slack", force, 3),
        atol=tolerance(dtype),
    )
    bare = jg.SoftFinger(0.0, 0.0)
    only_normal = padded.at[:, :2].set(0.0)
    np.testing.assert_array_equal(
        ask(sized(bare, (60,), dtype), "feasibility_slack", only_normal, 3), force[:, 2]
    )
    np.testing.assert_array_equal(ask(sized(bare, (60,), dtype), "dual_slack", padded, 3), force[:, 2])


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_jit_vmap_and_dtype(model, dimension, dtype):
    model = sized(model, (60,), dtype)
    force = random_forces(model, dimension, 60, dtype, seed=6)

    def answers(model, force):
        return (
            ask(model, "scaling", dimension),
            ask(model, "friction_function", force, dimension),
            ask(model, "feasibility_slack", force, dimension),
            ask(model, "dual_slack", force, dimension),
            ask(model, "lmi_matrices", dimension),
        )

    batch = answers(model, force)
    single = jax.jit(jax.vmap(answers))(model, force)
    for a, b in zip(batch, single, strict=True):
        assert a.dtype == b.dtype == jnp.dtype(dtype)
        np.testing.assert_allclose(a, b, atol=tolerance(dtype))


def test_float32_coefficients_keep_their_dtype_beside_x64():
    """Under x64 a float32 model must not be promoted by constants inside."""
    model = jg.SoftFinger(np.float32(MU) * np.ones(2, np.float32), np.float32(GAMMA) * np.ones(2, np.float32))
    assert ask(model, "lmi_matrices", 3).dtype == jnp.float32
    assert jg.HardFinger(np.ones(2, np.float32)).lmi_matrices(3).dtype == jnp.float32
    force = jnp.ones((2, 4), jnp.float32)
    assert ask(model, "friction_function", force, 3).dtype == jnp.float32
    assert ask(model, "dual_slack", force, 3).dtype == jnp.float32


def test_errors_say_what_is_expected():
    with pytest.raises(ValueError, match="planar soft finger does not exist"):
        jg.SoftFinger().components(2)
    with pytest.raises(ValueError, match="friction must be a number or an array of numbers"):
        jg.HardFinger("high")
    with pytest.raises(ValueError, match="torsion must be a number or an array of numbers"):
        jg.SoftFinger(0.5, [1.0, None])
    with pytest.raises(ValueError, match="dtype bool"):
        jg.HardFinger(True)
    assert jg.HardFinger(1).friction.dtype == jnp.zeros(()).dtype
