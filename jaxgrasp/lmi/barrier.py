"""A log-det barrier method for linear matrix inequalities (Definition 4, optimisation). It knows no grasps."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from ..backend import fori_loop, while_loop
from ..core import Array, Status, gap_goal, nan_where, rank_tolerance, unit_roundoff
from .problem import LMIProblem, LMISolution, LogDetTerm, check_shapes, over_batch

__all__ = ["lmi_minimize", "minimize"]

CENTRED = 0.25  # Newton decrement below which an iterate counts as central
WEIGHT_GROWTH = 20.0  # t grows by this factor at every central point
MAX_STEPS = 250
REFINEMENTS = 2  # of a Newton direction, for its dual point's sake


class _Coordinates(eqx.Module):
    """``x = T y + rest`` with ``sum_i x_i Q_i = sum_j y_j Q'_j``, the stacked ``(Q'_j, B'_j, F'_j)`` orthonormal.

    So neither the scale of a variable nor dependent matrices matter. With fewer independent matrices than
    variables the last columns of T and the last Q'_j are zero: those directions nothing holds, and x never moves along
    them.
    """

    T: Array
    inverse: Array  # y of a given x
    matrices: Array
    term_matrices: Array
    root: Array  # F T, F^T F = H
    held: Array  # whether the linear cost is zero along the directions nothing holds


def _coordinates(problem: LMIProblem, term: LogDetTerm, root: Array) -> _Coordinates:
    N, dtype = problem.cost.shape[-1], problem.cost.dtype
    stacked = jnp.concatenate(
        [problem.matrices.reshape(N, -1), term.matrices.reshape(N, -1), root.T], axis=1
    ).T
    stacked = after(stacked, problem.start)  # which may come from another problem
    length = jnp.linalg.norm(stacked, axis=0)
    length = jnp.where(length > 0, length, 1.0)
    _, values, rows = jnp.linalg.svd(stacked / length, full_matrices=False)
    kept = (values > rank_tolerance(dtype) * values[0])[:, None]
    T = (rows * jnp.where(kept, 1 / jnp.where(kept, values[:, None], 1.0), 0.0)).T / length[:, None]
    cost = problem.cost / length
    idle = cost - jnp.where(kept, rows, 0.0).T @ (rows @ cost)
    return _Coordinates(
        T=T,
        inverse=jnp.where(kept, values[:, None] * rows, 0.0) * length,
        matrices=jnp.einsum("ij,iab->jab", T, problem.matrices),
        term_matrices=jnp.einsum("ij,iab->jab", T, term.matrices),
        root=root @ T,
        held=jnp.all(jnp.abs(idle) <= N * rank_tolerance(dtype) * jnp.max(jnp.abs(cost))),
    )


class _Iterate(eqx.Module):
    x: Array
    factor: Array  # Cholesky factors of Q(x) and B(x)
    term_factor: Array
    value: Array
    weight: Array  # t
    bound: Array
    dual: Array
    steps: Array
    stalled: Array


class _NewtonStep(eqx.Module):
    direction: Array
    central: Array
    proves: Array  # whether the step's dual point is one: Z >= 0
    bound: Array
    dual: Array
    length: Array


def after(x: Array, done: Array) -> Array:
    """x, not before ``done`` is there: two LAPACK calls at once can wait for each other's workers for ever."""
    return x + 0 * done.reshape(-1)[0]


def _whitened(factor: Array, matrices: Array) -> tuple[Array, Array]:
    """``L^-1`` and ``W_i = L^-1 Q_i L^-T``."""
    inverse = jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(factor), dtype=factor.dtype), lower=True)
    return inverse, jnp.einsum("ab,ibc,dc->iad", inverse, matrices, inverse)


