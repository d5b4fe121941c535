"""LMIs: the friction LMI and its reduction, the log-det barrier method, the margin by this road."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from clarabel_oracle import clarabel_margin

import jaxgrasp as jg
from jaxgrasp import Status
from jaxgrasp.lmi.feasibility import lmi_feasibility, second_order_cone_lmi
from jaxgrasp.lmi.friction import friction_lmi, lmi_margin, margin_lmi
from jaxgrasp.lmi.primal_dual import lmi_minimize
from jaxgrasp.lmi.problem import LMIProblem

MODELS = [
    pytest.param(jg.Frictionless(), 2, id="frictionless-planar"),
    pytest.param(jg.Frictionless(), 3, id="frictionless"),
    pytest.param(jg.HardFinger(0.4), 2, id="hard-planar"),
    pytest.param(jg.HardFinger(0.4), 3, id="hard"),
    pytest.param(jg.SoftFinger(0.4, 0.3), 3, id="soft"),
]


def tolerance(dtype):
    return 1e-12 if dtype == "float64" else 3e-5


def solved_to(dtype):
    """What a solve to the default tolerance reaches, relative to max(1, |value|)."""
    return 5e-8 if dtype == "float64" else 2e-3


def contacts(seed, shape, dimension, dtype):
    rng = np.random.default_rng(seed)
    position = rng.normal(size=(*shape, dimension))
    return position.astype(dtype), (-position + 0.4 * rng.normal(size=position.shape)).astype(dtype)


# The friction LMI --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_blocks_of_P_are_those_of_the_contacts(model, dimension, dtype):
    position, normal = contacts(0, (2, 3), dimension, dtype)
    grasp = jg.Grasp(position, normal, model)
    P, S = friction_lmi(grasp)
    n, q = S.shape[-3] // 3, S.shape[-1] // 3
    assert S.shape == (2, 3 * n, 3 * q, 3 * q)
    assert S.dtype == jnp.dtype(dtype)
    np.testing.assert_array_equal(S, jnp.swapaxes(S, -1, -2))
    force = np.random.default_rng(1).normal(size=(2, 3, n)).astype(dtype)
    matrix = np.array(P(jnp.asarray(force.reshape(2, -1))))
    for i in range(3):
        contact = np.einsum(
            "bj,bjpq->bpq", force[:, i], np.asarray(grasp.model.lmi_matrices(dimension))[:, i]
        )
        block = slice(i * q, (i + 1) * q)
        np.testing.assert_allclose(matrix[:, block, block], contact, atol=tolerance(dtype))
        matrix[:, block, block] = 0.0
    np.testing.assert_array_equal(matrix, 0.0)


def test_S_l_sits_in_block_i_for_l_equal_i_n_plus_j():
    grasp = jg.Grasp(*contacts(2, (3,), 3, "float32"), jg.HardFinger(0.5))
    S = np.asarray(friction_lmi(grasp).S)
    expected = np.zeros((9, 9))
    expected[3, 5] = expected[5, 3] = 1.0  # l = 3: contact 2, f_x
    np.testing.assert_array_equal(S[3], expected)
    np.testing.assert_array_equal(np.diag(S[8]), [0] * 6 + [0.5] * 3)  # l = 8: contact 3, f_n


def test_P_is_positive_exactly_where_every_force_is_feasible(dtype):
    grasp = jg.Grasp(*contacts(3, (400, 2), 3, dtype), jg.SoftFinger(0.5, 0.1))
    rng = np.random.default_rng(4)
    force = (rng.normal(size=(400, 2, 4)) * [0.25, 0.25, 0.3, 0.05] + [0, 0, 1, 0]).astype(dtype)
    slack = np.asarray(grasp.model.feasibility_slack(jnp.asarray(force), 3)).min(-1)
    smallest = np.linalg.eigvalsh(np.asarray(friction_lmi(grasp).P(jnp.asarray(force.reshape(400, 8)))))[:, 0]
    assert 100 < np.sum(slack > 0) < 300
    np.testing.assert_allclose(smallest, slack, atol=tolerance(dtype))


def test_inactive_contacts_never_constrain(dtype):
    position, normal = contacts(5, (3,), 3, dtype)
    position[1] = np.nan
    active = np.array([True, False, True])
    lmi = friction_lmi(jg.Grasp(position, normal, jg.HardFinger(np.array([0.5, np.nan, 0.2], dtype)), active))
    np.testing.assert_array_equal(lmi.S[3:6], 0.0)
    np.testing.assert_array_equal(lmi.constant, np.diag([0.0] * 3 + [1.0] * 3 + [0.0] * 3))
    force = jnp.asarray([0, 0, 1, 5, 5, -9, 0, 0, 1], dtype)
    np.testing.assert_allclose(np.linalg.eigvalsh(lmi.P(force))[[0, -1]], [0.2, 1.0], atol=tolerance(dtype))


def test_reduction_is_P_on_the_null_space(dtype):
    """P~(z) of (11.15) is P(V z)."""
    grasp = jg.Grasp(*contacts(6, (3, 4), 3, dtype), jg.HardFinger(0.5), np.array([True, True, True, False]))
    lmi, V = friction_lmi(grasp), jg.null_space(grasp)
    z = jnp.asarray(np.random.default_rng(7).normal(size=(3, 12)), dtype)
    reduced = lmi.constant + jnp.einsum("bj,bjpq->bpq", z, lmi.reduced(V))
    np.testing.assert_allclose(reduced, lmi.P(jnp.einsum("bij,bj->bi", V, z)), atol=tolerance(dtype))


def test_friction_lmi_shape_errors():
    lmi = friction_lmi(jg.Grasp(*contacts(8, (3,), 3, "float32"), jg.HardFinger(0.5)))
    with pytest.raises(ValueError, match=r"force must have shape \(\*batch, 9\), got \(3, 3\)"):
        lmi.P(jnp.ones((3, 3)))
    with pytest.raises(ValueError, match=r"V must have shape \(\*batch, 9, j\), got \(4, 9\)"):
        lmi.reduced(jnp.ones((4, 9)))


# Second-order cones ------------------------------------------------------------------------------------


def test_second_order_cone_lmi_is_the_cone(dtype):
    rng = np.random.default_rng(9)
    A, b, c, d = (rng.normal(size=s).astype(dtype) for s in ((2, 4), (2,), (4,), ()))
    x = rng.normal(size=(400, 4)).astype(dtype)
    Q0, Q = second_order_cone_lmi(A, b, c, d)
    assert (Q0.shape, Q.shape, Q.dtype) == ((3, 3), (4, 3, 3), jnp.dtype(dtype))
    matrix = np.asarray(Q0) + np.einsum("si,ipq->spq", x, Q)
    slack = x @ c + d - np.linalg.norm(x @ A.T + b, axis=-1)
    assert 20 < np.sum(slack > 0) < 380
    np.testing.assert_allclose(np.linalg.eigvalsh(matrix)[:, 0], slack, atol=30 * tolerance(dtype))


def test_second_order_cone_lmi_batches_and_names_wrong_shapes():
    A, b, c, d = (
        np.ones((5, 2, 3), np.float32),
        np.ones((5, 2), np.float32),
        np.ones((5, 3), np.float32),
        np.float32(1),
    )
    Q0, Q = second_order_cone_lmi(A, b, c, np.broadcast_to(d, 5))
    assert (Q0.shape, Q.shape) == ((5, 3, 3), (5, 3, 3, 3))
    one = jax.vmap(second_order_cone_lmi)(A, b, c, jnp.ones(5, jnp.float32))
    np.testing.assert_array_equal(Q, one[1])
    with pytest.raises(ValueError, match=r"b must have shape \(\*batch, 2\)"):
        second_order_cone_lmi(A[0], np.ones(3), c[0], d)
    with pytest.raises(ValueError, match=r"c must have shape \(\*batch, 3\)"):
        second_order_cone_lmi(A[0], b[0], np.ones(2), d)


# The barrier method ------------------------------------------------------------------------------------


def problem(cost, constant, matrices, start, dtype):
    return LMIProblem(*(jnp.asarray(np.array(a, float), dtype) for a in (cost, constant, matrices, start)))


def test_linear_program_as_diagonal_lmi(dtype):
    """min -x - 2 y over x, y >= 0, x + y <= 3, y <= 2: optimum -5 at (1, 2)."""
    rows = np.array([[1, 0], [0, 1], [-1, -1], [0, -1]])
    matrices = [np.diag(rows[:, i]) for i in range(2)]
    solution = lmi_minimize(problem([-1, -2], np.diag([0, 0, 3, 2]), matrices, [0.5, 0.5], dtype))
    assert solution.status == Status.OPTIMAL
    np.testing.assert_allclose(solution.x, [1, 2], atol=4 * solved_to(dtype))
    np.testing.assert_allclose(solution.upper, -5, rtol=solved_to(dtype))
    assert float(solution.lower) <= -5 + solved_to(dtype) <= float(solution.upper) + 2 * solved_to(dtype)


def test_largest_eigenvalue_as_lmi(dtype):
    """min x subject to x I - M >= 0 is lambda_max(M): a batch of matrices that need not be definite."""
    M = np.random.default_rng(10).normal(size=(5, 4, 4))
    M = M + np.swapaxes(M, -1, -2)
    batch = problem([[1.0]] * 5, -M, np.broadcast_to(np.eye(4), (5, 1, 4, 4)), [[20.0]] * 5, dtype)
    solution = lmi_minimize(batch)
    assert bool((solution.status == Status.OPTIMAL).all())
    largest = np.linalg.eigvalsh(M)[:, -1]
    np.testing.assert_allclose(solution.upper, largest, rtol=solved_to(dtype))
    assert np.all(np.asarray(solution.lower) <= largest * (1 + solved_to(dtype)))
    for i in range(5):
        one = lmi_minimize(jax.tree.map(lambda leaf, i=i: leaf[i], batch))
        np.testing.assert_allclose(one.upper, solution.upper[i], rtol=solved_to(dtype))
    again = jax.jit(jax.vmap(lmi_minimize))(batch)
    np.testing.assert_allclose(again.upper, solution.upper, rtol=solved_to(dtype))
    assert again.upper.dtype == jnp.dtype(dtype)


def test_the_gap_is_a_proof_at_every_tolerance(dtype):
    """A loose tolerance stops early; the true optimum still lies in [bound, value]."""
    M = np.array([[2.0, 1.0], [1.0, -3.0]])
    optimum = np.linalg.eigvalsh(M)[-1]
    loose = problem([1.0], -M, [np.eye(2)], [20.0], dtype)
    steps = []
    for goal in (1.0, 1e-1, 1e-2):
        solution = lmi_minimize(loose, tolerance=goal)
        assert solution.status == Status.OPTIMAL
        assert float(solution.lower) <= optimum + 1e-6 <= float(solution.upper) + 2e-6
        assert float(solution.gap) <= goal * max(1.0, abs(float(solution.upper)))
        steps.append(int(solution.iterations))
    assert steps[0] < steps[-1]


def test_dependent_and_absent_variables_are_harmless(dtype):
    """Two copies of the same matrix and one zero matrix: the value stays, the absent variable too."""
    eye, M = np.eye(2), np.diag([1.0, -4.0])
    doubled = problem([1.0, 1.0, 0.0], -M, [eye, eye, 0 * eye], [5.0, 5.0, 7.0], dtype)
    solution = lmi_minimize(doubled)
    assert solution.status == Status.OPTIMAL
    np.testing.assert_allclose(solution.upper, 1.0, rtol=solved_to(dtype))
    assert float(solution.x[2]) == 7.0


def test_bad_starts_unbounded_problems_and_few_steps_are_reported(dtype):
    infeasible_start = lmi_minimize(problem([1.0], -np.eye(2), [np.eye(2)], [0.5], dtype))
    assert np.isnan(infeasible_start.upper)
    assert infeasible_start.status == Status.INVALID
    unbounded = lmi_minimize(problem([-1.0], np.eye(2), [np.eye(2)], [0.0], dtype))
    assert unbounded.status == Status.UNBOUNDED
    assert float(unbounded.gap) == np.inf and float(unbounded.lower) == -np.inf
    assert float(unbounded.ray[0]) > 0
    short = lmi_minimize(problem([1.0], -np.eye(2), [np.eye(2)], [20.0], dtype), tolerance=1e-8, max_steps=3)
    assert int(short.iterations) == 3
    assert short.status == Status.STALLED
    assert 1.0 <= float(short.upper) < 20.0


def test_a_bad_lane_harms_no_other(dtype):
    M = np.array([np.diag([1.0, 2.0]), np.full((2, 2), np.nan), np.diag([5.0, -1.0])])
    batch = problem([[1.0]] * 3, -M, np.broadcast_to(np.eye(2), (3, 1, 2, 2)), [[9.0]] * 3, dtype)
    solution = lmi_minimize(batch)
    np.testing.assert_array_equal(solution.status, [Status.OPTIMAL, Status.INVALID, Status.OPTIMAL])
    np.testing.assert_allclose(solution.upper, [2.0, np.nan, 5.0], rtol=solved_to(dtype))


def test_lmi_minimize_names_wrong_shapes():
    with pytest.raises(ValueError, match=r"matrices must have shape \(\*batch, 2, 3, 3\), got \(1, 3, 3\)"):
        lmi_minimize(problem([1, 1], np.eye(3), [np.eye(3)], [0, 0], "float32"))
    with pytest.raises(ValueError, match=r"start must have shape \(\*batch, 1\)"):
        lmi_minimize(problem([1], np.eye(3), [np.eye(3)], [0, 0], "float32"))


def test_feasibility_finds_a_point_or_shows_there_is_none(dtype):
    """Interval LMIs x >= a, x <= b for three pairs (a, b); the third is the point x = 1 alone."""
    constant = jnp.asarray([np.diag([-a, b]) for a, b in ((10.0, 11.0), (2.0, 1.0), (1.0, 1.0))], dtype)
    matrices = jnp.broadcast_to(jnp.asarray(np.diag([1.0, -1.0]), dtype), (3, 1, 2, 2))
    answer = lmi_feasibility(constant, matrices)
    np.testing.assert_array_equal(answer.status == Status.FEASIBLE, [True, False, False])
    assert 10.0 < float(answer.x[0, 0]) < 11.0
    assert float(answer.lower[0]) > 0.01
    np.testing.assert_allclose(np.asarray(answer.upper)[1:], 0.0, atol=solved_to(dtype))


# The margin by this road -------------------------------------------------------------------------------


def tetrahedron():
    p = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    return p, -p


def test_known_margins(dtype):
    """A tetrahedron, three fingers at 120 degrees, and theory's contacts of which one is without friction."""
    p = np.zeros((6, 4, 3))
    p[0] = tetrahedron()[0]
    angle = np.arange(3) * 2 * np.pi / 3
    p[1, :3] = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    p[2:, :3] = [[-1, 0, 0], [0, 0, -1], [0, 0, 1]]
    active = np.array([[True] * 4] + [[True] * 3 + [False]] * 5)
    mu = np.array([[0.1] * 4, [0.2] * 4] + [[0, 1, 1, 0]] * 4)
    margin = lmi_margin(jg.Grasp(p.astype(dtype), -p.astype(dtype), jg.HardFinger(mu), active))
    np.testing.assert_allclose(margin, [1, 1, 0.75, 0.75, 0.75, 0.75], atol=solved_to(dtype))


