"""LMIs beyond a linear cost: closed forms, three answers of feasibility with proofs, SDPs against Clarabel."""

import clarabel
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csc_matrix

import jaxgrasp as jg
from jaxgrasp import Status


def solved_to(dtype):
    return 5e-8 if dtype == "float64" else 2e-3


def symmetric(rng, *shape):
    M = rng.normal(size=(*shape, shape[-1]))
    return M + np.swapaxes(M, -1, -2)


def basis(q):
    """The symmetric matrices E with x_ij in both places: X = sum x_l E_l; (N, q, q)."""
    rows, columns = np.triu_indices(q)
    E = np.zeros((len(rows), q, q))
    index = np.arange(len(rows))
    E[index, rows, columns] = E[index, columns, rows] = 1.0
    return E


def arrays(dtype, *values):
    return [jnp.asarray(np.asarray(value, float), dtype) for value in values]


# Costs -------------------------------------------------------------------------------------------------


def test_projection_onto_the_semidefinite_cone(dtype):
    """``min |X - M|_F^2 / 2, X >= 0`` clips the eigenvalues of M; the multiplier is what was clipped."""
    M = symmetric(np.random.default_rng(0), 4, 3)
    E = basis(3)
    curvature = np.einsum("iab,jab->ij", E, E)
    cost = -np.einsum("iab,nab->ni", E, M)
    start = np.einsum("iab,ab->i", E, np.eye(3)) / np.diagonal(curvature)
    constant = np.zeros((3, 3))
    values = arrays(dtype, cost, constant, E, start, curvature)
    solution = jg.lmi.lmi_minimize(jg.lmi.LMIProblem(*values))
    values, vectors = np.linalg.eigh(M)
    clipped = np.maximum(values, 0)
    X = np.einsum("nab,nb,ncb->nac", vectors, clipped, vectors)
    expected = 0.5 * np.sum((X - M) ** 2, axis=(1, 2)) - 0.5 * np.sum(M**2, axis=(1, 2))
    assert bool((solution.status == Status.OPTIMAL).all())
    np.testing.assert_allclose(solution.upper, expected, rtol=2 * solved_to(dtype))
    assert np.all(np.asarray(solution.lower) <= expected + solved_to(dtype) * np.abs(expected))
    near = 3 * np.sqrt(solved_to(dtype)) * np.abs(M).max()  # a quadratic is flat at its minimum
    np.testing.assert_allclose(np.einsum("ni,iab->nab", solution.x, E), X, atol=near)
    np.testing.assert_allclose(solution.dual, X - M, atol=near)


def test_a_log_det_cost_inverts_a_matrix(dtype):
    """``min tr(C X) - w log det X`` is at ``X = w C^-1``: ``w q - w log det(w C^-1)``, wherever Q(x) >= 0 is slack."""
    rng, q, weight = np.random.default_rng(1), 3, 0.7
    C = symmetric(rng, q)
    C = C @ C + np.eye(q)
    E = basis(q)
    cost, start = (
        np.einsum("iab,ab->i", E, C),
        np.einsum("iab,ab->i", E, np.eye(q)) / np.array([1, 2, 2, 1, 2, 1]),
    )
    zero, w = np.zeros((q, q)), weight
    term = jg.lmi.LogDetTerm(*arrays(dtype, w, zero, E))
    loose = arrays(dtype, cost, np.ones((1, 1)), np.zeros((len(E), 1, 1)), start)
    solution = jg.lmi.lmi_minimize(jg.lmi.LMIProblem(*loose, log_det=term))
    X = weight * np.linalg.inv(C)
    expected = weight * q - weight * np.linalg.slogdet(X)[1]
    assert solution.status == Status.OPTIMAL
    np.testing.assert_allclose(solution.upper, expected, rtol=solved_to(dtype))
    np.testing.assert_allclose(
        np.einsum("i,iab->ab", solution.x, E), X, atol=3 * np.sqrt(solved_to(dtype)) * np.abs(X).max()
    )


