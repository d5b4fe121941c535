"""Second-order cones as LMIs (11.12); whether an LMI has a solution, with a proof either way (Definition 4,
feasibility); the semidefinite program in dual form (Definition 6). The method is primal_dual.py's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from ..backend import varying_like
from ..core import (
    Answer,
    Array,
    Float,
    Int,
    Status,
    bracket_width,
    gap_goal,
    nan_where,
    real_array,
    rounding_constant,
    unit_roundoff,
)
from .combined import combine
from .primal_dual import lmi_minimize, minimize
from .problem import LMIProblem, LMISolution, bracket_words, expect_shape, over_batch
from .proofs import find_ray, lower_bound, upper_bound

__all__ = [
    "LMIFeasibility",
    "SDPSolution",
    "feasibility",
    "lmi_feasibility",
    "sdp_minimize",
    "second_order_cone_lmi",
]


# Second-order cones ------------------------------------------------------------------------------------


def second_order_cone_lmi(
    A: Float[ArrayLike, "*batch a N"],
    b: Float[ArrayLike, "*batch a"],
    c: Float[ArrayLike, "*batch N"],
    d: Float[ArrayLike, "*batch"],
) -> tuple[Float[Array, "*batch q q"], Float[Array, "*batch N q q"]]:
    """``|A x + b| <= c.x + d  iff  [[(c.x + d) I, A x + b], [(A x + b)^T, c.x + d]] >= 0`` (11.11)-(11.12).

    Returns Q_0 (*batch, q, q) and Q_1 .. Q_N (*batch, N, q, q), q = a + 1. The lower right entry is the
    scalar c.x + d (erratum 12: not a second multiple of I).
    """
    A, b, c, d = (real_array(value, name) for value, name in zip((A, b, c, d), "Abcd", strict=True))
    expect_shape(A.ndim >= 2, "A", "(*batch, a, N)", A)
    rows, columns = A.shape[-2:]
    expect_shape(b.shape[-1:] == (rows,), "b", f"(*batch, {rows})", b)
    expect_shape(c.shape[-1:] == (columns,), "c", f"(*batch, {columns})", c)
    return _arrow(A, b, c, d)


@jax.jit
def _arrow(A: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array]:
    rows = A.shape[-2]
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


# The LMI feasibility problem (Definition 4) ------------------------------------------------------------


class LMIFeasibility(Answer):
    """``lower <= s* <= upper``: is there an x with Q(x) > 0, or at least with Q(x) >= 0?

    status       (*batch) int32, a ``Status``: FEASIBLE, Q(x) > 0 at ``x``, rounding allowed for; INFEASIBLE, no x with
                 Q(x) >= 0: ``certificate`` proves it as far as ``reach``; MARGINAL, neither, and s* <= tolerance: no
                 Q(x) > 0 of that depth, Q(x) >= 0 remains open; UNDECIDED; INVALID
    x            (*batch, N)     strictly feasible where FEASIBLE
    lower, upper (*batch)        bounds of the normalised depth s*; s* > 0 iff the strict LMI has a solution
    certificate  (*batch, q, q)  Z >= 0 with tr Z = 1, and where INFEASIBLE ``tr(Q_i Z) = 0``, ``tr(Q_0 Z) < 0``
    reach        (*batch)        Z excludes every x with ``|x_i| |Q_i| < reach |Q_0|`` as a vector, no unit; infinite:
                 multipliers next to Z meet their equations exactly and exclude every x; 0: none
    """

    status: Int[Array, "*batch"]
    x: Float[Array, "*batch N"]
    lower: Float[Array, "*batch"]
    upper: Float[Array, "*batch"]
    certificate: Float[Array, "*batch q q"]
    reach: Float[Array, "*batch"]

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.FEASIBLE: "Feasible: the matrix is positive definite at x.",
        Status.INFEASIBLE: "Infeasible: the matrix is positive semidefinite nowhere in reach of the certificate.",
        Status.MARGINAL: "Marginal: the matrix is positive definite nowhere by more than the tolerance; whether it is "
        "positive semidefinite somewhere remains open.",
        Status.INVALID: "Invalid: an entry of the matrices is not finite.",
    }

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """The bracket of one lane's depth in words."""
        return bracket_words("Depth", self.lower, self.upper, index)