def test_known_margins_of_two_soft_fingers(dtype):
    p, n = np.array([[-1.0, 0, 0], [1, 0, 0]]), np.array([[np.sqrt(3), 1, 0], [-np.sqrt(3), 0, 1]]) / 2
    p, n = np.stack([p, p]).astype(dtype), np.stack([n, n]).astype(dtype)
    grasp = jg.Grasp(p, n, jg.SoftFinger(0.5, np.array([[2.0], [0.01]])))
    np.testing.assert_allclose(lmi_margin(grasp), [0.106, -0.155], atol=1e-3)


def test_no_squeeze_is_minus_infinity(dtype):
    """Two contacts that push upwards with mu = 0, and one contact alone."""
    p = np.array([[[1.0, 0, 0], [0, 1, 0]], [[1, 0, 0], [-1, 0, 0]]], dtype)
    n = np.array([[[-0.6, 0, 0.8], [0, -0.6, 0.8]], [[-0.6, 0, 0.8], [0.6, 0, 0.8]]], dtype)
    np.testing.assert_array_equal(lmi_margin(jg.Grasp(p, n, jg.HardFinger(0.0))), -np.inf)
    single = np.array([True, False])
    np.testing.assert_array_equal(lmi_margin(jg.Grasp(p, n, jg.HardFinger(0.5), single)), -np.inf)
    assert np.all(np.isfinite(lmi_margin(jg.Grasp(p, n, jg.HardFinger(0.5)))))


