"""``A = L Q`` with orthonormal rows of Q, by modified Gram-Schmidt with reorthogonalisation, lanes on the last axis.

Source: Bjoerck 1967 (modified Gram-Schmidt); Parlett, The Symmetric Eigenvalue Problem, 1980, section 6.9 (Kahan and
Parlett: twice is enough).
"""

from __future__ import annotations

import jax.numpy as jnp

from ..backend import stage
from ..core import Array
from .cholesky import Cholesky
from .cone import Cone, cone_sum
from .products import Vector, matvec

__all__ = ["orthonormal_rows"]


def _inner_product(x: Cone, y: Cone) -> Array:
    """``x.y``; the arrays may be of different heights."""
    return cone_sum(jnp.concatenate([a * b for a, b in zip(x, y, strict=True)]))


@stage
def _row_norm(row: Cone, floor: Array) -> tuple[Array, Array]:
    square = _inner_product(row, row)
    norm = jnp.sqrt(square)
    independent = norm > floor
    zero, one = jnp.zeros_like(norm), jnp.ones_like(norm)
    reciprocal = 1 / jnp.where(independent, norm, one)
    return jnp.where(independent, norm, zero), jnp.where(independent, reciprocal, zero)


@stage
def _row_scaled(row: Cone, factor: Array) -> Cone:
    return tuple(x * factor for x in row)


_products_below = stage(matvec)


@stage
def _inner_products(rows: list[Cone], head: Cone) -> Vector:
    return tuple(_inner_product(row, head) for row in rows)


@stage
def _reorthogonalized(rows: list[Cone], head: Cone, products: Vector) -> Cone:
    """``head - sum_q <q, head> q`` over the rows q found so far."""
    for row, product in zip(rows, products, strict=True):
        head = tuple(x - product * q for x, q in zip(head, row, strict=True))
    return head


@stage
def _projected_out(row: Cone, below: Cone, products: Array) -> Cone:
    """The rows below without their component along ``row``."""
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
            head = _reorthogonalized(rows, head, _inner_products(rows, head))
        norm, reciprocal = _row_norm(head, floors[i])
        row = _row_scaled(head, reciprocal)
        below = tuple(c[1:] for c in rest)
        if i < m - 1:
            products = _products_below(below, row)
            rest = _projected_out(row, below, products)
            lower.append(jnp.concatenate([norm[None], products]))
        else:
            lower.append(norm[None])
        rows.append(row)
        inverse.append(reciprocal)
    return _stacked(rows), Cholesky(tuple(lower), tuple(inverse))


@stage
def _stacked(rows: list[Cone]) -> Cone:
    return tuple(jnp.stack(parts) for parts in zip(*rows, strict=True))
