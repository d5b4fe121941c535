"""Cholesky for many small symmetric positive semidefinite systems, lanes on the last axis.

The m x m structure (m = 3 or 6) is unrolled; each line below is vector code over lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from ..backend import stage
from ..core import Array
from .cone import Cone, cone_sum

__all__ = ["Cholesky", "cholesky", "gram", "inverse_frobenius", "matvec", "vector_norm", "rmatvec"]

Vector = tuple[Array, ...]  # m entries of shape (L,)


class Cholesky(NamedTuple):
    """``M = L L^T``: ``columns[j]`` holds L[j:, j], ``inverse[j]`` is 1 / L[j, j], or 0 where that was rounding."""

    columns: tuple[Array, ...]
    inverse: tuple[Array, ...]


@stage
def _schur_column(column: Array, previous: list[tuple[Array, Array]]) -> Array:
    for below, head in previous:
        column = column - below * head
    return column


@stage
def _inverse_pivot(pivot: Array, threshold: Array) -> Array:
    # A dependent row gets a zero, which solves consistent singular systems and touches nothing else.
    positive = pivot > threshold
    return jnp.where(
        positive, lax.rsqrt(jnp.where(positive, pivot, jnp.ones_like(pivot))), jnp.zeros_like(pivot)
    )


@stage
def _floor(diagonal: Vector, factor: Array) -> Array:
    largest = diagonal[0]
    for d in diagonal[1:]:
        largest = jnp.maximum(largest, d)
    return factor * largest


@stage
def _scaled(column: Array, factor: Array) -> Array:
    return column * factor


def cholesky(M: tuple[Array, ...], tolerance: float) -> Cholesky:
    """Factor M, positive semidefinite, given by its lower columns ``M[j]`` of shape (m - j, L).

    A pivot counts as zero at or below ``tolerance`` times its own diagonal entry (cancellation), or at or below
    ``(2 tolerance)^2`` times the largest one (a row of B that is rounding as a whole).
    """
    dtype = M[0].dtype
    floor = _floor(tuple(column[0] for column in M), jnp.asarray(4 * tolerance * tolerance, dtype))
    columns: list[Array] = []
    inverse: list[Array] = []
    for j, lower in enumerate(M):
        previous = [(columns[q][j - q :], columns[q][j - q]) for q in range(j)]
        column = _schur_column(lower, previous) if previous else lower
        inverse.append(
            _inverse_pivot(column[0], jnp.maximum(lower[0] * jnp.asarray(tolerance, dtype), floor))
        )
        columns.append(_scaled(column, inverse[-1]))
    return Cholesky(tuple(columns), tuple(inverse))


def _back_substituted(factor: Cholesky, rhs: Vector) -> Vector:
    columns, inverse = factor
    x = list(rhs)
    for i in reversed(range(len(x))):
        for q in range(i + 1, len(x)):
            x[i] = x[i] - columns[i][q - i] * x[q]
        x[i] = x[i] * inverse[i]
    return tuple(x)


@stage
def cholesky_solve(factor: Cholesky, rhs: Vector) -> Vector:
    """``M^-1 rhs`` by forward and back substitution."""
    columns, inverse = factor
    x = list(rhs)
    for i in range(len(x)):
        for q in range(i):
            x[i] = x[i] - columns[q][i - q] * x[q]
        x[i] = x[i] * inverse[i]
    return _back_substituted(factor, tuple(x))


@stage
def solve_transposed(factor: Cholesky, rhs: Vector) -> Vector:
    """``L^-T rhs``; zero where the pivot was rounding."""
    return _back_substituted(factor, rhs)


@stage
def solve_lower(factor: Cholesky, rhs: Vector) -> tuple[Vector, Vector]:
    """x with ``L x = rhs`` as far as L goes, and what is left over where the pivot was rounding."""
    columns, inverse = factor
    x, left = list(rhs), []
    for i in range(len(x)):
        for q in range(i):
            x[i] = x[i] - columns[q][i - q] * x[q]
        left.append(jnp.where(inverse[i] > 0, jnp.zeros_like(x[i]), x[i]))
        x[i] = x[i] * inverse[i]
    return tuple(x), tuple(left)


@stage
def null_combination(factor: Cholesky, left: Vector) -> Vector:
    """v with ``v^T A = 0`` for A = L Q and ``v_i = left_i`` in the rows that depend on those above them."""
    columns, inverse = factor
    v = list(left)
    for i in reversed(range(len(v))):
        total = jnp.zeros_like(v[i])
        for q in range(i + 1, len(v)):
            total = total - columns[i][q - i] * v[q]
        v[i] = jnp.where(inverse[i] > 0, total * inverse[i], v[i])
    return tuple(v)


@stage
def inverse_frobenius(factor: Cholesky) -> Array:
    """``|L^-1|_F^2 = trace(M^-1)``, an upper bound of 1 / lambda_min(M); infinite where a pivot was dropped."""
    columns, inverse = factor
    m = len(inverse)
    total = jnp.zeros_like(inverse[0])
    full = inverse[0] > 0
    for j in range(m):
        x: dict[int, Array] = {}
        for i in range(j, m):
            if i == j:
                x[i] = inverse[i]
            else:
                entry = -columns[j][i - j] * x[j]
                for q in range(j + 1, i):
                    entry = entry - columns[q][i - q] * x[q]
                x[i] = entry * inverse[i]
            total = total + x[i] * x[i]
        full = full & (inverse[j] > 0)
    return jnp.where(full, total, jnp.full_like(total, jnp.inf))


def gram(columns: Cone) -> tuple[Array, ...]:
    """Lower columns (m - j, L) of ``B B^T`` for B given as d arrays (m, k, L)."""
    # One stage a column: the CPU backend would split a larger one over threads, which a kernel may not.
    return tuple(_gram_column(columns, j) for j in range(columns[0].shape[0]))


def _gram_column(columns: Cone, j: int) -> Array:
    @stage
    def products(columns: Cone) -> Array:
        total = None
        for c in columns:
            for i in range(c.shape[1]):
                term = c[j:, i] * c[j, i]
                total = term if total is None else total + term
        assert total is not None
        return total

    return products(columns)


def _overlap(x: Cone, y: Cone) -> Array:
    """``x.y``; the arrays may be of different heights."""
    return cone_sum(jnp.concatenate([a * b for a, b in zip(x, y, strict=True)]))


@stage
def _row_norm(row: Cone, floor: Array) -> tuple[Array, Array]:
    square = _overlap(row, row)
    norm = jnp.sqrt(square)
    kept = norm > floor
    zero, one = jnp.zeros_like(norm), jnp.ones_like(norm)
    return jnp.where(kept, norm, zero), jnp.where(kept, 1 / jnp.where(kept, norm, one), zero)


@stage
def _row_scaled(row: Cone, factor: Array) -> Cone:
    return tuple(x * factor for x in row)


@stage
def _row_products(row: Cone, below: Cone) -> Array:
    total = None
    for x, rest in zip(row, below, strict=True):
        for i in range(x.shape[0]):
            term = rest[:, i] * x[i]
            total = term if total is None else total + term
    assert total is not None
    return total


@stage
def _overlaps(rows: list[Cone], head: Cone) -> Vector:
    return tuple(_overlap(row, head) for row in rows)


@stage
def _without(rows: list[Cone], head: Cone, overlaps: Vector) -> Cone:
    for row, overlap in zip(rows, overlaps, strict=True):
        head = tuple(x - overlap * q for x, q in zip(head, row, strict=True))
    return head


@stage
def _row_removed(row: Cone, below: Cone, products: Array) -> Cone:
    return tuple(rest - products[:, None] * x[None] for x, rest in zip(row, below, strict=True))


def orthonormal_rows(columns: Cone, floor: Array | Vector) -> tuple[Cone, Cholesky]:
    """``A = L Q`` with orthonormal rows of Q, by modified Gram-Schmidt, for A given as d arrays (m, k, L).

    A row whose remainder is not longer than ``floor`` (one for all, or one a row) depends on those above it and becomes
    zero. Each remainder is cleared of the rows above once more: twice is enough (Kahan, Parlett) for orthogonality to
    rounding.
    """
    m = columns[0].shape[0]
    floors = floor if isinstance(floor, tuple) else (floor,) * m
    rest: Cone = columns
    rows: list[Cone] = []
    lower: list[Array] = []
    inverse: list[Array] = []
    for i in range(m):
        head: Cone = tuple(c[0] for c in rest)
        if rows:
            head = _without(rows, head, _overlaps(rows, head))
        norm, reciprocal = _row_norm(head, floors[i])
        row = _row_scaled(head, reciprocal)
        below = tuple(c[1:] for c in rest)
        if i < m - 1:
            products = _row_products(row, below)
            rest = _row_removed(row, below, products)
            lower.append(jnp.concatenate([norm[None], products]))
        else:
            lower.append(norm[None])
        rows.append(row)
        inverse.append(reciprocal)
    return _stacked(rows), Cholesky(tuple(lower), tuple(inverse))


@stage
def _stacked(rows: list[Cone]) -> Cone:
    return tuple(jnp.stack(parts) for parts in zip(*rows, strict=True))


def vector_norm(v: Vector) -> Array:
    """``|v|`` (L,)."""
    total = v[0] * v[0]
    for x in v[1:]:
        total = total + x * x
    return jnp.sqrt(total)


def matvec(columns: Cone, x: Cone) -> Array:
    """``B x`` (m, L)."""
    total = None
    for c, part in zip(columns, x, strict=True):
        for i in range(part.shape[0]):
            term = c[:, i] * part[i]
            total = term if total is None else total + term
    assert total is not None
    return total


def rmatvec(columns: Cone, y: Vector) -> Cone:
    """``B^T y``, d arrays (k, L)."""
    parts = []
    for c in columns:
        total = c[0] * y[0]
        for i in range(1, len(y)):
            total = total + c[i] * y[i]
        parts.append(total)
    return tuple(parts)