@eqx.filter_jit
def lmi_feasibility(
    constant: Float[ArrayLike, "*batch q q"],
    matrices: Float[ArrayLike, "*batch N q q"],
    *,
    tolerance: float = 1e-8,
) -> LMIFeasibility:
    """``s* = max s  subject to  x_0 Q_0 + sum_i x_i Q_i >= s I,  x_0 >= s,  |(x_0, x)| <= 1``: strictly feasible
    iff s* > 0.

    Every Q_i is first divided by its Frobenius norm, so that no answer depends on units. This is (11.17) with s = -eta
    and the normalisation it lacks: ``min eta`` alone is homogeneous, so its value would be 0 or -infinity (erratum 1),
    and ``Q(x) >= 0`` alone is met by x = 0 in (11.15). The point returned is x / x_0.

    The multiplier Z of the matrix block answers the rest. ``Z >= 0`` with ``tr(Q_i Z) = 0`` and ``tr(Q_0 Z) < 0``
    makes ``tr(Q(x) Z) < 0`` for every x, so Q(x) >= 0 has no solution. In floating point the traces are zero up to
    some rho. Where Z > 0 by more, traces that are exactly zero belong to some Z next to it, and the reach is infinite;
    else Z excludes every x with ``|x| < -tr(Q_0 Z) / rho``, and the answer is INFEASIBLE where this reach is at least
    1 / tolerance. An LMI that has solutions only as x grows without bound, or none but almost (``[[x, 1],
    [1, 0]]``), is MARGINAL. Wrong shapes raise ValueError.
    """
    constant, matrices = real_array(constant, "constant"), real_array(matrices, "matrices")
    N, q = matrices.shape[-3], constant.shape[-1]
    expect_shape(constant.shape[-2:] == (q, q), "constant", "(*batch, q, q)", constant)
    expect_shape(matrices.shape[-3:] == (N, q, q), "matrices", f"(*batch, N, {q}, {q})", matrices)
    goal = gap_goal(tolerance, matrices.dtype)
    one = jax.custom_batching.sequential_vmap(feasibility)  # one after another, see primal_dual.minimize
    return over_batch(lambda problem: one(*problem, goal), (constant, matrices), (2, 3))


def _unit(matrices: Array) -> tuple[Array, Array]:
    """The matrices over their Frobenius norms, and the norms; zero matrices as they are, over 1."""
    size = jnp.sqrt(jnp.sum(matrices * matrices, axis=(-2, -1)))
    size = jnp.where(size == 0, 1.0, size)
    return matrices / size[..., None, None], size


def _deepest(constant: Array, matrices: Array, goal: Array) -> tuple[LMISolution, Array]:
    """The answer of ``lmi_feasibility``'s problem, and x."""
    N, q, dtype = matrices.shape[0], constant.shape[-1], matrices.dtype
    scaled, sizes = _unit(jnp.concatenate([constant[None], matrices]))
    # Variables (x_0, x_1 .. x_N, s); blocks: the LMI, x_0 - s, the unit ball.
    ball_constant, ball = second_order_cone_lmi(
        jnp.eye(N + 1, N + 2, dtype=dtype),
        jnp.zeros(N + 1, dtype),
        jnp.zeros(N + 2, dtype),
        jnp.ones((), dtype),
    )
    lmi = jnp.concatenate([scaled, -jnp.eye(q, dtype=dtype)[None]])  # (N + 2, q, q)
    height = jnp.zeros((N + 2, 1, 1), dtype).at[0].set(1.0).at[-1].set(-1.0)
    blocks = jax.vmap(jax.scipy.linalg.block_diag)(lmi, height, ball)
    centre = jax.scipy.linalg.block_diag(jnp.zeros((q + 1, q + 1), dtype), ball_constant)
    down = jnp.zeros(N + 2, dtype).at[-1].set(-1.0)
    end = minimize(LMIProblem(down, centre, blocks, down), goal)
    return end, end.x[1:-1] / end.x[0] * sizes[0] / sizes[1:]


