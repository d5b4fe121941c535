"""The friction LMI of a grasp, its reduction to Null(G), and the margin by this road (11.9)-(11.17).

The second road to every answer of section 11.2: small and general, for teaching and for checking the
structured solver. The methods that solve LMIs are in primal_dual.py and feasibility.py.
"""

from __future__ import annotations

from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp

from ..contacts import Grasp, cleared, is_grasp, null_space
from ..core import Array, Bool, Float, nan_where, rank_tolerance
from .primal_dual import lmi_minimize
from .problem import LMIProblem, expect_shape

__all__ = ["FrictionLMI", "friction_lmi", "is_grasp", "lmi_margin", "margin_lmi"]


class FrictionLMI(eqx.Module):
    """``P(f) = S_0 + sum_l f_l S_l = Blockdiag(P(f_1), .., P(f_k)) >= 0`` iff f is feasible (11.13)-(11.14).

    S         (*batch, k n, Q, Q)  block-diagonal S_l, l = i n + j; Q = k q with q x q blocks (11.4), (11.35)
    constant  (*batch, Q, Q)       S_0: zero but for an identity in the blocks of inactive contacts

    An inactive contact has S_l = 0 and the constant block I, so it never constrains and the shape stays.
    Forces in N, torques in N m. Unpacks as ``P, S = friction_lmi(grasp)``.
    """

    S: Float[Array, "*batch kn Q Q"]
    constant: Float[Array, "*batch Q Q"]

    def P(self, force: Float[Array, "*batch kn"]) -> Float[Array, "*batch Q Q"]:
        """``P(f)`` of (11.14). A component with coefficient 0 does not exist: S_l = 0, and P ignores it."""
        expect_shape(force.shape[-1:] == self.S.shape[-3:-2], "force", f"(*batch, {self.S.shape[-3]})", force)
        return self.constant + jnp.einsum("...l,...lab->...ab", force, self.S)

    def reduced(self, V: Float[Array, "*batch kn j"]) -> Float[Array, "*batch j Q Q"]:
        """``S~_j = sum_l V_lj S_l`` (11.16), so that ``P~(z) = S_0 + sum_j z_j S~_j = P(V z)`` (11.15).

        V is a basis of the internal forces such as ``null_space(grasp)``, whose columns carry no force along
        components that do not exist (mu = 0, gamma = 0). A basis of the raw Null(G) would, and nothing would
        hold it back: S_l is 0 there.
        """
        expect_shape(
            V.ndim >= 2 and V.shape[-2] == self.S.shape[-3], "V", f"(*batch, {self.S.shape[-3]}, j)", V
        )
        return jnp.einsum("...lj,...lab->...jab", V, self.S)

    def __iter__(self) -> Iterator:
        return iter((self.P, self.S))


@eqx.filter_jit
def friction_lmi(grasp: Grasp) -> FrictionLMI:
    """``P(f) = Blockdiag(P(f_1), .., P(f_k)) = sum_l f_l S_l >= 0`` iff f is feasible (11.13)-(11.14).

    Returns a ``FrictionLMI`` with S of shape (*batch, k n, k q, k q). The blocks are those of the chapter:
    lambda_min is ``mu (f_n - psi)`` for hard fingers (11.4), ``f_n - psi`` for soft ones (11.35), and ``f_n``
    for frictionless contacts and wherever mu = 0.
    """
    return _block_diagonal(grasp, cleared(grasp).model.lmi_matrices(grasp.dimension))


def _normalised_friction_lmi(grasp: Grasp) -> FrictionLMI:
    """The friction LMI with ``lambda_min = f_n - psi`` in every block: hard blocks divided by mu."""
    blocks = cleared(grasp).model.lmi_matrices(grasp.dimension)
    diagonal = blocks[
        ..., grasp.model.normal_index(grasp.dimension), 0, 0
    ]  # S_n = diagonal * I in every model
    return _block_diagonal(grasp, blocks / diagonal[..., None, None, None])


