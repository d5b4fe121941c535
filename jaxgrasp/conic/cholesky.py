"""Cholesky for many small symmetric positive semidefinite systems, lanes on the last axis.

The m x m structure (m = 3 or 6) is unrolled; each line below is vector code over lanes.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from ..backend import stage
from ..core import Array
from .cone import entries

__all__ = [
    "Cholesky",
    "cholesky",
    "cholesky_solve",
    "inverse_frobenius",
    "null_combination",
    "residual_lower",
    "solve_lower",
    "solve_transposed",
]


class Cholesky(NamedTuple):
    """``M = L L^T``: ``columns[j]`` holds L[j:, j], ``inverse[j]`` is 1 / L[j, j], or 0 where that was rounding."""

    columns: tuple[Array, ...]
    inverse: tuple[Array, ...]


@stage
def _schur_column(column: Array, before: list[Array]) -> Array:
    """``M[j:, j] - sum_q L[j:, q] L[j, q]`` of the columns ``before`` it."""
    j = len(before)
    for q, previous in enumerate(before):
        column = column - previous[j - q :] * previous[j - q : j - q + 1]
    return column


@stage
def _inverse_pivot(column: Array, lower: Array, tolerance: Array, floor: Array) -> Array:
    # A dependent row gets a zero, which solves consistent singular systems and touches nothing else.
    pivot = column[0]
    positive = pivot > jnp.maximum(lower[0] * tolerance, floor)
    return jnp.where(
        positive, lax.rsqrt(jnp.where(positive, pivot, jnp.ones_like(pivot))), jnp.zeros_like(pivot)
    )


@stage
def _floor(M: tuple[Array, ...], factor: Array) -> Array:
    return factor * reduce(jnp.maximum, [column[0] for column in M])


@stage
def _scaled(column: Array, factor: Array) -> Array:
    return column * factor


def cholesky(M: tuple[Array, ...], tolerance: float) -> Cholesky:
    """Factor M, positive semidefinite, given by its lower columns ``M[j]`` of shape (m - j, L).

    A pivot counts as zero at or below ``tolerance`` times its own diagonal entry (cancellation), or at or below
    ``(2 tolerance)^2`` times the largest one (a row of B that is rounding as a whole).
    """
    dtype = M[0].dtype
    share = jnp.asarray(tolerance, dtype)
    floor = _floor(M, jnp.asarray(4 * tolerance * tolerance, dtype))
    columns: list[Array] = []
    inverse: list[Array] = []
    for lower in M:
        column = _schur_column(lower, columns) if columns else lower
        inverse.append(_inverse_pivot(column, lower, share, floor))
        columns.append(_scaled(column, inverse[-1]))
    return Cholesky(tuple(columns), tuple(inverse))


def _back_substituted(factor: Cholesky, x: list[Array]) -> Array:
    columns, inverse = factor
    for i in reversed(range(len(x))):
        for q in range(i + 1, len(x)):
            x[i] = x[i] - columns[i][q - i : q - i + 1] * x[q]
        x[i] = x[i] * inverse[i]
    return jnp.concatenate(x)


@stage
def cholesky_solve(factor: Cholesky, rhs: Array) -> Array:
    """``M^-1 rhs`` (m, L) by forward and back substitution."""
    x, _ = _forward_substituted(factor, rhs)
    return _back_substituted(factor, x)


@stage
def solve_transposed(factor: Cholesky, rhs: Array) -> Array:
    """``L^-T rhs`` (m, L); zero where the pivot was rounding."""
    return _back_substituted(factor, entries(rhs))


def _forward_substituted(factor: Cholesky, rhs: Array) -> tuple[list[Array], list[Array]]:
    """x with ``L x = rhs``, and what each row has to give before it is divided by its pivot."""
    columns, inverse = factor
    x, left = entries(rhs), []
    for i in range(len(x)):
        for q in range(i):
            x[i] = x[i] - columns[q][i - q : i - q + 1] * x[q]
        left.append(x[i])
        x[i] = x[i] * inverse[i]
    return x, left


@stage
def solve_lower(factor: Cholesky, rhs: Array) -> Array:
    """x with ``L x = rhs`` (m, .., L); 0 in the rows whose pivot was rounding."""
    return jnp.concatenate(_forward_substituted(factor, rhs)[0])


@stage
def residual_lower(factor: Cholesky, rhs: Array) -> Array:
    """``rhs - L x`` of ``solve_lower``: what the rows whose pivot was rounding leave."""
    _, left = _forward_substituted(factor, rhs)
    return jnp.concatenate(
        [jnp.where(p > 0, jnp.zeros_like(r), r) for p, r in zip(factor.inverse, left, strict=True)]
    )


@stage
def null_combination(factor: Cholesky, dependent: Array) -> Array:
    """v with ``v^T A = 0`` for A = L Q and ``v_i = dependent_i`` in the rows that depend on those above them."""
    columns, inverse = factor
    v = entries(dependent)
    for i in reversed(range(len(v))):
        total = jnp.zeros_like(v[i])
        for q in range(i + 1, len(v)):
            total = total - columns[i][q - i : q - i + 1] * v[q]
        v[i] = jnp.where(inverse[i] > 0, total * inverse[i], v[i])
    return jnp.concatenate(v)


@stage
def inverse_frobenius(factor: Cholesky) -> Array:
    """``|L^-1|_F^2 = trace(M^-1)``, an upper bound of 1 / lambda_min(M); infinite where a pivot was dropped."""
    columns, inverse = factor
    m = len(inverse)
    total = jnp.zeros_like(inverse[0])[None]
    full = inverse[0] > 0
    for j in range(m):
        x: dict[int, Array] = {}
        for i in range(j, m):
            if i == j:
                x[i] = inverse[i][None]
            else:
                entry = -columns[j][i - j : i - j + 1] * x[j]
                for q in range(j + 1, i):
                    entry = entry - columns[q][i - q : i - q + 1] * x[q]
                x[i] = entry * inverse[i]
            total = total + x[i] * x[i]
        full = full & (inverse[j] > 0)
    return jnp.where(full, total[0], jnp.full_like(total[0], jnp.inf))