def feasibility(constant: Array, matrices: Array, goal: Array) -> LMIFeasibility:
    """One problem, no batch axes."""
    q, dtype = constant.shape[-1], matrices.dtype
    end, x = _deepest(constant, matrices, goal)
    depth = -end.upper
    still = LMIProblem(jnp.zeros_like(x), constant, matrices, x)
    feasible = (depth > 0) & jnp.isfinite(upper_bound(combine(still), x))
    Z = end.dual[:q, :q]
    total = jnp.trace(Z)
    Z = Z / jnp.where(total > 0, total, 1.0)
    # A cost of zero that is at least something positive: nothing is feasible. No question where x is.
    least, _ = lower_bound(combine(still), jnp.where(feasible, 0.0, Z), jnp.zeros(0, dtype))
    rounding = rounding_constant() * q * unit_roundoff(dtype)
    scaled, _ = _unit(jnp.concatenate([constant[None], matrices]))
    traces = jnp.einsum("iab,ab->i", scaled, Z)
    leak = jnp.sqrt(jnp.sum(traces[1:] ** 2)) + rounding
    reach = jnp.maximum(-traces[0] - rounding, 0.0) / leak
    reach = jnp.where(least > 0, jnp.inf, reach)
    infeasible = ~feasible & (reach * goal >= 1)
    finite = jnp.all(jnp.isfinite(constant)) & jnp.all(jnp.isfinite(matrices))
    status = jnp.where(-end.lower <= goal, Status.MARGINAL.value, Status.UNDECIDED.value)
    status = jnp.where(infeasible, Status.INFEASIBLE.value, status)
    status = jnp.where(feasible, Status.FEASIBLE.value, status)
    status = jnp.where(finite, status, Status.INVALID.value).astype(jnp.int32)
    return LMIFeasibility(status, x, depth, -end.lower, Z, reach)


# The semidefinite program in dual form (Definition 6) --------------------------------------------------


class SDPSolution(Answer):
    """``lower <= min u.x <= upper``: a primal and a dual point of an SDP.

    status     (*batch) int32, a ``Status``: OPTIMAL where ``upper - lower <= tolerance * max(1, |upper|)``;
               UNBOUNDED, ``ray`` proves it; STALLED, the point is feasible but the gap did not close: no Z > 0 may be a
               dual point, or a ray lies on the edge of its cone; INFEASIBLE; MARGINAL, no strictly feasible start;
               UNDECIDED; INVALID
    x          (*batch, N)     strictly feasible; NaN where no strictly feasible point was found
    upper      (*batch)        u.x; infinite where INFEASIBLE, NaN where there is no x
    lower      (*batch)        ``-tr(S_0 Z)``: no feasible x costs less; -infinite where no dual point was found,
               infinite where INFEASIBLE without limit (``feasibility.reach`` is infinite)
    ray        (*batch, N)     where UNBOUNDED, d: ``sum_i d_i S_i >= 0``, ``u.d < 0``; else 0
    Z          (*batch, q, q)  Z >= 0 with ``tr(S_i Z) = u_i``; where INFEASIBLE, the certificate: ``tr(S_i Z) = 0``,
                               ``tr(S_0 Z) < 0``
    feasibility                the answer of phase one, (*batch)
    """

    status: Int[Array, "*batch"]
    x: Float[Array, "*batch N"]
    upper: Float[Array, "*batch"]
    lower: Float[Array, "*batch"]
    ray: Float[Array, "*batch N"]
    Z: Float[Array, "*batch q q"]
    feasibility: LMIFeasibility

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        **LMIFeasibility.SENTENCES,
        Status.STALLED: "Stalled: the point is strictly feasible; rounding, or a problem without a dual point inside "
        "its cone, ended the method before its gap.",
        Status.INVALID: "Invalid: a number is not finite.",
    }

    @property
    def gap(self) -> Float[Array, "*batch"]:
        """``upper - lower >= 0``: no feasible x is cheaper by more; 0 where INFEASIBLE."""
        return bracket_width(self.lower, self.upper)

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """The bracket of one lane's cost in words."""
        return bracket_words("Cost", self.lower, self.upper, index)


