"""Products of many small matrices, given by their columns, lanes on the last axis.

A vector is one array (m, L): an array an entry would cost the compiler a loop an entry. A matrix B of m rows is d
arrays (m, k, L), one for each component of the cones its columns belong to.
"""

from __future__ import annotations

import jax.numpy as jnp

from ..backend import stage
from ..core import Array
from .cone import Cone

__all__ = ["gram", "matvec", "rmatvec", "vector_inner", "vector_norm"]


def vector_norm(v: Array) -> Array:
    """``|v|`` (L,)."""
    return jnp.sqrt(vector_inner(v, v))


def vector_inner(v: Array, w: Array) -> Array:
    """``<v, w>`` (L,)."""
    total = v[0] * w[0]
    for i in range(1, v.shape[0]):
        total = total + v[i] * w[i]
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


def rmatvec(columns: Cone, y: Array) -> Cone:
    """``B^T y``, d arrays (k, L)."""
    parts = []
    for c in columns:
        total = c[0] * y[0]
        for i in range(1, y.shape[0]):
            total = total + c[i] * y[i]
        parts.append(total)
    return tuple(parts)


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