def test_a_concave_cost_and_an_unheld_direction_are_refused(dtype):
    concave = jg.lmi.LMIProblem(*arrays(dtype, [1.0], -np.eye(2), [np.eye(2)], [5.0], [[-1.0]]))
    assert np.isnan(jg.lmi.lmi_minimize(concave).upper)
    free = jg.lmi.LMIProblem(*arrays(dtype, [1.0, 1.0], -np.eye(2), [np.eye(2), 0 * np.eye(2)], [5.0, 0.0]))
    answer = jg.lmi.lmi_minimize(free)
    assert answer.status == Status.UNBOUNDED
    assert float(answer.gap) == np.inf
    np.testing.assert_array_equal(answer.ray, [0.0, -1.0])


# Feasibility -------------------------------------------------------------------------------------------


def test_three_answers_each_with_its_proof(dtype):
    """Strictly feasible; only at the edge (x = 1 alone; [[x, 1], [1, 0]] for x without bound); impossible."""
    x, one, e = np.diag([1.0, 0.0]), np.array([[0.0, 1.0], [1.0, 0.0]]), np.diag([1.0, -1.0])
    constant, matrices = arrays(
        dtype,
        [np.diag([-10.0, 11.0]), np.diag([-1.0, 1.0]), one, np.diag([-2.0, 1.0]), np.full((2, 2), np.nan)],
        np.array([e, e, x, e, e])[:, None],
    )
    answer = jg.lmi.lmi_feasibility(constant, matrices)
    expected = [Status.FEASIBLE, Status.MARGINAL, Status.MARGINAL, Status.INFEASIBLE, Status.INVALID]
    np.testing.assert_array_equal(answer.status, expected)
    assert 10.0 < float(answer.x[0, 0]) < 11.0
    Z = np.asarray(answer.certificate[3], float)
    assert np.linalg.eigvalsh(Z)[0] >= -1e-6
    np.testing.assert_allclose(np.trace(Z), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.sum(e * Z), 0.0, atol=solved_to(dtype))
    np.testing.assert_allclose(np.sum(np.diag([-2.0, 1.0]) * Z), -0.5, atol=solved_to(dtype))


def test_no_answer_depends_on_units(dtype):
    scale = np.array([1e-3, 1.0, 1e4])
    constant, matrices = arrays(
        dtype,
        scale[:, None, None] * np.diag([-1.0, 1.1]),
        np.broadcast_to(np.diag([1.0, -1.0]), (3, 1, 2, 2)),
    )
    answer = jg.lmi.lmi_feasibility(constant, matrices)
    assert bool((answer.status == Status.FEASIBLE).all())
    np.testing.assert_allclose(answer.lower, answer.lower[0], rtol=1e-3)
    np.testing.assert_allclose(np.asarray(answer.x)[:, 0] / scale, float(answer.x[0, 0]) * 1e3, rtol=1e-2)


def diagonal(*rows):
    """Rows ``g + H x >= 0`` as an LMI: S_0 and S_1 .. S_N."""
    rows = np.array(rows, float)
    return np.diag(rows[:, 0]), np.stack([np.diag(column) for column in rows.T[1:]])


def test_infeasible_everywhere_and_infeasible_in_reach(dtype):
    """``x >= 2, x <= 1`` at no x; ``[[x, 1], [1, 1e-9]]`` from 1e9 on: nothing may say that it never is."""
    never = jg.lmi.sdp_minimize(*arrays(dtype, [1.0], *diagonal([-2, 1], [1, -1])))
    assert never.status == Status.INFEASIBLE
    assert float(never.feasibility.reach) == np.inf
    assert float(never.lower) == float(never.upper) == np.inf
    e = np.diag([1.0, 0.0])
    far = jg.lmi.sdp_minimize(*arrays(dtype, [1.0], np.array([[0.0, 1.0], [1.0, 1e-9]]), e[None]))
    assert float(far.lower) <= 1e9
    assert np.isfinite(far.feasibility.reach)


