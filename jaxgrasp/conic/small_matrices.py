"""Factors of many small matrices without LAPACK, with any batch axes in front.

    A = U diag(sigma) W,   A^+ = W^T diag(1 / sigma) U^T,   M x = b

Two batched LAPACK calls that do not wait for each other, in one program or in two threads, can wait for each other's
workers for ever on a machine of few cores (XLA's CPU backend). These are plain loops over tiles of lanes instead:
Jacobi rotations (``singular_values``) and elimination with row exchanges. Derivatives are those of the results, exact
and finite wherever these are differentiable.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from ..backend import batched, map_tiles, tile_width, to_lanes, to_rows, varying_like
from ..core import Array, Bool, Float, unit_roundoff
from .singular_values import row_svd

__all__ = ["eigenvalues", "left_svd", "null_basis", "pseudo_inverse", "singular_values", "solve"]


def _in_tiles(function: Any, matrices: tuple[Array, ...], floats: int) -> Any:
    """``function`` of lanes, on matrices (*batch, a, b)."""
    width = tile_width(floats)

    def tile(rows: Any) -> Any:
        return jax.tree.map(to_rows, function(*map(to_lanes, rows)))

    def work(rows: Any, count: Array, _: Array) -> Any:
        if rows[0].shape[0] == width:
            return tile(rows)  # a loop of one turn would be taken apart again
        return map_tiles(tile, rows, count, width)

    run = batched(work, lambda rows: rows[0].shape[:-2], width)
    return run(matrices, jnp.zeros(()))


def _rotated(A: Array) -> tuple[Array, Array]:
    m, n, lanes = A.shape
    seats = max(m, 3)
    found = row_svd(jnp.concatenate([A, jnp.zeros((seats - m, n, lanes), A.dtype)]))
    return found.values[:m], found.vectors[:m, :m]


@jax.custom_jvp
def left_svd(A: Float[Array, "*batch m n"]) -> tuple[Float[Array, "*batch m"], Float[Array, "*batch m m"]]:
    """Singular values, largest first, and U (columns) of ``A = U diag(sigma) W``; zeros beyond n.

    Differentiable: sigma everywhere (at a multiple one, one finite choice), U held fixed.
    """
    m, n = A.shape[-2:]
    values, rows = _in_tiles(_rotated, (A,), m * (n + m))
    order = jnp.argsort(-values, axis=-1)
    values = jnp.take_along_axis(values, order, axis=-1)
    U = jnp.swapaxes(jnp.take_along_axis(rows, order[..., None], axis=-2), -1, -2)
    return jnp.where(jnp.arange(m) < n, values, 0.0), U


@left_svd.defjvp
def _left_svd_jvp(primals, tangents):
    (A,), (dA,) = primals, tangents
    values, U = left_svd(A)
    change, _ = _change(A, dA, values, U)
    return (values, U), (change, jnp.zeros_like(U))


def _change(A: Array, dA: Array, values: Array, U: Array) -> tuple[Array, Array]:
    """``d sigma_i = u_i^T dA v_i`` (.., m), and v (.., m, n)."""
    projected = jnp.einsum("...mi,...mn->...in", U, A)
    square = jnp.sum(projected * projected, axis=-1)
    size = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), jnp.inf)
    V = projected / size[..., None]
    return jnp.where(values > 0, jnp.einsum("...mi,...mn,...in->...i", U, dA, V), 0.0), V


@jax.custom_jvp
def _turning_svd(A: Array) -> tuple[Array, Array]:
    """``left_svd`` with a derivative of U, which second derivatives of singular values need."""
    return left_svd(A)


@_turning_svd.defjvp
def _turning_svd_jvp(primals, tangents):
    """``dU = U W``, W_ij = (s_j P_ij + s_i P_ji) / (s_j^2 - s_i^2), P = U^T dA V; equal ones do not turn."""
    (A,), (dA,) = primals, tangents
    values, U = _turning_svd(A)
    change, V = _change(A, dA, values, U)
    P = jnp.einsum("...mi,...mn,...jn->...ij", U, dA, V)
    square = values * values
    apart = square[..., None, :] - square[..., None]
    turns = jnp.abs(apart) > 64 * unit_roundoff(A.dtype) * jnp.max(square, axis=-1)[..., None, None]
    mixed = P * values[..., None, :]
    W = jnp.where(turns, (mixed + jnp.swapaxes(mixed, -1, -2)) / jnp.where(turns, apart, 1.0), 0.0)
    return (values, U), (change, U @ W)


def singular_values(A: Float[Array, "*batch m n"]) -> Float[Array, "*batch m"]:
    """All m of them, largest first; zeros beyond n. To eps times the largest. Derivatives of every order."""
    return _turning_svd(A)[0]


def eigenvalues(M: Float[Array, "*batch m m"]) -> Float[Array, "*batch m"]:
    """Those of a symmetric M, largest first: the singular values of ``M + c I``, less c, with c at least |M|."""
    c = jnp.max(jnp.sum(jnp.abs(lax.stop_gradient(M)), axis=-1), axis=-1)[..., None]
    return singular_values(M + c[..., None] * jnp.eye(M.shape[-1], dtype=M.dtype)) - c


@jax.custom_jvp
def pseudo_inverse(A: Float[Array, "*batch m n"], cut: float | Array) -> Float[Array, "*batch n m"]:
    """``A^+ = A^T U diag(1 / sigma^2) U^T`` over the singular values above ``cut`` times the largest."""
    values, U = left_svd(A)
    kept = values > cut * values[..., :1]
    inverse = jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)
    W = jnp.einsum("...mn,...mi,...i->...ni", A, U, inverse)
    P = jnp.einsum("...ni,...i,...mi->...nm", W, inverse, U)
    return P + P @ (
        jnp.eye(A.shape[-2], dtype=A.dtype) - A @ P
    )  # once more: A P b = b to eps cond, not eps cond^2


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(primals, tangents):
    """Golub, Pereyra 1973, at constant rank."""
    (A, cut), (dA, _) = primals, tangents
    P, transposed = pseudo_inverse(A, cut), jnp.swapaxes(dA, -1, -2)
    PT = jnp.swapaxes(P, -1, -2)
    left = transposed - (transposed @ A) @ P
    right = transposed - P @ (A @ transposed)
    return P, P @ (PT @ left) + (right @ PT) @ P - (P @ dA) @ P


@jax.custom_jvp
def null_basis(
    A: Float[Array, "*batch m n"], exists: Bool[Array, "*batch n"], cut: float
) -> Float[Array, "*batch n n"]:
    """Orthonormal V with ``A V = 0`` among the components that exist; zero columns beyond the last.

    A is zero where nothing exists. Its singular values above ``cut * max(1, largest)`` count; the basis are the left
    singular vectors of A^T that belong to the others.
    """
    n = A.shape[-1]
    values, U = left_svd(jnp.swapaxes(A, -1, -2))
    # No rotation touches a row of zeros: what does not exist has a unit vector of its own.
    absent = jnp.sum(jnp.where(exists[..., None], 0.0, jnp.abs(U)), axis=-2) > 0.5
    inside = (values <= cut * jnp.maximum(values[..., :1], 1.0)) & ~absent
    order = jnp.argsort(~inside, axis=-1, stable=True)
    V = jnp.take_along_axis(U, order[..., None, :], axis=-1)
    return jnp.where(jnp.arange(n) < jnp.sum(inside, axis=-1, keepdims=True)[..., None, :], V, 0.0)


@null_basis.defjvp
def _null_basis_jvp(primals, tangents):
    """The basis that turns least: ``dV = -A^+ dA V``, at constant rank. ``V V^T`` follows A exactly."""
    (A, exists, cut), dA = primals, tangents[0]
    V = null_basis(A, exists, cut)
    return V, -pseudo_inverse(A, cut) @ (dA @ V)


def _eliminated(M: Array, b: Array) -> Array:
    """(s, r, L) x of ``M x = b``: rows exchanged for the largest pivot, then substitution from below."""
    s = M.shape[0]
    rows = jnp.arange(s, dtype=jnp.int32)[:, None]

    def column(W: Array, j: Array) -> Array:
        return lax.dynamic_index_in_dim(W, j, 1, keepdims=False)  # (s, L)

    def row(W: Array, j: Array) -> Array:
        return lax.dynamic_index_in_dim(W, j, 0, keepdims=False)  # (s + r, L)

    def eliminate(j: Array, W: Array) -> Array:
        here, first = column(W, j), row(W, j)
        best = lax.argmax(jnp.where(rows >= j, jnp.abs(here), -1.0), 0, jnp.int32)
        chosen = rows == best
        pivot = jnp.sum(jnp.where(chosen[:, None], W, 0.0), axis=0)
        at = lax.dynamic_index_in_dim(pivot, j, 0)
        exchanged = jnp.where(chosen, lax.dynamic_index_in_dim(first, j, 0), here)
        factor = jnp.where(rows > j, exchanged / at, 0.0)
        W = jnp.where(chosen[:, None], first, W) - factor[:, None] * pivot
        return jnp.where(rows[:, :, None] == j, pivot, W)

    def substitute(i: Array, x: Array) -> Array:
        j = s - 1 - i
        found = lax.dynamic_index_in_dim(x, j, 0) / lax.dynamic_index_in_dim(row(W, j), j, 0)
        factor = jnp.where(rows < j, column(W, j), 0.0)
        return jnp.where(rows[:, :, None] == j, found, x - factor[:, None] * found)

    W = lax.fori_loop(jnp.int32(0), jnp.int32(s), eliminate, jnp.concatenate([M, b], axis=1))
    return lax.fori_loop(jnp.int32(0), jnp.int32(s), substitute, W[:, s:])


def solve(M: Float[Array, "*batch s s"], b: Float[Array, "*batch s r"]) -> Float[Array, "*batch s r"]:
    """x with ``M x = b``, by elimination with the largest pivot of each column; not finite where M is singular."""
    s, r = b.shape[-2:]

    def eliminated(M: Array, b: Array) -> Array:
        return _in_tiles(_eliminated, (M, b), s * (s + r))

    M, b = varying_like((M, b))((M, b))
    fixed = lax.stop_gradient(M)
    return lax.custom_linear_solve(
        lambda x: M @ x,
        b,
        lambda _, right: eliminated(fixed, right),
        lambda _, right: eliminated(jnp.swapaxes(fixed, -1, -2), right),
    )