def _newton_step(
    problem: LMIProblem, term: LogDetTerm, space: _Coordinates, iterate: _Iterate
) -> _NewtonStep:
    """One Newton step of ``phi_t(x) = t h(x) - log det Q(x)``, h the cost, with an exact line search.

    With ``Q = L L^T``, ``W_i = L^-1 Q_i L^-T`` and g the gradient of ``c.x + 1/2 x^T H x`` at x:
    ``grad_i = t g_i - tr W_i``, ``Hess_ij = t H_ij + tr(W_i W_j)``. Put ``D = sum_i dx_i W_i``. Then
    ``Z = L^-T (I - D) L^-1 / t`` has ``tr(Q_i Z) = c_i + (H (x + dx))_i``: x + dx minimises the Lagrangian of Z. So Z
    is a dual point wherever D <= I (a decrement below 1 is enough), its value the Lagrangian's at x + dx, and the gap
    is ``-g.dx - dx^T H dx / 2 + (q - |D|^2) / t``; q / t at the centre.

    The log-det term adds the same with weight ``t w`` for 1. Its own multiplier ``Y = (I - E) / B`` bounds it by
    ``-log det B(x) >= r + log det Y - tr(B(x) Y)``, which adds ``-w sum (log(1 - e) + e^2)`` to the gap, e the
    eigenvalues of E.
    """
    t, (N, q, _) = iterate.weight, space.matrices.shape
    strength = t * term.weight
    inverse, W = _whitened(iterate.factor, space.matrices)
    _, U = _whitened(after(iterate.term_factor, inverse), space.term_matrices)
    y = space.inverse @ iterate.x
    slope = space.T.T @ problem.cost + space.root.T @ (space.root @ y)
    gradient = t * slope - jnp.trace(W, axis1=1, axis2=2) - strength * jnp.trace(U, axis1=1, axis2=2)
    columns = (W.reshape(N, -1), jnp.sqrt(strength) * U.reshape(N, -1), jnp.sqrt(t) * space.root.T)
    hessian_root = jnp.concatenate(columns, axis=1).T
    direction = _solve_normal(hessian_root, -gradient)
    change = hessian_root @ direction
    decrement = jnp.linalg.norm(change)
    # What is left of the Newton equation is missing in tr(Q_i Z) = .. : the bound allows for it at points as large as
    # x, and a large rest proves nothing.
    rest = jnp.abs(hessian_root.T @ change + gradient) / t
    room = jnp.abs(slope) + jnp.linalg.norm(hessian_root, axis=0) / t
    exact = jnp.all(rest <= unit_roundoff(t.dtype) ** 0.5 * room)

    D = jnp.einsum("i,iab->ab", direction, W)
    d = jnp.linalg.eigvalsh(D)
    e = jnp.linalg.eigvalsh(after(jnp.einsum("i,iab->ab", direction, U), d))
    proves = (jnp.max(d) <= 1) & (jnp.max(e) < 1) & exact
    bend = jnp.sum((space.root @ direction) ** 2)
    loss = jnp.sum(jnp.log1p(-jnp.where(proves, e, 0.0)) + e * e)
    gap = (q - jnp.sum(d * d)) / t - slope @ direction - bend / 2 - term.weight * loss
    gap = gap + rest @ (jnp.abs(y) + jnp.abs(direction))
    dual = inverse.T @ (jnp.eye(q, dtype=t.dtype) - D) @ inverse / t

    near = decrement <= CENTRED
    eigenvalues = jnp.concatenate([d, e])
    counts = jnp.concatenate([jnp.ones_like(d), jnp.ones_like(e) * strength])
    length = _line_search(t * slope @ direction, t * bend, eigenvalues, counts)
    length = jnp.where(near & (jnp.min(eigenvalues) > -0.9), 1.0, length)
    return _NewtonStep(
        space.T @ direction, near & proves, proves, iterate.value - gap, (dual + dual.T) / 2, length
    )


def _solve_normal(J: Array, b: Array) -> Array:
    """``(J^T J)^-1 b`` from ``J = O R``: the square of J's condition number, which grows like t, never appears.

    Columns are scaled to unit length. A variable nothing holds (a zero column) stays put.
    """
    N = J.shape[1]
    length = jnp.linalg.norm(J, axis=0)
    scale = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 1.0)
    unit = J * scale
    ridge = jnp.diag(jnp.where(length > 0, 8 * unit_roundoff(J.dtype), 1.0).astype(J.dtype))
    R = jnp.linalg.qr(jnp.concatenate([unit, ridge]), mode="r")

    def solve(right: Array) -> Array:
        half = jax.scipy.linalg.solve_triangular(R, right, trans=1)
        return jax.scipy.linalg.solve_triangular(R, half)

    x = jnp.zeros(N, J.dtype)
    for _ in range(1 + REFINEMENTS):
        x = x + solve(scale * b - unit.T @ (unit @ x))
    return scale * x


def _line_search(slope: Array, bend: Array, eigenvalues: Array, counts: Array) -> Array:
    """Minimise ``a slope + a^2 bend / 2 - sum_j count_j log(1 + a e_j)`` over a >= 0 by bisection on its
    derivative."""
    smallest = jnp.min(eigenvalues)
    wall = jnp.where(smallest < 0, -0.99 / jnp.where(smallest < 0, smallest, -1.0), jnp.inf)

    def bisect(_, bracket):
        low, high = bracket
        middle = (low + high) / 2
        rising = slope + middle * bend - jnp.sum(counts * eigenvalues / (1 + middle * eigenvalues)) > 0
        return jnp.where(rising, low, middle), jnp.where(rising, middle, high)

    low, _ = fori_loop(0, 20, bisect, (jnp.zeros_like(wall), jnp.minimum(wall, 16.0)))
    return low


def _square_root(H: Array) -> Array:
    """F with ``F^T F = H``; NaN where H is not positive semidefinite by more than rounding."""
    values, vectors = jnp.linalg.eigh(H)
    rounding = len(H) * rank_tolerance(H.dtype) * jnp.max(jnp.abs(values))
    root = jnp.sqrt(jnp.maximum(values, 0.0))[:, None] * vectors.T
    return nan_where(~(values[0] >= -rounding), root)


def minimize(problem: LMIProblem, goal: Array, max_steps: int = MAX_STEPS) -> LMISolution:
    """One problem, no batch axes. Under ``jax.vmap`` the problems run one after another: each takes its own number of
    steps, and no LAPACK call is one of a batch."""
    one = jax.custom_batching.sequential_vmap(lambda problem, goal: _minimize(problem, goal, max_steps))
    return one(problem, goal)