def _block_diagonal(grasp: Grasp, blocks: Float[Array, "*batch k n q q"]) -> FrictionLMI:
    k, n, q = blocks.shape[-4], blocks.shape[-3], blocks.shape[-1]
    place = jnp.eye(k, dtype=blocks.dtype)
    blocks = jnp.where(grasp.active[..., None, None, None], blocks, 0.0)
    S = jnp.einsum("...ijpr,ia,ib->...ijapbr", blocks, place, place)
    padding = jnp.repeat(jnp.where(grasp.active, 0.0, jnp.ones((), blocks.dtype)), q, axis=-1)
    return FrictionLMI(
        S.reshape(*S.shape[:-6], k * n, k * q, k * q), padding[..., None] * jnp.eye(k * q, dtype=blocks.dtype)
    )


@eqx.filter_jit
def margin_lmi(grasp: Grasp) -> LMIProblem:
    """``max t  subject to  P(f) >= t I,  f = f_0 + V y in Null(G),  sum_i f_n,i = k`` as an ``LMIProblem``.

    Variables (y, t), cost -t; P has ``lambda_min = f_n - psi`` in every block (hard blocks divided by mu),
    and inactive contacts do not count. Where no internal force has ``sum f_n != 0`` the matrices of y and the
    constant vanish, and only ``-t I >= 0`` is left.
    """
    return _margin_problem(grasp)[0]


def _margin_problem(grasp: Grasp) -> tuple[LMIProblem, Bool[Array, "*batch"]]:
    V = null_space(grasp)
    n, dtype = grasp.model.force_size(grasp.dimension), V.dtype
    is_normal = jnp.arange(V.shape[-1]) % n == grasp.model.normal_index(grasp.dimension)
    total = jnp.einsum("l,...lj->...j", is_normal.astype(dtype), V)  # sum of f_n of each basis vector
    size = jnp.linalg.norm(total, axis=-1)
    squeezes = size > rank_tolerance(dtype)

    # Householder: rotate the basis so that its first vector alone changes the sum of normal forces.
    sign = jnp.where(total[..., 0] >= 0, jnp.ones((), dtype), -jnp.ones((), dtype))
    mirror = total.at[..., 0].add(sign * size)
    square = jnp.sum(mirror * mirror, axis=-1)
    weight = 2 / jnp.where(squeezes, square, 1.0)
    V = (
        V
        - weight[..., None, None]
        * jnp.einsum("...lj,...j->...l", V, mirror)[..., None]
        * mirror[..., None, :]
    )
    V = jnp.where(squeezes[..., None, None], V, 0.0)
    active = jnp.sum(grasp.active, axis=-1).astype(dtype)
    first = V[..., 0] * (-sign * active / jnp.where(squeezes, size, 1.0))[..., None]

    lmi = _normalised_friction_lmi(grasp)
    q = lmi.constant.shape[-1]
    counts = jnp.eye(q, dtype=dtype) - lmi.constant  # identity on the active blocks
    constant = lmi.P(first)
    matrices = jnp.concatenate([lmi.reduced(V[..., 1:]), -counts[..., None, :, :]], axis=-3)
    cost = jnp.zeros(matrices.shape[:-2], dtype).at[..., -1].set(-1.0)
    least = -jnp.max(jnp.sum(jnp.abs(constant), axis=-1), axis=-1)  # at most the smallest eigenvalue
    start = jnp.zeros_like(cost).at[..., -1].set(least - 1.0)
    return LMIProblem(cost, constant, matrices, start), squeezes


@eqx.filter_jit
def lmi_margin(grasp: Grasp, *, tolerance: float = 1e-8) -> Float[Array, "*batch"]:
    """``t* = max t  subject to  G f = 0,  f_n,i - psi_i(f_i) >= t,  sum_i f_n,i = k``: the margin,
    dimensionless.

    Theory section 2 by the road of Prop. 11.2.2, made strict and normalised (erratum 1). The grasp is wrench
    resistant iff the folded map has full rank and t* > 0. A lower bound within ``tolerance * max(1, |t*|)``
    of t*; -inf where no internal force has ``sum f_n != 0``; NaN where the numbers are not a grasp.
    """
    problem, squeezes = _margin_problem(grasp)
    margin = -lmi_minimize(problem, tolerance=tolerance).upper
    return nan_where(~is_grasp(grasp), jnp.where(squeezes, margin, -jnp.inf))
