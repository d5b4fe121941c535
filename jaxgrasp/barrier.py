"""Linear matrix inequalities (11.10)-(11.12) and a log-det barrier method for them (Definitions 3, 4).

An LMI in x is ``Q(x) = Q_0 + sum_i x_i Q_i >= 0`` (positive semidefinite). ``Q_0 .. Q_N`` are any symmetric
matrices, and their size q has nothing to do with the number N of variables. Nothing here knows of grasps.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from ._types import Array, Bool, Float, Int, gap_floor, unit_roundoff

__all__ = [
    "LMIFeasibility",
    "LMIProblem",
    "LMISolution",
    "expect_shape",
    "lmi_feasibility",
    "lmi_minimize",
    "second_order_cone_lmi",
]

# Newton decrement below which an iterate counts as central; below 1 its dual point is feasible.
CENTRED = 0.25
WEIGHT_GROWTH = 20.0  # t grows by this factor at every central point
MAX_STEPS = 250


def expect_shape(condition: bool, name: str, shape: str, value) -> None:
    if not condition:
        raise ValueError(f"{name} must have shape {shape}, got {jnp.shape(value)}")


def second_order_cone_lmi(
    A: Float[Array, "*batch a N"],
    b: Float[Array, "*batch a"],
    c: Float[Array, "*batch N"],
    d: Float[Array, "*batch"],
) -> tuple[Float[Array, "*batch q q"], Float[Array, "*batch N q q"]]:
    """``|A x + b| <= c.x + d  iff  [[(c.x + d) I, A x + b], [(A x + b)^T, c.x + d]] >= 0`` (11.11)-(11.12).

    Returns Q_0 (*batch, q, q) and Q_1 .. Q_N (*batch, N, q, q), q = a + 1. The lower right entry is the
    scalar c.x + d (erratum 12: not a second multiple of I).
    """
    A, b, c, d = (jnp.asarray(value) for value in (A, b, c, d))
    expect_shape(A.ndim >= 2, "A", "(*batch, a, N)", A)
    rows, columns = A.shape[-2:]
    expect_shape(b.shape[-1:] == (rows,), "b", f"(*batch, {rows})", b)
    expect_shape(c.shape[-1:] == (columns,), "c", f"(*batch, {columns})", c)
    stacked = jnp.concatenate(
        [b[..., None], A], axis=-1
    )  # column 0: the constant part; column i: that of x_i
    heights = jnp.concatenate([d[..., None], c], axis=-1)
    arrows = jnp.zeros((rows, rows + 1, rows + 1), A.dtype)
    index = jnp.arange(rows)
    arrows = arrows.at[index, index, rows].set(1.0).at[index, rows, index].set(1.0)
    Q = jnp.einsum("...ai,apr->...ipr", stacked, arrows)
    Q = Q + heights[..., None, None] * jnp.eye(rows + 1, dtype=A.dtype)
    return Q[..., 0, :, :], Q[..., 1:, :, :]


# The LMI optimisation problem (Definition 4) -----------------------------------------------------------


class LMIProblem(eqx.Module):
    """``min c.x  subject to  Q(x) = Q_0 + sum_i x_i Q_i >= 0``, and a point where Q(x) > 0.

    cost      (*batch, N)        c
    constant  (*batch, q, q)     Q_0, symmetric
    matrices  (*batch, N, q, q)  Q_1 .. Q_N, symmetric
    start     (*batch, N)        strictly feasible
    """

    cost: Float[Array, "*batch N"]
    constant: Float[Array, "*batch q q"]
    matrices: Float[Array, "*batch N q q"]
    start: Float[Array, "*batch N"]

    def Q(self, x: Float[Array, "*batch N"]) -> Float[Array, "*batch q q"]:
        """``Q(x) = Q_0 + sum_i x_i Q_i`` (11.10)."""
        return self.constant + jnp.einsum("...i,...iab->...ab", x, self.matrices)


class LMISolution(eqx.Module):
    """A strictly feasible point and how far from optimal it can be: the optimum lies in [bound, value].

    x           (*batch, N)  strictly feasible
    value       (*batch)     c.x
    gap         (*batch)     value - bound; infinite before the first central point
    iterations  (*batch)     Newton steps, int32
    converged   (*batch)     whether the gap met ``tolerance * max(1, |value|)``
    """

    x: Float[Array, "*batch N"]
    value: Float[Array, "*batch"]
    gap: Float[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    converged: Bool[Array, "*batch"]

    @property
    def bound(self) -> Float[Array, "*batch"]:
        """``-tr(Q_0 Z)`` of a dual point Z >= 0 with ``tr(Q_i Z) = c_i``: no feasible x costs less."""
        return self.value - self.gap


class _Iterate(eqx.Module):
    x: Array
    factor: Array  # Cholesky factor of Q(x)
    weight: Array  # t
    bound: Array
    steps: Array
    stalled: Array


class _NewtonStep(eqx.Module):
    direction: Array
    decrement: Array
    bound: Array  # dual value of the point the step defines; valid where decrement < 1
    length: Array


def _newton_step(problem: LMIProblem, iterate: _Iterate) -> _NewtonStep:
    """One Newton step of ``phi_t(x) = t c.x - log det Q(x)`` with an exact line search.

    With ``Q = L L^T`` and ``W_i = L^-1 Q_i L^-T``: ``grad_i = t c_i - tr W_i``, ``H_ij = tr(W_i W_j)``.
    ``Z = L^-T (I - sum_i dx_i W_i) L^-1 / t`` then has ``tr(Q_i Z) = c_i``, and is >= 0 once the decrement is
    below 1: a dual point, with gap ``tr(Q Z) = (q - sum_i dx_i tr W_i) / t``, which is q / t at the centre.
    """
    t, size = iterate.weight, problem.constant.shape[-1]
    inverse = jax.scipy.linalg.solve_triangular(iterate.factor, jnp.eye(size, dtype=t.dtype), lower=True)
    W = jnp.einsum("ab,ibc,dc->iad", inverse, problem.matrices, inverse)
    trace = jnp.trace(W, axis1=-2, axis2=-1)
    gradient = t * problem.cost - trace
    direction = _solve_spd(jnp.einsum("iab,jab->ij", W, W), -gradient)
    decrement = jnp.sqrt(jnp.maximum(-gradient @ direction, 0.0))
    gap = (size - direction @ trace) / t

    eigenvalues = jnp.linalg.eigvalsh(jnp.einsum("i,iab->ab", direction, W))
    slope = t * (problem.cost @ direction)
    length = jnp.where(decrement <= CENTRED, 1.0, _line_search(slope, eigenvalues))
    return _NewtonStep(direction, decrement, problem.cost @ iterate.x - gap, length)


def _solve_spd(H: Array, b: Array) -> Array:
    """``H^-1 b`` by Cholesky in unit-diagonal scaling. A variable no matrix contains (H_ii = 0) stays put if
    its cost is 0; a ridge at rounding level lets linearly dependent matrices pass."""
    diagonal = jnp.diagonal(H)
    scale = jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 1.0)
    ridge = 8 * unit_roundoff(H.dtype)
    unit = jnp.where(diagonal > 0, ridge, 1.0)
    factor = jnp.linalg.cholesky(H * scale[:, None] * scale[None, :] + jnp.diag(unit.astype(H.dtype)))
    return scale * jax.scipy.linalg.cho_solve((factor, True), scale * b)


def _line_search(slope: Array, eigenvalues: Array) -> Array:
    """Minimise ``a slope - sum log(1 + a e)`` over a >= 0 by bisection on its derivative."""
    smallest = jnp.min(eigenvalues)
    wall = jnp.where(smallest < 0, -0.99 / jnp.where(smallest < 0, smallest, -1.0), jnp.inf)

    def bisect(_, bracket):
        low, high = bracket
        middle = (low + high) / 2
        rising = slope - jnp.sum(eigenvalues / (1 + middle * eigenvalues)) > 0
        return jnp.where(rising, low, middle), jnp.where(rising, middle, high)

    low, _ = jax.lax.fori_loop(0, 20, bisect, (jnp.zeros_like(wall), jnp.minimum(wall, 16.0)))
    return low


def _minimize(problem: LMIProblem, tolerance: Array, max_steps: int) -> LMISolution:
    """Follow the central path: a Newton step on phi_t; where x was central, bound the optimum, raise t."""
    dtype = problem.cost.dtype

    def value(x: Array) -> Array:
        return problem.cost @ x

    def good(iterate: _Iterate) -> Array:
        cost = value(iterate.x)
        return cost - iterate.bound <= tolerance * jnp.maximum(1.0, jnp.abs(cost))

    def unfinished(iterate: _Iterate) -> Array:
        return ~(good(iterate) | iterate.stalled) & (iterate.steps < max_steps)

    def advance(iterate: _Iterate) -> _Iterate:
        step = _newton_step(problem, iterate)
        central = step.decrement <= CENTRED
        x = iterate.x + step.length * step.direction
        factor = jnp.linalg.cholesky(problem.Q(x))
        usable = jnp.all(jnp.isfinite(factor)) & jnp.all(jnp.isfinite(x))
        return _Iterate(
            x=jnp.where(usable, x, iterate.x),
            factor=jnp.where(usable, factor, iterate.factor),
            weight=jnp.where(central, WEIGHT_GROWTH * iterate.weight, iterate.weight),
            bound=jnp.where(central, step.bound, iterate.bound),
            steps=iterate.steps + 1,
            stalled=~usable,
        )

    factor = jnp.linalg.cholesky(problem.Q(problem.start))
    start = _Iterate(
        x=problem.start,
        factor=factor,
        weight=jnp.ones((), dtype),
        bound=jnp.full((), -jnp.inf, dtype),
        steps=jnp.zeros((), jnp.int32),
        stalled=~jnp.all(jnp.isfinite(factor)),  # not strictly feasible, or not numbers
    )
    end = jax.lax.while_loop(unfinished, advance, start)
    cost = jnp.where(jnp.all(jnp.isfinite(factor)), value(end.x), jnp.nan)
    return LMISolution(end.x, cost, jnp.maximum(cost - end.bound, 0.0), end.steps, good(end))


def _over_batch(function, problem: LMIProblem):
    """Apply a function of one problem over the leading batch axes."""
    batch = jnp.broadcast_shapes(
        problem.cost.shape[:-1],
        problem.constant.shape[:-2],
        problem.matrices.shape[:-3],
        problem.start.shape[:-1],
    )
    lanes = [
        jnp.broadcast_to(leaf, (*batch, *leaf.shape[leaf.ndim - rank :])).reshape(
            -1, *leaf.shape[leaf.ndim - rank :]
        )
        for leaf, rank in zip(
            (problem.cost, problem.constant, problem.matrices, problem.start), (1, 2, 3, 1), strict=True
        )
    ]
    if not batch:
        return function(LMIProblem(*(lane[0] for lane in lanes)))
    result = jax.vmap(function)(LMIProblem(*lanes))
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), result)


@eqx.filter_jit
def lmi_minimize(problem: LMIProblem, tolerance: float = 1e-8, max_steps: int = MAX_STEPS) -> LMISolution:
    """``min c.x  subject to  Q_0 + sum_i x_i Q_i >= 0`` by Newton's method on ``t c.x - log det Q(x)``.

    A log-det path-following method (Definition 4; Boyd, Vandenberghe, Convex Optimization, chapter 11): the
    barrier is -log det, which is convex (erratum 2), and it needs a strictly feasible ``problem.start``; see
    ``lmi_feasibility`` for one. Leading batch axes, ``jax.vmap`` and ``jax.jit`` all work.

    The gap is that of a dual point, not an estimate; it is driven to ``tolerance * max(1, |value|)``, no
    lower than the dtype allows. Where it gets stuck before, ``converged`` is False and x is the best point. A
    start that is not strictly feasible gives value NaN. Wrong shapes raise ValueError.
    """
    N, q = problem.cost.shape[-1], problem.constant.shape[-1]
    expect_shape(problem.constant.shape[-2:] == (q, q), "constant", "(*batch, q, q)", problem.constant)
    expect_shape(
        problem.matrices.shape[-3:] == (N, q, q), "matrices", f"(*batch, {N}, {q}, {q})", problem.matrices
    )
    expect_shape(problem.start.shape[-1:] == (N,), "start", f"(*batch, {N})", problem.start)
    dtype = problem.cost.dtype
    goal = jnp.maximum(jnp.asarray(tolerance, dtype), jnp.asarray(gap_floor(dtype), dtype))
    return _over_batch(lambda one: _minimize(one, goal, max_steps), problem)


# The LMI feasibility problem (Definition 4) ------------------------------------------------------------


class LMIFeasibility(eqx.Module):
    """Answer to: is there an x with Q(x) > 0?

    x         (*batch, N)  strictly feasible where ``feasible``
    depth     (*batch)     a lower bound on the normalised depth s*; s* > 0 iff the strict LMI has a solution
    gap       (*batch)     s* lies in [depth, depth + gap]
    feasible  (*batch)     depth > 0: Q(x) > 0 was reached
    """

    x: Float[Array, "*batch N"]
    depth: Float[Array, "*batch"]
    gap: Float[Array, "*batch"]
    feasible: Bool[Array, "*batch"]


@eqx.filter_jit
def lmi_feasibility(
    constant: Float[Array, "*batch q q"], matrices: Float[Array, "*batch N q q"], tolerance: float = 1e-8
) -> LMIFeasibility:
    """``s* = max s  subject to  x_0 Q_0 + sum_i x_i Q_i >= s I,  x_0 >= s,  |(x_0, x)| <= 1``: feasible iff >
    0.

    This is (11.17) with s = -eta and the normalisation it lacks: ``min eta`` alone is homogeneous, so its
    value would be 0 or -infinity (erratum 1), and ``Q(x) >= 0`` alone is met by x = 0 in (11.15). The point
    returned is x / x_0.
    """
    N, q = matrices.shape[-3], constant.shape[-1]
    expect_shape(matrices.shape[-3:] == (N, q, q), "matrices", f"(*batch, N, {q}, {q})", matrices)
    dtype = matrices.dtype

    def one(problem: LMIProblem) -> LMIFeasibility:
        # Variables (x_0, x_1 .. x_N, s); blocks: the LMI, x_0 - s, the unit ball.
        ball_constant, ball = second_order_cone_lmi(
            jnp.eye(N + 1, N + 2, dtype=dtype),
            jnp.zeros(N + 1, dtype),
            jnp.zeros(N + 2, dtype),
            jnp.ones((), dtype),
        )
        lmi = jnp.concatenate(
            [problem.constant[None], problem.matrices, -jnp.eye(q, dtype=dtype)[None]]
        )  # (N + 2, q, q)
        height = jnp.zeros((N + 2, 1, 1), dtype).at[0].set(1.0).at[-1].set(-1.0)
        blocks = [jax.vmap(jax.scipy.linalg.block_diag)(lmi, height, ball)]
        centre = jax.scipy.linalg.block_diag(jnp.zeros((q + 1, q + 1), dtype), ball_constant)
        cost = jnp.zeros(N + 2, dtype).at[-1].set(-1.0)
        start = jnp.zeros(N + 2, dtype).at[-1].set(-1.0)
        goal = jnp.maximum(jnp.asarray(tolerance, dtype), jnp.asarray(gap_floor(dtype), dtype))
        end = _minimize(LMIProblem(cost, centre, blocks[0], start), goal, MAX_STEPS)
        depth = -end.value
        return LMIFeasibility(end.x[1:-1] / end.x[0], depth, end.gap, depth > 0)

    unused = jnp.zeros(N, dtype)
    return _over_batch(one, LMIProblem(unused, constant, matrices, unused))