def _minimize(problem: LMIProblem, goal: Array, max_steps: int) -> LMISolution:
    """Follow the central path: a Newton step on phi_t; the bound it proves, if any; where x was central, raise t."""
    dtype, N = problem.cost.dtype, problem.cost.shape[-1]
    H = problem.curvature
    root = jnp.zeros((1, N), dtype) if H is None else _square_root(after(H, problem.start))
    term = problem.log_det
    if term is None:  # B = 1: no cost
        term = LogDetTerm(jnp.zeros((), dtype), jnp.ones((1, 1), dtype), jnp.zeros((N, 1, 1), dtype))

    space = _coordinates(problem, term, root)

    def good(iterate: _Iterate) -> Array:
        return iterate.value - iterate.bound <= goal * jnp.maximum(1.0, jnp.abs(iterate.value))

    def unfinished(iterate: _Iterate) -> Array:
        return ~(good(iterate) | iterate.stalled) & (iterate.steps < max_steps)

    def advance(iterate: _Iterate) -> _Iterate:
        step = _newton_step(problem, term, space, iterate)
        x = iterate.x + step.length * step.direction
        factor, term_factor, value = _evaluated(problem, term, root, x)
        usable = _finite(factor, term_factor, x, value)
        better = step.proves & (step.bound > iterate.bound)
        return _Iterate(
            x=jnp.where(usable, x, iterate.x),
            factor=jnp.where(usable, factor, iterate.factor),
            term_factor=jnp.where(usable, term_factor, iterate.term_factor),
            value=jnp.where(usable, value, iterate.value),
            weight=jnp.where(step.central, WEIGHT_GROWTH * iterate.weight, iterate.weight),
            bound=jnp.where(better, step.bound, iterate.bound),
            dual=jnp.where(better, step.dual, iterate.dual),
            steps=iterate.steps + 1,
            stalled=~usable,
        )

    factor, term_factor, value = _evaluated(problem, term, root, after(problem.start, space.T))
    interior = _finite(factor, term_factor, value)  # else: not strictly feasible, or not numbers
    start = _Iterate(
        x=problem.start,
        factor=factor,
        term_factor=term_factor,
        value=nan_where(~interior, value),
        weight=jnp.ones((), dtype),
        bound=jnp.full((), -jnp.inf, dtype),
        dual=jnp.zeros_like(problem.constant),
        steps=jnp.zeros((), jnp.int32),
        stalled=~(interior & space.held),  # not held: the cost falls for ever
    )
    end = while_loop(unfinished, advance, start)
    status = jnp.where(good(end), Status.OPTIMAL.value, Status.STALLED.value)
    status = jnp.where(jnp.isfinite(end.value), status, Status.INVALID.value).astype(jnp.int32)
    lower = jnp.minimum(end.bound, end.value)
    return LMISolution(status, end.x, end.value, lower, end.dual, end.steps)


def _evaluated(problem: LMIProblem, term: LogDetTerm, root: Array, x: Array) -> tuple[Array, Array, Array]:
    """The Cholesky factors of Q(x) and B(x), not finite outside the domain, and the cost at x."""
    factor = jnp.linalg.cholesky(problem.Q(x))
    term_factor = jnp.linalg.cholesky(after(term.B(x), factor))
    quadratic = problem.cost @ x + jnp.sum((root @ x) ** 2) / 2
    log_det = jnp.sum(jnp.log(jnp.diagonal(term_factor)))
    return factor, term_factor, quadratic - 2 * term.weight * log_det


def _finite(*arrays: Array) -> Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(array)) for array in arrays]))


@eqx.filter_jit
def lmi_minimize(problem: LMIProblem, *, tolerance: float = 1e-8, max_steps: int = MAX_STEPS) -> LMISolution:
    """``min h(x)  subject to  Q_0 + sum_i x_i Q_i >= 0`` by Newton's method on ``t h(x) - log det Q(x)``.

    h is linear or convex quadratic, less an optional multiple of log det B(x): see ``LMIProblem``. A log-det
    path-following method (Definition 4; Boyd, Vandenberghe, Convex Optimization, chapter 11): the barrier is -log
    det, which is convex (erratum 2), and it needs a strictly feasible ``problem.start``; ``lmi_feasibility`` finds
    one. Leading batch axes, ``jax.vmap`` and ``jax.jit`` all work.

    ``lower`` is the value of a dual point, not an estimate; the gap is driven to ``tolerance * max(1, |upper|)``, no
    lower than the dtype allows: OPTIMAL. Where it gets stuck before, the status is STALLED and x is the last point. A
    start that is not strictly feasible and an H that is not positive semidefinite are INVALID, with ``upper`` NaN.
    Wrong shapes raise ValueError.
    """
    check_shapes(problem)
    goal = gap_goal(tolerance, problem.cost.dtype)
    ranks = (1, 2, 3, 1)
    ranks += () if problem.curvature is None else (2,)
    ranks += () if problem.log_det is None else (0, 2, 3)
    return over_batch(lambda one: minimize(one, goal, max_steps), problem, ranks)