# Rays --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cost", "rows", "expected"),
    [
        ([-1, 0], [[0, 1, 0], [1, 0, 1], [1, 0, -1]], [1, 0]),  # x_2 in [-1, 1]: the cone has no inside
        ([-1, -1], [[1, 1, -1], [1, -1, 1], [0, 1, 0], [0, 0, 1]], [1, 1]),  # along x_1 = x_2 alone
        ([1, -1], [[1, 1, 0], [1, 0, -1], [1, -1, -1]], None),  # bounded: x_1 >= -1, x_2 <= 1
        ([1, 2], [[-1, 1, 1], [5, -1, -1]], [1, -1]),  # the same matrix twice, other costs
    ],
)
def test_rays_of_linear_programs(cost, rows, expected):
    out = jg.lmi.sdp_minimize(*arrays("float64", cost, *diagonal(*rows)))
    if expected is None:
        assert out.status == Status.OPTIMAL
        np.testing.assert_allclose(out.upper, -2.0, rtol=1e-7)
        np.testing.assert_array_equal(out.ray, 0.0)
        return
    assert out.status == Status.UNBOUNDED
    assert float(out.lower) == -np.inf
    ray = np.asarray(out.ray)
    assert ray @ cost < 0
    assert np.all(np.array(rows, float)[:, 1:] @ ray >= 0)  # sums of a few small numbers: exact
    np.testing.assert_allclose(ray / np.abs(ray).max(), expected, atol=1e-3)


def test_a_ray_along_which_the_curvature_grows_is_none():
    """``min x^2 / 2 - x`` over all x >= -1 is -1/2; without the square it falls for ever."""
    rows = diagonal([1, 1])
    curved = jg.lmi.LMIProblem(*arrays("float64", [-1.0], *rows, [0.0], [[1.0]]))
    out = jg.lmi.lmi_minimize(curved)
    assert out.status == Status.OPTIMAL
    np.testing.assert_allclose(out.upper, -0.5, rtol=1e-7)
    assert float(out.lower) <= -0.5 <= float(out.upper)
    straight = jg.lmi.lmi_minimize(jg.lmi.LMIProblem(*arrays("float64", [-1.0], *rows, [0.0])))
    assert straight.status == Status.UNBOUNDED


# Ill-posed problems ------------------------------------------------------------------------------------


def test_a_minimum_that_is_not_reached_has_no_false_bound():
    """``min x, [[x, 1], [1, y]] >= 0``: 0, for y without bound. No Z > 0 is a dual point."""
    x, y, one = np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]])
    out = jg.lmi.sdp_minimize(*arrays("float64", [1.0, 0.0], one, [x, y]))
    assert out.status == Status.STALLED
    assert float(out.upper) > 0  # how near to 0 is another matter
    assert float(out.lower) <= 0.0


def test_bounds_hold_in_closed_form():
    """``min x, x I >= M``: the largest eigenvalue, for M of rank one known exactly: |v|^2 with whole entries."""
    rng = np.random.default_rng(5)
    v = rng.integers(-9, 10, size=(200, 4)).astype(float)
    v[:, 0] += v[:, 0] == 0
    M = v[:, :, None] * v[:, None, :]
    eye = np.broadcast_to(np.eye(4), (200, 1, 4, 4))
    out = jg.lmi.sdp_minimize(*arrays("float64", np.ones((200, 1)), -M, eye))
    exact = np.sum(v * v, axis=1)
    assert np.all(np.asarray(out.lower) <= exact) and np.all(exact <= np.asarray(out.upper))
    assert np.all(np.asarray(out.status) == Status.OPTIMAL)


# The semidefinite program ------------------------------------------------------------------------------


def clarabel_sdp(u, constant, matrices):
    """("optimal" or "infeasible" .., value) of ``min u.x, S_0 + sum x_i S_i >= 0``; svec with sqrt(2) off diagonal."""
    q = len(constant)
    rows, columns = np.array([(i, j) for j in range(q) for i in range(j + 1)]).T
    weight = np.where(rows == columns, 1.0, np.sqrt(2.0))
    A = -(matrices[:, rows, columns] * weight).T
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-9
    out = clarabel.DefaultSolver(
        csc_matrix((len(u), len(u))),
        u,
        csc_matrix(A),
        constant[rows, columns] * weight,
        [clarabel.PSDTriangleConeT(q)],
        settings,
    ).solve()
    return str(out.status), out.obj_val