@eqx.filter_jit
def sdp_minimize(
    u: Float[ArrayLike, "*batch N"],
    constant: Float[ArrayLike, "*batch q q"],
    matrices: Float[ArrayLike, "*batch N q q"],
    *,
    tolerance: float = 1e-8,
) -> SDPSolution:
    """``min u.x  subject to  S_0 + sum_i x_i S_i >= 0``, with ``max -tr(S_0 Z)`` s.t. ``tr(S_i Z) = u_i, Z >= 0``.

    The semidefinite program in dual form of Definition 6. ``constant`` is S_0, ``matrices`` are S_1 .. S_N: any
    symmetric matrices (erratum 3: they need not be positive semidefinite). ``lmi_feasibility`` finds the start;
    ``lmi_minimize`` takes it from there. Wrong shapes raise ValueError.
    """
    u, constant, matrices = (
        real_array(x, name) for x, name in ((u, "u"), (constant, "constant"), (matrices, "matrices"))
    )
    N, q = u.shape[-1], constant.shape[-1]
    expect_shape(constant.shape[-2:] == (q, q), "constant", "(*batch, q, q)", constant)
    expect_shape(matrices.shape[-3:] == (N, q, q), "matrices", f"(*batch, {N}, {q}, {q})", matrices)
    phase = lmi_feasibility(constant, matrices, tolerance=tolerance)
    feasible = phase.status == Status.FEASIBLE.value
    start = nan_where(~feasible[..., None], phase.x)
    end = lmi_minimize(LMIProblem(u, constant, matrices, start), tolerance=tolerance)
    batch = end.batch_shape
    phase = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape[feasible.ndim :])), phase)
    infeasible = phase.status == Status.INFEASIBLE.value
    wanted = (end.status == Status.STALLED.value) & jnp.isneginf(end.lower)
    found = over_batch(lambda one: _sequential_ray(*one), (u, constant, matrices, wanted), (1, 2, 3, 0))
    ray = jnp.where(wanted[..., None], found, end.ray)
    status = jnp.where(jnp.any(ray != 0, axis=-1), Status.UNBOUNDED.value, end.status)
    return SDPSolution(
        status=jnp.where(feasible, status, phase.status),
        x=end.x,
        upper=jnp.where(infeasible, jnp.inf, end.upper),
        lower=jnp.where(infeasible & jnp.isinf(phase.reach), jnp.inf, end.lower),
        ray=ray,
        Z=jnp.where(infeasible[..., None, None], phase.certificate, end.dual),
        feasibility=phase,
    )


@jax.custom_batching.sequential_vmap
def _sequential_ray(u: Array, constant: Array, matrices: Array, wanted: Array) -> Array:
    """A ray by its own feasibility problem, ``sum_i d_i S_i > 0, -u.d > 0``, where one is wanted; 0: none."""

    def search() -> Array:
        blocks = jax.vmap(jax.scipy.linalg.block_diag)(matrices, -u[:, None, None])
        goal = gap_goal(1e-8, u.dtype)
        _, ray = _deepest(jnp.zeros_like(blocks[0]), blocks, goal)
        return find_ray(combine(LMIProblem(u, constant, matrices, ray)), ray[None])

    none = varying_like((u, constant, matrices))(jnp.zeros_like(u))
    return jax.lax.cond(wanted, search, lambda: none)
