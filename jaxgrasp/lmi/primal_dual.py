"""A primal-dual interior-point method for linear matrix inequalities (Definition 4). It knows no grasps."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from ..backend import while_loop
from ..core import Array, Status, gap_goal, unit_roundoff
from .combined import Combined, Coordinates, combine, coordinates
from .order import after
from .problem import LMIProblem, LMISolution, check_shapes, over_batch
from .proofs import find_ray, is_ray, lower_bound, upper_bound

__all__ = ["lmi_minimize", "minimize"]

MAX_STEPS = 100
PATIENCE = 8  # steps without a better bound after which the method ends
SHARE = 0.9  # of the way to the edge of the cones
START = 10.0  # times the slope of the cost: the first multiplier; a small one makes the way back to the centre long
REFINEMENTS = 2  # of a direction
FLOOR = 600  # roundoffs, times the order: what rounding may take from the two bounds (float32, order 6: 3e-4)
POLISHINGS = 2  # of the multipliers that a bound is taken from


class _Iterate(eqx.Module):
    x: Array
    Z: Array
    factor: Array  # Cholesky factors of S(x) and of Z
    dual_factor: Array
    best: Array  # the point of the least cost that is proved, and that cost
    upper: Array
    lower: Array
    dual: Array
    direction: Array
    waited: Array  # steps since a bound last got better
    steps: Array
    ended: Array  # nothing more to gain: no usable step, or a ray


def _inner(matrices: Array, M: Array) -> Array:
    return jnp.einsum("iab,ab->i", matrices, M)


def _symmetric(M: Array) -> Array:
    return (M + M.T) / 2


def _normal_solver(J: Array) -> Callable[[Array], Array]:
    """``b -> (J^T J)^-1 b`` from ``J = O R``: the square of J's condition number, which grows like t, never appears.

    Columns are scaled to unit length. A variable nothing holds (a zero column) stays put. R is inverted once, and what
    that leaves out is made good by the refinements: every later direction is then a product, not a call of LAPACK.
    """
    N = J.shape[1]
    length = jnp.linalg.norm(J, axis=0)
    scale = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 1.0)
    unit = J * scale
    ridge = jnp.diag(jnp.where(length > 0, 8 * unit_roundoff(J.dtype), 1.0).astype(J.dtype))
    R = jnp.linalg.qr(jnp.concatenate([unit, ridge]), mode="r")

    inverse = jax.scipy.linalg.solve_triangular(R, jnp.eye(N, dtype=J.dtype))

    def solve(b: Array) -> Array:
        x = jnp.zeros(N, J.dtype)
        for _ in range(1 + REFINEMENTS):
            x = x + inverse @ (inverse.T @ (scale * b - unit.T @ (unit @ x)))
        return scale * x

    return solve


def _to_the_edge(eigen_root: Array, M: Array) -> Array:
    """The largest a with ``diag(lambda) + a M >= 0``, at most 1 / SHARE."""
    least = jnp.linalg.eigvalsh(M / eigen_root / eigen_root[:, None])[0]
    return jnp.where(least < -SHARE, -1 / jnp.where(least < -SHARE, least, -1.0), 1 / SHARE)


def _step(
    problem: Combined, space: Coordinates, iterate: _Iterate
) -> tuple[Array, Array, Array, tuple[Array, Array]]:
    """(dx, S(x)'s own change of Z, what Z's bound is taken from): one step of Mehrotra's method.

    With the Nesterov-Todd scaling ``R^-1 S R^-T = R^T Z R = diag(lambda)`` and ``W_i = R^-1 S_i R^-T`` a direction
    solves ``lambda o (sum_i dx_i W_i + dZ') = target - lambda^2`` and ``tr(W_i dZ') = r_i + (H dx)_i``, r what the
    dual equations miss: a least-squares problem in dx. The target is sigma mu on Q(x), w on B(x): ``B Y = w`` is where
    the log-det term's gradient is a multiplier.
    """
    N, size, _ = space.matrices.shape
    left, values, right = jnp.linalg.svd(iterate.dual_factor.T @ iterate.factor)
    root = jnp.sqrt(values)
    R = iterate.factor @ (right.T / root)
    inverse = (left / root).T @ iterate.dual_factor.T
    W = jnp.einsum("ab,ibc,dc->iad", inverse, space.matrices, inverse)
    J = jnp.concatenate([W.reshape(N, -1), space.root.T], axis=1).T
    solve = _normal_solver(J)
    image = problem.root @ iterate.x
    slope = space.T.T @ problem.cost
    multipliers = _multipliers(space, solve, W, inverse, slope, (iterate.Z, -image))
    rest = slope + space.root.T @ image - _inner(space.matrices, iterate.Z)
    rows = jnp.arange(size)
    pushed = (rows >= problem.order) & (problem.weight > 0)  # rows that are kept at w
    count = jnp.sum(~pushed).astype(values.dtype)

    def direction(target: Array) -> tuple[Array, Array, Array]:
        D = 2 * target / (values + values[:, None])
        dx = solve(_inner(W, D) - rest)
        dS = jnp.einsum("i,iab->ab", dx, W)
        return dx, dS, D - dS

    def centre(mu: Array) -> Array:
        goal = jnp.where(pushed, problem.weight, mu)
        return _symmetric(inverse @ (goal[:, None] * R)) - jnp.diag(values**2)

    def lengths(dS: Array, dZ: Array) -> tuple[Array, Array]:
        edges = jax.lax.map(lambda M: _to_the_edge(root, M), jnp.stack([dS, dZ]))  # a matrix a call
        primal, dual = jnp.minimum(1.0, SHARE * edges)
        if problem.root.shape[0]:  # what the dual equations miss depends on x: one length for both
            primal = dual = jnp.minimum(primal, dual)
        return primal, dual

    def mean(S: Array, Z: Array) -> Array:
        """Of the complementarity of what is not kept at w."""
        share = (~pushed).astype(values.dtype)
        return jnp.sum(_symmetric(inverse @ (share[:, None] * R)) * _symmetric(S @ Z)) / count

    central = jnp.diag(values)
    mu = mean(central, central)
    _, dS, dZ = direction(centre(jnp.zeros_like(mu)))
    primal, dual = lengths(dS, dZ)
    ratio = mean(central + primal * dS, central + dual * dZ) / mu
    shorter = jnp.minimum(primal, dual)
    sigma = jnp.clip(ratio, 0.0, 1.0) ** jnp.maximum(1.0, 3 * shorter**2)
    dx, dS, dZ = direction(centre(sigma * mu) - shorter**2 * _symmetric(dS @ dZ))
    primal, dual = lengths(dS, dZ)
    moved = _symmetric(iterate.Z + dual * inverse.T @ dZ @ inverse)
    return primal * (space.T @ dx), moved, dx, multipliers


def _multipliers(
    space: Coordinates, solve: Callable[[Array], Array], W: Array, inverse: Array, slope: Array,
    given: tuple[Array, Array],
) -> tuple[Array, Array]:  # fmt: skip
    """Z and v for a bound: the equations met by the shortest change in the scaled norm."""
    Z, v = given
    for _ in range(POLISHINGS):
        change = solve(slope - _inner(space.matrices, Z) - space.root.T @ v)
        Z = _symmetric(Z + inverse.T @ jnp.einsum("i,iab->ab", change, W) @ inverse)
        v = v + space.root @ change
    return Z, v


def minimize(problem: LMIProblem, goal: Array, max_steps: int = MAX_STEPS) -> LMISolution:
    """One problem, no batch axes. Under ``jax.vmap`` the problems run one after another: each takes its own number of
    steps, and independent batched LAPACK calls can block each other for ever on a machine of few cores."""
    one = jax.custom_batching.sequential_vmap(lambda problem, goal: _minimize(problem, goal, max_steps))
    return one(problem, goal)


def _minimize(given: LMIProblem, goal: Array, max_steps: int) -> LMISolution:
    given = after(given, given)  # the start too: what found it has ended
    problem = combine(given)
    space = coordinates(problem)
    dtype, q = given.cost.dtype, problem.order

    def near(lower: Array, upper: Array, goal: Array = goal) -> Array:
        return upper - lower <= goal * jnp.maximum(1.0, jnp.abs(upper))

    def unfinished(iterate: _Iterate) -> Array:
        going = ~(near(iterate.lower, iterate.upper) | iterate.ended) & (iterate.waited < PATIENCE)
        return going & (iterate.steps < max_steps)

    def advance(iterate: _Iterate) -> _Iterate:
        change, Z, direction, multipliers = _step(problem, space, iterate)
        lower, dual = lower_bound(problem, *after(multipliers, change))
        x = after(iterate.x + change, lower)
        factor, dual_factor = jax.lax.map(jnp.linalg.cholesky, jnp.stack([problem.S(x), Z]))
        usable = _finite(x, factor, dual_factor)
        upper = upper_bound(problem, jnp.where(usable, x, jnp.nan))
        tighter, cheaper = lower > iterate.lower, upper < iterate.upper
        gains = ~near(iterate.lower, lower) & tighter | cheaper & ~near(upper, iterate.upper)
        return _Iterate(
            x=jnp.where(usable, x, iterate.x),
            Z=jnp.where(usable, Z, iterate.Z),
            factor=jnp.where(usable, factor, iterate.factor),
            dual_factor=jnp.where(usable, dual_factor, iterate.dual_factor),
            best=jnp.where(cheaper, x, iterate.best),
            upper=jnp.where(cheaper, upper, iterate.upper),
            lower=jnp.where(tighter, lower, iterate.lower),
            dual=jnp.where(tighter, dual, iterate.dual),
            direction=space.T @ direction,
            waited=jnp.where(gains, 0, iterate.waited + 1),
            steps=iterate.steps + 1,
            ended=~usable | is_ray(problem, after(x, upper)),
        )

    start = _begin(problem, space, given.start)
    interior = jnp.isfinite(start.upper)
    end = while_loop(unfinished, advance, start, (problem, space, goal))
    ray = find_ray(problem, jnp.stack([-space.idle, end.x, end.x - given.start, end.direction]))
    ray = jnp.where(interior & jnp.isneginf(end.lower), ray, 0.0)
    enough = jnp.maximum(goal, FLOOR * q * unit_roundoff(dtype))
    status = jnp.where(near(end.lower, end.upper, enough), Status.OPTIMAL.value, Status.STALLED.value)
    status = jnp.where(jnp.any(ray != 0), Status.UNBOUNDED.value, status)
    status = jnp.where(interior, status, Status.INVALID.value).astype(jnp.int32)
    lower = jnp.where(interior, jnp.minimum(end.lower, end.upper), -jnp.inf)
    best, upper, lower, dual = after((end.best, end.upper, lower, end.dual[:q, :q]), ray)
    return LMISolution(status, best, upper, lower, dual, ray, end.steps)


def _begin(problem: Combined, space: Coordinates, x: Array) -> _Iterate:
    """At x; ``upper`` is NaN where x is not strictly feasible, or not numbers."""
    slope = space.T.T @ (problem.cost + problem.root.T @ (problem.root @ x))
    size = jnp.linalg.norm(slope)
    Z = START * jnp.where(size > 0, size, 1.0) * jnp.eye(len(problem.constant), dtype=x.dtype)
    factor = jnp.linalg.cholesky(problem.S(after(x, space.T)))
    upper = upper_bound(problem, jnp.where(_finite(factor), x, jnp.nan))
    interior = _finite(factor, upper)  # else: not strictly feasible, or not numbers
    return _Iterate(
        x=x,
        Z=Z,
        factor=factor,
        dual_factor=jnp.sqrt(Z),
        best=x,
        upper=jnp.where(interior, upper, jnp.nan),
        lower=jnp.full((), -jnp.inf, x.dtype),
        dual=jnp.zeros_like(Z),
        direction=jnp.zeros_like(x),
        waited=jnp.zeros((), jnp.int32),
        steps=jnp.zeros((), jnp.int32),
        ended=~(interior & space.held),  # not held: the cost falls for ever
    )


def _finite(*arrays: Array) -> Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(array)) for array in arrays]))


@eqx.filter_jit
def lmi_minimize(problem: LMIProblem, *, tolerance: float = 1e-8, max_steps: int = MAX_STEPS) -> LMISolution:
    """``min h(x)  subject to  Q_0 + sum_i x_i Q_i >= 0`` by Mehrotra's primal-dual method.

    h is linear or convex quadratic, less an optional multiple of log det B(x): see ``LMIProblem``. The path is that of
    the log-det barrier (Definition 4), which is convex (erratum 2); predictor, corrector and Nesterov-Todd scaling are
    those of Todd, Toh, Tutuncu (SIAM J. Optim. 8 (1998)). It needs a strictly feasible ``problem.start``;
    ``lmi_feasibility`` finds one. Leading batch axes, ``jax.vmap`` and ``jax.jit`` all work.

    ``upper`` and ``lower`` are theorems about the numbers given, not estimates: rounding is allowed for, of the point
    and of the multipliers, which need not be met to the last bit. The gap is driven to
    ``tolerance * max(1, |upper|)``, no lower than the dtype and the order q allow (600 q eps): OPTIMAL. A cost that
    falls for ever along a ray
    that the path shows is UNBOUNDED (``sdp_minimize`` also looks for one by itself). Where it gets stuck before, the
    status is STALLED and x is the best point. A start that is not strictly feasible and an H that is not positive
    semidefinite are INVALID, with ``upper`` NaN. Wrong shapes raise ValueError.
    """
    check_shapes(problem)
    goal = gap_goal(tolerance, problem.cost.dtype)
    ranks = (1, 2, 3, 1)
    ranks += () if problem.curvature is None else (2,)
    ranks += () if problem.log_det is None else (0, 2, 3)
    return over_batch(lambda one: minimize(one, goal, max_steps), problem, ranks)