def test_margin_of_lanes_that_are_no_grasp_is_nan(dtype):
    position, normal = contacts(20, (6, 4), 3, dtype)
    position[1, 2, 0], normal[2, 0] = np.nan, 0.0
    mu = np.full((6, 4), 0.5, dtype)
    mu[3, 1] = -0.1
    active = np.ones((6, 4), bool)
    active[4] = False
    margin = np.asarray(lmi_margin(jg.Grasp(position, normal, jg.HardFinger(mu), active)))
    np.testing.assert_array_equal(np.isnan(margin), [False, True, True, True, True, False])
    healthy = np.array([0, 5, 0, 5, 0, 5])
    alone = lmi_margin(jg.Grasp(position, normal, jg.HardFinger(mu), active)[healthy])
    np.testing.assert_array_equal(margin[healthy], alone)


@pytest.mark.parametrize(("model", "dimension"), MODELS)
def test_margin_agrees_with_clarabel(model, dimension, dtype):
    """Random contacts, a fifth of the coefficients zero, a quarter of the contacts inactive."""
    count, k, rng = 80, 4, np.random.default_rng(30)
    position, normal = contacts(31, (count, k), dimension, dtype)
    mu, gamma = rng.uniform(0, 1.5, (2, count, k)) * (rng.random((2, count, k)) > 0.2)
    active = rng.random((count, k)) < 0.75
    active[:, 0] = True
    mu, gamma = mu.astype(dtype), gamma.astype(dtype)
    model = model.with_coefficients(jnp.asarray(mu), jnp.asarray(gamma))
    grasp = jg.Grasp(position, normal, model, active)
    names = [c.value for c in model.components(dimension)]
    margin = np.asarray(lmi_margin(grasp), np.float64)
    friction = np.asarray(model.friction_coefficient)
    reference, known = zip(
        *(
            clarabel_margin(position[i], normal[i], friction[i], gamma[i], active[i], names)
            for i in range(count)
        ),
        strict=True,
    )
    reference, known = np.array(reference), np.array(known)
    assert known.mean() > 0.8
    np.testing.assert_array_equal(np.isinf(margin[known]), np.isinf(reference[known]))
    finite = known & np.isfinite(reference)
    error = np.abs(margin[finite] - reference[finite]) / np.maximum(1.0, np.abs(reference[finite]))
    assert np.max(error, initial=0.0) < (1e-6 if dtype == "float64" else 5e-3)


