"""The chapter's Exercises 1 to 5, Proposition 11.1.1, and the errata that concern rank, LMIs and cones.

An erratum's test shows with numbers that the printed statement fails and the corrected one holds.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp import Status
from jaxgrasp.lmi.feasibility import lmi_feasibility, second_order_cone_lmi
from jaxgrasp.lmi.friction import friction_lmi, lmi_margin


def tolerance(dtype):
    return 1e-10 if dtype == "float64" else 1e-4


def forces(seed, count, size, dtype):
    """Force vectors on both sides of a cone of coefficient about 0.5, normal third."""
    force = np.random.default_rng(seed).normal(size=(count, size)) * 0.4
    force[:, 2] += 0.8
    return force.astype(dtype)


def tetrahedron(dtype):
    p = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    return p.astype(dtype), -p.astype(dtype)


def facing_pair(dtype):
    p = np.array([[-1.0, 0, 0], [1, 0, 0]], dtype)
    return p, -p


# Exercises ---------------------------------------------------------------------------------------------


def test_exercise_1_and_erratum_13_second_order_cone_form_of_coulomb_friction(dtype):
    """(11.11) with A = [I 0], b = 0, d = 0 gives (11.4) for c = (0, 0, mu), not for the printed c = (0, 0,
    1)."""
    mu = 0.5
    A, b, d = np.eye(2, 3, dtype=dtype), np.zeros(2, dtype), np.zeros((), dtype)
    Q0, Q = second_order_cone_lmi(A, b, np.array([0, 0, mu], dtype), d)
    np.testing.assert_array_equal(Q0, 0.0)
    np.testing.assert_allclose(Q, jg.HardFinger(np.array(mu, dtype)).lmi_matrices(3), atol=tolerance(dtype))

    force = forces(0, 400, 3, dtype)
    feasible = np.hypot(force[:, 0], force[:, 1]) <= mu * force[:, 2]
    smallest = np.linalg.eigvalsh(np.einsum("sj,jab->sab", force, np.asarray(Q)))[:, 0]
    np.testing.assert_array_equal(smallest >= 0, feasible)

    _, printed = second_order_cone_lmi(A, b, np.array([0, 0, 1], dtype), d)
    accepted = np.linalg.eigvalsh(np.einsum("sj,jab->sab", force, np.asarray(printed)))[:, 0] >= 0
    assert np.sum(accepted & ~feasible) > 50  # accepts forces beyond the cone


def test_exercise_2_soft_finger_matrix_is_the_elliptic_model(dtype):
    """(11.34) iff (11.35) >= 0; determinant (11.36); characteristic polynomial as printed."""
    mu, gamma = 0.5, 0.4
    S = np.asarray(jg.SoftFinger(np.array(mu, dtype), np.array(gamma, dtype)).lmi_matrices(3))
    force = forces(1, 400, 4, dtype)
    f_x, f_y, f_n, tau = force.astype(np.float64).T
    psi2 = (f_x**2 + f_y**2) / mu**2 + tau**2 / gamma**2
    P = np.einsum("sj,jab->sab", force, S)
    feasible = (f_n >= 0) & (psi2 <= f_n**2)
    assert 20 < np.sum(feasible) < 380
    np.testing.assert_array_equal(np.linalg.eigvalsh(P)[:, 0] >= 0, feasible)
    np.testing.assert_allclose(np.linalg.det(P), f_n**2 * (f_n**2 - psi2), atol=100 * tolerance(dtype))
    for eigenvalue in np.linalg.eigvalsh(P).T:
        polynomial = (eigenvalue - f_n) ** 2 * (eigenvalue**2 - 2 * eigenvalue * f_n + f_n**2 - psi2)
        np.testing.assert_allclose(polynomial, 0.0, atol=100 * tolerance(dtype))


def rank(position, normal, model):
    return int(jg.grasp_rank(jg.Grasp(position, normal, model)))


@pytest.mark.parametrize("seed", range(3))
def test_exercise_3_planar_hard_fingers(seed, dtype):
    """Two planar hard fingers: rank 3 unless they coincide; then 2, whatever the normals."""
    rng = np.random.default_rng(seed)
    p, n = rng.normal(size=(2, 2, 2)).astype(dtype)
    assert rank(p, n, jg.HardFinger(0.3)) == 3
    assert rank(p[[0, 0]], n, jg.HardFinger(0.3)) == 2


@pytest.mark.parametrize("seed", range(3))
def test_exercise_3_spatial_hard_fingers(seed, dtype):
    """Three hard fingers: rank 6 unless collinear; then 5; two always lack the torque about their line."""
    rng = np.random.default_rng(seed)
    p, n = rng.normal(size=(2, 3, 3)).astype(dtype)
    assert rank(p, n, jg.HardFinger(0.3)) == 6
    line = (np.array([[-1.0], [0.3], [2.0]]) * np.array([0.6, 0.0, 0.8]) + [0, 0.5, 0]).astype(dtype)
    assert rank(line, n, jg.HardFinger(0.3)) == 5
    assert rank(p[:2], n[:2], jg.HardFinger(0.3)) == 5
    assert rank(p[[0, 0, 0]], n, jg.HardFinger(0.3)) == 3


def test_exercise_4_feasibility_as_optimisation():
    """(11.17): Q >= 0 iff some eta <= 0 has Q + eta I >= 0, and then eta = -lambda_min(Q) is the least
    one."""
    rng = np.random.default_rng(4)
    Q = rng.normal(size=(200, 3, 3))
    Q = Q + np.swapaxes(Q, -1, -2) + 3 * np.eye(3)
    smallest = np.linalg.eigvalsh(Q)[:, 0]
    least = -smallest
    at_least = np.linalg.eigvalsh(Q + least[:, None, None] * np.eye(3))[:, 0]
    np.testing.assert_allclose(at_least, 0.0, atol=1e-12)
    assert 20 < np.sum(least <= 0) < 180
    np.testing.assert_array_equal(least <= 0, smallest >= 0)


def log_det(P):
    return np.linalg.slogdet(P)[1]


def feasible_hard_forces(count, mu, seed=5):
    rng = np.random.default_rng(seed)
    f_n = rng.uniform(0.2, 2.0, count)
    size, angle = mu * f_n * np.sqrt(rng.uniform(0, 0.98, count)), rng.uniform(0, 2 * np.pi, count)
    return np.stack([size * np.cos(angle), size * np.sin(angle), f_n], -1)


def test_exercise_5_the_barrier_blows_up_at_the_cone(dtype):
    """det P = mu f_n (mu^2 f_n^2 - |f_t|^2), so -log det P goes to +infinity, by log 10 a decade of
    distance."""
    mu = 0.5
    S = np.asarray(jg.HardFinger(mu).lmi_matrices(3), np.float64)
    distance = 10.0 ** -np.arange(1, 9)
    force = np.stack([mu * (1 - distance), 0 * distance, 1 + 0 * distance], -1)
    barrier = -log_det(np.einsum("sj,jab->sab", force, S))
    expected = -np.log(mu * (mu**2 - force[:, 0] ** 2))
    np.testing.assert_allclose(barrier, expected, atol=1e-6)
    assert np.all(np.diff(barrier) > 2.0)
    np.testing.assert_allclose(np.diff(barrier)[-3:], np.log(10), atol=1e-3)


# Proposition 11.1.1 and the errata ---------------------------------------------------------------------


def test_erratum_1_the_lmi_test_must_be_strict_and_normalised(dtype):
    """z = 0 meets the printed (11.15) for every grasp; min eta is 0 or unbounded; ours is finite and
    decides."""
    p, n = tetrahedron(dtype)
    pushing_up = np.broadcast_to(np.array([0.1, 0.1, 1.0], dtype), (4, 3))
    holds = jg.Grasp(p, n, jg.HardFinger(0.3))
    falls = jg.Grasp(p, pushing_up, jg.HardFinger(0.3))
    smallest = {}
    for name, grasp in (("holds", holds), ("falls", falls)):
        lmi, V = friction_lmi(grasp), jg.null_space(grasp)
        reduced = np.asarray(lmi.reduced(V))
        assert np.min(np.linalg.eigvalsh(0 * reduced[0])) >= 0  # z = 0: printed (ii') accepts both
        z = np.asarray(V).T @ np.tile(np.array([0, 0, 1], dtype), 4)  # a squeeze, as far as there is one
        smallest[name] = [
            np.linalg.eigvalsh(scale * np.einsum("j,jab->ab", z, reduced))[0] for scale in (1, 10, 100)
        ]
        feasible = lmi_feasibility(lmi.constant, jnp.asarray(reduced))
        assert (feasible.status == Status.FEASIBLE) == (name == "holds")
    # eta(z) = -lambda_min scales with z: unbounded below where the grasp holds.
    np.testing.assert_allclose(smallest["holds"], 0.3 * np.array([1, 10, 100]), rtol=1e-4)
    assert max(smallest["falls"]) <= 1e-6
    margins = np.asarray(
        lmi_margin(jg.Grasp(np.stack([p, p]), np.stack([n, pushing_up]), jg.HardFinger(0.3)))
    )
    np.testing.assert_allclose(margins[0], 1.0, atol=2e-3)
    assert np.isneginf(margins[1]) or margins[1] < -0.1


def test_erratum_2_log_det_is_concave():
    """The midpoint lies above the chord for log det P, so -log det P is the convex barrier."""
    mu = 0.5
    S = np.asarray(jg.HardFinger(mu).lmi_matrices(3), np.float64)
    a, b = feasible_hard_forces(500, mu, 6), feasible_hard_forces(500, mu, 7)
    value = [log_det(np.einsum("sj,jab->sab", f, S)) for f in (a, (a + b) / 2, b)]
    bulge = value[1] - (value[0] + value[2]) / 2
    assert np.min(bulge) >= -1e-6
    assert np.median(bulge) > 0.1  # strictly so: log det is not convex
    assert np.max(value[0]) < np.inf
    near = np.array([mu * (1 - 1e-12), 0.0, 1.0])
    assert log_det(np.einsum("j,jab->ab", near, S)) < -20  # to -infinity at the boundary


def test_erratum_3_constraints_g_not_negative_need_concave_g_and_S_need_only_be_symmetric():
    """Convex g(x) = x^2 - 1 >= 0 cuts a set that is not convex; the concave slack of the cone does not. S_x
    of (11.4) is indefinite."""
    g = lambda x: x**2 - 1  # noqa: E731
    assert g(-2.0) >= 0
    assert g(2.0) >= 0
    assert g(0.0) < 0  # the midpoint of two feasible points is not feasible

    model = jg.HardFinger(0.5)
    a, b = (jnp.asarray(feasible_hard_forces(300, 0.5, seed)) for seed in (8, 9))
    slack = [
        np.asarray(jg.HardFinger(jnp.full(300, 0.5)).feasibility_slack(f, 3)) for f in (a, (a + b) / 2, b)
    ]
    assert np.all(slack[1] >= (slack[0] + slack[2]) / 2 - 1e-6)
    eigenvalues = np.linalg.eigvalsh(np.asarray(model.lmi_matrices(3))[0])
    np.testing.assert_allclose(eigenvalues, [-1, 0, 1], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_erratum_4_two_soft_fingers_need_a_normal_that_leans_along_their_line(seed, dtype):
    """Prop. 11.1.1 prints: full rank unless coincident. Both normals orthogonal to the line: rank 5."""
    rng = np.random.default_rng(seed)
    p = np.array([[-0.7, 0.1, 0.2], [0.9, 0.1, 0.2]], dtype)
    across = rng.normal(size=(2, 3)) * [0, 1, 1]
    soft = jg.SoftFinger(0.4, 0.3)
    assert rank(p, across.astype(dtype), soft) == 5  # the printed statement says 6
    one_leans = across + np.array([[0.3, 0, 0], [0, 0, 0]])
    assert rank(p, one_leans.astype(dtype), soft) == 6
    assert (
        rank(p[[0, 0]], one_leans.astype(dtype), soft) == 5
    )  # coincident: forces 3, torques along two normals
    assert rank(p, one_leans.astype(dtype), jg.HardFinger(0.4)) == 5


def test_erratum_6_null_space_dimension_is_by_rank(dtype):
    """Two facing hard fingers: N_c = 6, m = 6, so the printed dimension is 0; rank 5 leaves one squeeze."""
    grasp = jg.Grasp(*facing_pair(dtype), jg.HardFinger(0.5))
    V = np.asarray(jg.null_space(grasp))
    assert int(jg.grasp_rank(grasp)) == 5
    assert np.sum(np.linalg.norm(V, axis=0) > 0.5) == 6 - 5
    np.testing.assert_allclose(np.abs(V[:, 0]), [0, 0, np.sqrt(0.5)] * 2, atol=tolerance(dtype))
    full = jg.Grasp(*tetrahedron(dtype), jg.HardFinger(0.5))
    assert int(jg.grasp_rank(full)) == 6
    assert np.sum(np.linalg.norm(np.asarray(jg.null_space(full)), axis=0) > 0.5) == 12 - 6


def test_erratum_7_eta_at_least_minus_lambda_min():
    """Q + eta I >= 0 iff eta >= -lambda_min(Q); the printed eta <= -lambda_min(Q) is false on both sides."""
    Q = np.diag([2.0, 5.0])  # lambda_min = 2
    smallest = {eta: np.linalg.eigvalsh(Q + eta * np.eye(2))[0] for eta in (-3.0, -2.0, -1.0)}
    assert smallest[-3.0] < 0  # eta = -3 <= -2 is "allowed" as printed, and not feasible
    assert smallest[-2.0] == 0
    assert smallest[-1.0] > 0  # eta = -1 > -2 is "excluded" as printed, and feasible


def test_erratum_11_third_contact_of_11_38(dtype):
    """Force axes aligned with the frame, contact m at (x, y, z): the torque rows are those of [p]_x."""
    x, y, z = 0.3, -0.7, 1.1
    p = np.array([x, y, z])
    printed = np.array([[0, z, y], [z, 0, -x], [y, -x, 0]])
    corrected = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    torques = np.cross(p, np.eye(3)).T
    np.testing.assert_allclose(corrected, torques)
    assert np.max(np.abs(printed - torques)) > 1.0
    # The library's block for the normal e_z has exactly these axes.
    G = jg.grasp_map(jg.Grasp(p[None].astype(dtype), np.array([[0, 0, 1]], dtype), jg.HardFinger(1.0)))
    np.testing.assert_allclose(np.asarray(G)[3:], corrected, atol=1e-6)


def test_erratum_12_the_corner_is_a_scalar_and_sizes_are_free():
    """A is a x N: the matrices are (a + 1) x (a + 1) for any N; two identities as printed would need 2 a."""
    rows, variables = 2, 5
    rng = np.random.default_rng(12)
    A, b, c, d = (rng.normal(size=s) for s in ((rows, variables), (rows,), (variables,), ()))
    Q0, Q = second_order_cone_lmi(A, b, c, d)
    assert Q0.shape == (rows + 1, rows + 1)
    assert Q.shape == (variables, rows + 1, rows + 1)
    x = rng.normal(size=variables)
    matrix = np.asarray(Q0) + np.einsum("i,iab->ab", x, np.asarray(Q))
    height, vector = c @ x + d, A @ x + b
    expected = np.block([[height * np.eye(rows), vector[:, None]], [vector[None], np.array([[height]])]])
    np.testing.assert_allclose(matrix, expected, atol=1e-5)
    with pytest.raises(ValueError, match="dimensions"):
        np.block([[height * np.eye(rows), vector[:, None]], [vector[None], height * np.eye(rows)]])
