"""An LMI problem with its log-det term as one matrix, in variables in which units and dependence do not matter."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from ..core import Array, rank_tolerance
from .problem import LMIProblem

__all__ = ["Combined", "Coordinates", "combine", "coordinates", "orthonormal_columns"]


class Combined(eqx.Module):
    """``min c.x + |F x|^2 / 2 - w log det B(x)  subject to  S(x) = Blockdiag(Q(x), B(x)) > 0``."""

    cost: Array
    constant: Array  # S_0
    matrices: Array  # S_1 .. S_N
    root: Array  # F, F^T F = H
    weight: Array  # w; at 0 B(x) is one more block of Q(x)
    order: int = eqx.field(static=True)  # of Q(x)

    def S(self, x: Array) -> Array:
        return self.constant + jnp.einsum("i,iab->ab", x, self.matrices)

    @property
    def term(self) -> slice:
        """Rows of B(x)."""
        return slice(self.order, len(self.constant))

    @property
    def columns(self) -> Array:
        """(S_i, F_i) as rows, (N, size^2 + rows of F)."""
        return jnp.concatenate([self.matrices.reshape(len(self.cost), -1), self.root.T], axis=1)


def combine(problem: LMIProblem) -> Combined:
    """Without curvature F has no row, without a log-det term B(x) is empty."""
    N, dtype, term = problem.cost.shape[-1], problem.cost.dtype, problem.log_det
    root = jnp.zeros((0, N), dtype) if problem.curvature is None else _square_root(problem.curvature)
    constant, matrices, weight = problem.constant, problem.matrices, jnp.zeros((), dtype)
    if term is not None:
        weight = term.weight
        constant = jax.scipy.linalg.block_diag(constant, term.constant)
        matrices = jax.vmap(jax.scipy.linalg.block_diag)(matrices, term.matrices)
    return Combined(problem.cost, constant, matrices, root, weight, problem.constant.shape[-1])


def _square_root(H: Array) -> Array:
    """F with ``F^T F = H``; NaN where H is not positive semidefinite by more than rounding."""
    values, vectors = jnp.linalg.eigh(H)
    rounding = len(H) * rank_tolerance(H.dtype) * jnp.max(jnp.abs(values))
    root = jnp.sqrt(jnp.maximum(values, 0.0))[:, None] * vectors.T
    return jnp.where(values[0] >= -rounding, root, jnp.nan)


class Coordinates(eqx.Module):
    """``x = T y + rest`` with ``sum_i x_i S_i = sum_j y_j S'_j``, the columns ``(S'_j, F'_j)`` orthonormal.

    So neither the scale of a variable nor dependent matrices matter. With fewer independent matrices than
    variables the last columns of T and the last S'_j are zero: those directions nothing holds, and x never moves along
    them.
    """

    T: Array
    matrices: Array
    root: Array  # F T
    idle: Array  # the part of the cost along directions that nothing holds
    held: Array  # whether that part is zero


def coordinates(problem: Combined) -> Coordinates:
    T, idle, held, _ = orthonormal_columns(problem.columns, problem.cost)
    return Coordinates(T, jnp.einsum("ij,iab->jab", T, problem.matrices), problem.root @ T, idle, held)


def orthonormal_columns(columns: Array, cost: Array) -> tuple[Array, Array, Array, Array]:
    """(T, idle, held, proved): ``T^T columns`` has orthonormal rows, zero where rows of ``columns`` are dependent.

    ``idle`` is the part of the cost that no combination of the rows makes, ``held`` whether that is none;
    ``proved``: rounding left the rows orthonormal to within 1/2.
    """
    dtype, N = cost.dtype, len(cost)
    length = jnp.linalg.norm(columns, axis=1)
    length = jnp.where(length > 0, length, 1.0)
    R = jnp.linalg.qr((columns / length[:, None]).T, mode="r")
    _, values, rows = jnp.linalg.svd(R, full_matrices=True)
    values = jnp.pad(values, (0, N - len(values)))
    found = values > rank_tolerance(dtype) * values[0]
    rows = jnp.where(found[:, None], rows, 0.0)
    T = (rows / jnp.where(found, values, 1.0)[:, None]).T / length[:, None]
    scaled = cost / length
    idle = scaled - rows.T @ (rows @ scaled)
    held = jnp.all(jnp.abs(idle) <= N * rank_tolerance(dtype) * jnp.max(jnp.abs(scaled)))
    unit = T.T @ columns
    proved = jnp.linalg.norm(unit @ unit.T - jnp.diag(found.astype(dtype))) < 0.5
    return T, idle / length, held, proved