def test_random_programs_agree_with_clarabel():
    """100 programs of 4 variables and order 5: bounded ones (u = tr(S_i Z), Z > 0), infeasible and unbounded ones."""
    rng, N, q, count = np.random.default_rng(2), 4, 5, 100
    S = symmetric(rng, count, N, q)
    Z = symmetric(rng, count, q)
    Z = Z @ Z + 0.1 * np.eye(q)
    u = np.einsum("niab,nab->ni", S, Z)
    x = rng.normal(size=(count, N))
    slack = symmetric(rng, count, q)
    constant = slack @ slack + 0.1 * np.eye(q) - np.einsum("ni,niab->nab", x, S)
    kind = rng.integers(3, size=count)
    constant[kind == 1] = symmetric(rng, (kind == 1).sum(), q)
    S[kind == 2, 0] = S[kind == 2, 1] @ S[kind == 2, 1]  # x_0 may grow without end, and that pays
    u[kind == 2, 0] = -1.0
    out = jg.lmi.sdp_minimize(*arrays("float64", u, constant, S))
    known = [clarabel_sdp(*one) for one in zip(u, constant, S, strict=True)]
    status = np.array([word for word, _ in known])
    best = np.array([value for _, value in known])
    optimal = status == "Solved"
    assert optimal.sum() >= 25
    assert (status == "PrimalInfeasible").sum() >= 15
    assert (status == "DualInfeasible").sum() >= 25
    np.testing.assert_array_equal(out.status[optimal], Status.OPTIMAL)
    np.testing.assert_allclose(np.asarray(out.upper)[optimal], best[optimal], rtol=1e-6, atol=1e-6)
    assert np.all(
        np.asarray(out.lower)[optimal] <= best[optimal] + 1e-6 * np.maximum(1, np.abs(best[optimal]))
    )
    # The multiplier proves the value without the solver: tr(S_i Z) = u_i, Z >= 0, -tr(S_0 Z) = value.
    multiplier = np.asarray(out.Z)
    size = np.abs(multiplier).max(axis=(1, 2))
    assert np.all(np.linalg.eigvalsh(multiplier)[optimal, 0] > -1e-9 * size[optimal])
    rest = np.abs(np.einsum("niab,nab->ni", S, multiplier) - u).max(-1)
    assert np.all(rest[optimal] < 1e-7 * np.maximum(1, size[optimal]))
    impossible = status == "PrimalInfeasible"
    assert np.all(np.isposinf(np.asarray(out.upper)[impossible]))
    assert np.all(np.einsum("nab,nab->n", constant, multiplier)[impossible] < 0)
    assert np.all(np.isposinf(np.asarray(out.lower)[impossible]))  # no x at all, however large
    unbounded = status == "DualInfeasible"
    assert np.all(np.asarray(out.gap)[unbounded] == np.inf)
    np.testing.assert_array_equal(out.status[unbounded], Status.UNBOUNDED)
    ray = np.asarray(out.ray)
    assert np.all(np.einsum("ni,ni->n", ray, u)[unbounded] < 0)
    assert np.all(np.linalg.eigvalsh(np.einsum("ni,niab->nab", ray, S))[unbounded, 0] > 0)
    assert np.all(ray[~unbounded] == 0)
    np.testing.assert_array_equal(out.status[impossible], Status.INFEASIBLE)
    np.testing.assert_array_equal(out[3].feasibility.status, out.feasibility.status[3])


def test_wrong_shapes_are_named():
    u, constant, matrices = arrays("float32", [1.0, 1.0], np.eye(2), [np.eye(2)])
    with pytest.raises(ValueError, match=r"matrices must have shape \(\*batch, 2, 2, 2\), got \(1, 2, 2\)"):
        jg.lmi.sdp_minimize(u, constant, matrices)
    with pytest.raises(ValueError, match=r"curvature must have shape \(\*batch, 1, 1\), got \(2, 2\)"):
        jg.lmi.lmi_minimize(jg.lmi.LMIProblem(u[:1], constant, matrices, u[:1], jnp.eye(2)))