def test_margin_of_one_grasp_under_vmap_and_jit(dtype):
    grasp = jg.Grasp(*contacts(40, (6, 4), 3, dtype), jg.HardFinger(0.5))
    margin = lmi_margin(grasp)
    assert margin.shape == (6,)
    assert margin.dtype == jnp.dtype(dtype)
    np.testing.assert_allclose(jax.jit(jax.vmap(lmi_margin))(grasp), margin, atol=solved_to(dtype))
    assert lmi_margin(grasp[0]).shape == ()
    np.testing.assert_allclose(lmi_margin(grasp[0]), margin[0], atol=solved_to(dtype))


def test_margin_is_invariant_under_rotation_spin_and_order(dtype):
    position, normal = contacts(41, (6, 4), 3, dtype)
    Q, _ = np.linalg.qr(np.random.default_rng(42).normal(size=(3, 3)))
    Q = (Q * np.sign(np.linalg.det(Q))).astype(dtype)
    margin = np.asarray(lmi_margin(jg.Grasp(position, normal, jg.HardFinger(0.5))))
    scale = np.maximum(1.0, np.abs(margin))
    turned = lmi_margin(jg.Grasp(position @ Q.T, normal @ Q.T, jg.HardFinger(0.5)))
    shuffled = lmi_margin(jg.Grasp(position[:, ::-1], normal[:, ::-1], jg.HardFinger(0.5)))
    for other in (turned, shuffled):
        np.testing.assert_allclose(np.asarray(other) / scale, margin / scale, atol=2 * solved_to(dtype))


def test_margin_problem_states_its_constraints(dtype):
    """At any (y, t): the matrix is P of a force in Null(G) with mean normal force 1, minus t."""
    grasp = jg.Grasp(*contacts(43, (6, 4), 3, dtype), jg.HardFinger(0.5))
    problem = margin_lmi(grasp)
    x = jnp.asarray(np.random.default_rng(44).normal(size=problem.cost.shape), dtype)
    matrix = np.asarray(problem.Q(x)) + np.asarray(x)[:, -1, None, None] * np.eye(12)
    normal = np.stack([matrix[:, 3 * i, 3 * i] for i in range(4)], -1)
    tangent = np.stack([matrix[:, 3 * i : 3 * i + 2, 3 * i + 2] for i in range(4)], 1) * 0.5
    np.testing.assert_allclose(normal.sum(-1), 4.0, atol=100 * tolerance(dtype))
    force = np.concatenate([tangent, normal[..., None]], -1).reshape(6, 12)
    wrench = np.einsum("bij,bj->bi", np.asarray(jg.grasp_map(grasp)), force)
    np.testing.assert_allclose(wrench, 0.0, atol=1000 * tolerance(dtype))
