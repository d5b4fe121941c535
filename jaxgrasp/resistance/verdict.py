"""From a solved lane to a verdict with its proof: polish, certify, translate back (theory section 2).

The conditions are the checker's (``certificates/resistance.py``) with a larger rounding constant, evaluated in the
working dtype: what passes here passes there. Nothing is claimed that was not certified.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage
from ..conic import Cone, cone_min, cone_sum, entries, inner, interior_distance, matvec, rmatvec, vector_norm
from ..contacts import Folded, Tile, normalized, onto_null_space, smallest_slack, to_body, to_twist, unfold
from ..core import Array, Status, first_of, rank_tolerance, rounding_constant, unit_roundoff
from .problem import upper_bound

__all__ = ["Rank", "Verdict", "judge"]


class Rank(NamedTuple):
    """Rank of A by its singular values: count (L,), smallest value (L,), its left vector (m, L)."""

    count: Array
    smallest: Array
    null_twist: Array


class Verdict(NamedTuple):
    """The answer of each lane, in the units of the caller; lanes on the last axis."""

    status: Array
    margin: Array
    gap: Array
    rank: Array
    internal_force: Array  # (k n, L)
    escape_twist: Array  # (m, L)
    bound_twist: Array  # (m, L)


class Primal(NamedTuple):
    """What the solver's forces show: the internal force s next to them, and how far an exact one is.

    slack      (L,) min_i s_0,i - |s_1..,i|       near   (L,) some exact internal force has at least slack - near
    resistant  (L,) bool: it is inside every cone, and A has full rank
    """

    s: Cone
    slack: Array
    near: Array
    resistant: Array


class Dual(NamedTuple):
    """What the solver's multipliers show: an upper bound of t*, the twist behind it, and the one that escapes.

    escapes    (L,) bool: no contact can oppose the twist     deficient  (L,) bool: A has not full rank
    """

    upper: Array
    bound_twist: Array
    twist: Array
    escapes: Array
    deficient: Array


class Bracket(NamedTuple):
    """t* lies in [lower, lower + gap] (L,); ``blur`` is what rounding can do to an end."""

    lower: Array
    gap: Array
    blur: Array


@stage
def _norms(columns: Cone, s: Cone) -> tuple[Array, Array]:
    """``|A s|`` and ``|s|``."""
    return vector_norm(matvec(columns, s)), jnp.sqrt(cone_sum(inner(s, s)))


@stage
def _unit_twist(y: Array) -> Array:
    size = vector_norm(y)
    safe = jnp.where((size > 0) & jnp.isfinite(size), size, jnp.ones_like(size))
    return y / safe


@stage
def _escape_depth(columns: Cone, exists: Array, xi: Array, rounding: Array) -> Array:
    """``min_i x_0,i - |x_1..,i| - c eps |A_i|`` with ``x = A^T xi``: positive proves that xi escapes."""
    x = rmatvec(columns, xi)
    square = reduce(jnp.add, [row * row for c in columns for row in entries(c)])[0]
    depth = interior_distance(x) - rounding * jnp.sqrt(square)
    return cone_min(jnp.where(exists > 0, depth, jnp.full_like(depth, jnp.inf)))


@stage
def _unseen(columns: Cone, xi: Array) -> Array:
    """``|A^T xi|``: zero for a twist that no contact notices."""
    x = rmatvec(columns, xi)
    return jnp.sqrt(cone_sum(inner(x, x)))


def judge(tile: Tile, rank: Rank, u: Cone, y: Array, unbounded: Array, tolerance: Array) -> Verdict:
    """Certify one tile at the solver's forces u and multipliers y.

    rank       consulted only where the projection could not prove full rank itself
    unbounded  (L,) bool: t* = -inf
    """
    folded, m = tile.folded, y.shape[0]
    count = jnp.where(tile.projection.sigma > 0, m * jnp.ones_like(folded.norm), rank.count)
    full_rank = count >= m
    primal = _primal_evidence(tile, rank, full_rank, u)
    dual = _dual_evidence(tile, rank, full_rank, y)
    bracket = _bracket(primal, dual)
    status = _status(folded.valid, full_rank, primal, dual, bracket, tolerance)

    force = unfold(primal.s, tile.components, *tile.coefficients)
    bound_twist = _unit_twist(to_body(dual.bound_twist, folded.length, tile.dimension))
    twist = _unit_twist(to_body(dual.twist, folded.length, tile.dimension))
    twist = jnp.where(status == Status.RESISTANT.value, jnp.zeros_like(twist), twist)
    one = jnp.ones_like(folded.norm)

    def valid(x: Array) -> Array:
        return jnp.where(folded.valid, x, jnp.nan * one)

    return Verdict(
        status,
        valid(jnp.where(unbounded, -jnp.inf * one, bracket.lower)),
        valid(jnp.where(unbounded, jnp.zeros_like(bracket.gap), bracket.gap)),
        valid(count),
        valid(jnp.where(unbounded, jnp.zeros_like(force), force)),
        valid(twist),
        valid(bound_twist),
    )


def _rounding(folded: Folded) -> Array:
    dtype = folded.norm.dtype
    return jnp.asarray(rounding_constant() * unit_roundoff(dtype), dtype)


def _primal_evidence(tile: Tile, rank: Rank, full_rank: Array, u: Cone) -> Primal:
    """The exact internal force next to ``s = u - t e``."""
    folded, projection, rounding = tile.folded, tile.projection, _rounding(tile.folded)
    eps, one = unit_roundoff(folded.norm.dtype), jnp.ones_like(folded.norm)
    t = 1 - cone_sum(folded.exists * u[0]) / folded.count
    s = (folded.exists * (u[0] + t), *(folded.exists * x for x in u[1:]))
    s = normalized(folded, onto_null_space(projection, s))
    slack = smallest_slack(folded.exists, s)
    residual, size = _norms(folded.columns, s)
    sigma = jnp.where(projection.sigma > 0, projection.sigma, rank.smallest)
    room = sigma - rounding * folded.norm
    safe = jnp.where(room > 0, room, one)
    shift = jnp.sqrt(2 * one) * (residual + rounding * folded.norm * size) / safe
    # The exact internal force lies within near / 2 of s.
    near = 2 * jnp.sqrt(2 * one) * (residual + 4 * eps * folded.norm * size) / safe
    certain = full_rank & (room > 0)
    return Primal(s, slack, jnp.where(certain, near, jnp.zeros_like(near)), certain & (shift < slack))


def _dual_evidence(tile: Tile, rank: Rank, full_rank: Array, y: Array) -> Dual:
    """The bound of t*, and the twist behind it.

    Where t* is huge and negative the iterates may stall, but the twist of the projection still escapes.
    """
    folded, basis = tile.folded, tile.projection.basis
    simple = basis.resultant
    upper = upper_bound(basis, y)
    bound = upper_bound(basis, -simple)
    better = bound < upper
    opposing = jnp.where(better, simple, -y)
    xi = _unit_twist(to_twist(tile.projection, opposing))
    escapes = _escape_depth(folded.columns, folded.exists, xi, _rounding(folded)) > 0
    null = rank.null_twist
    unseen = _unseen(folded.columns, null) <= rank_tolerance(folded.norm.dtype) * folded.norm
    deficient = ~full_rank & unseen
    use_null = deficient & ~escapes
    twist = jnp.where(use_null, null, xi)
    return Dual(jnp.where(better, bound, upper), xi, twist, escapes, deficient)


def _bracket(primal: Primal, dual: Dual) -> Bracket:
    eps = unit_roundoff(primal.slack.dtype)
    blur = 16 * eps * (1 + jnp.abs(primal.slack) + jnp.abs(dual.upper))
    lower, upper = primal.slack - blur - primal.near, dual.upper + blur
    # Rounding must not turn the bracket round.
    lower, upper = jnp.minimum(lower, upper), jnp.maximum(lower, upper)
    return Bracket(lower, upper - lower, blur)


def _status(
    valid: Array, full_rank: Array, primal: Primal, dual: Dual, bracket: Bracket, tolerance: Array
) -> Array:
    close = tolerance + 2 * bracket.blur
    marginal = full_rank & (bracket.lower >= -close) & (bracket.lower + bracket.gap <= close)
    return first_of(
        [
            (~valid, Status.INVALID),
            (primal.resistant, Status.RESISTANT),
            (dual.deficient | dual.escapes, Status.NOT_RESISTANT),
            (marginal, Status.MARGINAL),
        ],
        Status.UNDECIDED,
    )
