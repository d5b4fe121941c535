"""Cholesky for many small symmetric positive semidefinite systems, lanes on the last axis.

The m x m structure (m = 3 or 6) is unrolled; each line below is vector code over lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from .._types import Array
from ..cones import Cone
from .stages import stage

__all__ = ["Cholesky", "cholesky", "gram", "inverse_frobenius", "matvec", "rmatvec"]

Vector = tuple[Array, ...]  # m entries of shape (L,)


class Cholesky(NamedTuple):
    """``M = L L^T``: ``columns[j]`` holds L[j:, j], ``inverse[j]`` is 1 / L[j, j], or 0 where the pivot was rounding."""

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
    return jnp.where(positive, lax.rsqrt(jnp.where(positive, pivot, jnp.ones_like(pivot))), jnp.zeros_like(pivot))


@stage
def _scaled(column: Array, factor: Array) -> Array:
    return column * factor


def cholesky(M: Array, tolerance: float) -> Cholesky:
    """Factor ``M`` (m, m, L), positive semidefinite; pivots at or below ``tolerance * M[j, j]`` count as zero."""
    columns: list[Array] = []
    inverse: list[Array] = []
    for j in range(M.shape[0]):
        previous = [(columns[q][j - q :], columns[q][j - q]) for q in range(j)]
        column = _schur_column(M[j:, j], previous)
        inverse.append(_inverse_pivot(column[0], M[j, j] * jnp.asarray(tolerance, M.dtype)))
        columns.append(_scaled(column, inverse[-1]))
    return Cholesky(tuple(columns), tuple(inverse))


@stage
def solve(factor: Cholesky, rhs: Vector) -> Vector:
    """``M^-1 rhs`` by forward and back substitution."""
    columns, inverse = factor
    m = len(inverse)
    x = list(rhs)
    for i in range(m):
        for q in range(i):
            x[i] = x[i] - columns[q][i - q] * x[q]
        x[i] = x[i] * inverse[i]
    for i in reversed(range(m)):
        for q in range(i + 1, m):
            x[i] = x[i] - columns[i][q - i] * x[q]
        x[i] = x[i] * inverse[i]
    return tuple(x)


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


@stage
def gram(columns: Cone) -> Array:
    """``B B^T`` (m, m, L) for B given as d arrays (m, k, L)."""
    k = columns[0].shape[1]
    total = None
    for c in columns:
        for i in range(k):
            term = c[:, None, i] * c[None, :, i]
            total = term if total is None else total + term
    assert total is not None
    return total


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
