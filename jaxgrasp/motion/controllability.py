"""11.4, (11.30)-(11.33): can small changes of the contact forces steer the object back to its equilibrium?

    controllable to first order   iff   rank [B A B .. A^(2m-1) B] = 2 m   iff   rank [B_c A_c B_c] = m

where gravity, through A_c, acts as one more finger. Decided by rank in units of the body, never by a list of
exceptions (erratum 10).

What the rank test proves when forces are confined to their cones: at a non-marginal equilibrium a neighbourhood of the
equilibrating forces is admissible, so full rank makes the grasp small-time locally controllable, resistant or not. At a
marginal one some force may change one way only, and full rank alone proves nothing. Too low a rank says that the
linearised motion leaves a direction alone; gyroscopic or other second-order effects may still reach it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from ..conic import left_svd, singular_values
from ..contacts import Grasp
from ..core import (
    Answer,
    Array,
    Float,
    Int,
    Status,
    first_of,
    nan_where,
    rank_tolerance,
    real_array,
    wrench_dimension,
)
from ..resistance import wrench_resistance
from .linearization import Linearization, Scaled, first_order, is_equilibrium, linearize, scaled_system
from .rigid_body import RigidBody

__all__ = [
    "Controllability",
    "controllability",
    "controllability_matrix",
    "gramian",
]

HORIZON = 1.0  # of the Gramian, in units of sqrt(l / g)


class Controllability(Answer):
    """Verdicts with their reasons, the batch axes in front. Scaled: lengths in l, times in sqrt(l / g), forces in m g.

    status           int32, a ``Status``: RESISTANT, CONTROLLABLE, MARGINAL, NOT_CONTROLLABLE, NO_EQUILIBRIUM, UNDECIDED
                     or INVALID
    rank             int32, of the controllability matrix (11.30): 2 m where controllable; -1 where INVALID
    reduced_rank     int32, of [B_c A_c B_c] (11.32): m where controllable; -1 where INVALID
    grasp_rank       int32, of B_c alone: what the fingers do without gravity; -1 where INVALID
    singular_values  (*batch, m) of [B_c A_c B_c], scaled and folded, largest first
    uncontrollable   (*batch, m) (velocity; angular velocity), unit norm with lengths in l: where the rank is too low,
                     a motion on which neither the contact forces nor their turning with the body do work; where it is
                     full, the motion on which they do least
    weakest          (*batch, 2 m) the state (translation, rotation; their rates; m, rad, s), unit norm when scaled,
                     that takes most effort to reach
    effort           (*batch) that effort: the least root mean square of all scaled contact forces, in weights, that
                     moves the object there in the time sqrt(l / g); infinite where not controllable
    equilibrium      int32, a ``Status``: the equilibrium, as ``linearize`` says it
    resistance       int32, a ``Status``: wrench resistance
    force            (*batch, k n) N: the equilibrating forces, zero where there are none
    """

    status: Int[Array, "*batch"]
    rank: Int[Array, "*batch"]
    reduced_rank: Int[Array, "*batch"]
    grasp_rank: Int[Array, "*batch"]
    singular_values: Float[Array, "*batch m"]
    uncontrollable: Float[Array, "*batch m"]
    weakest: Float[Array, "*batch s"]
    effort: Float[Array, "*batch"]
    equilibrium: Int[Array, "*batch"]
    resistance: Int[Array, "*batch"]
    force: Float[Array, "*batch kn"]

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.RESISTANT: "Controllable, because the grasp is wrench resistant: the fingers alone produce every "
        "wrench.",
        Status.MARGINAL: "Open: the linearisation has full rank, but the only forces that carry the weight are at the "
        "edge of their cones, so they may change one way only and the rank proves nothing.",
        Status.NO_EQUILIBRIUM: "No equilibrium: no admissible contact forces carry the weight, or the given ones do "
        "not.",
        Status.UNDECIDED: "Undecided: a solver stopped before it had a proof either way.",
        Status.INVALID: "Invalid: the numbers are not a grasp, a body and a gravity.",
    }

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """Rank and effort of one lane in words."""
        rank, effort = (np.asarray(x)[index] for x in (self.rank, self.effort))
        return "" if rank < 0 else f"Rank {rank}, effort {effort:.4g} weights."


@jax.jit
def controllability_matrix(
    A: Float[Array, "*batch s s"], B: Float[Array, "*batch s n"]
) -> Float[Array, "*batch s sn"]:
    """``[B AB .. A^(s-1) B]`` (11.30) of any linear system."""
    columns = [B]
    for _ in range(A.shape[-1] - 1):
        columns.append(A @ columns[-1])
    return jnp.concatenate(columns, axis=-1)


def gramian(
    A: Float[Array, "*batch s s"],
    B: Float[Array, "*batch s n"],
    *,
    horizon: Float[ArrayLike, "*batch"] = HORIZON,
) -> Float[Array, "*batch s s"]:
    """``W = int_0^T e^(A t) B B^T e^(A^T t) dt`` of a grasp's linearisation: exact, because A^4 = 0.

    Reaching the state x at time T from rest takes controls of energy ``int |f|^2 dt`` of at least ``x^T W^-1 x``.
    """
    powers = [B]
    for _ in range(3):
        powers.append(A @ powers[-1])
    horizon = real_array(horizon, "horizon").astype(B.dtype)[..., None, None]
    total = jnp.zeros_like(A)
    for i, left in enumerate(powers):
        for j, right in enumerate(powers):
            weight = horizon ** (i + j + 1) / (math.factorial(i) * math.factorial(j) * (i + j + 1))
            total = total + weight * (left @ jnp.swapaxes(right, -1, -2))
    return (total + jnp.swapaxes(total, -1, -2)) / 2


def _rank(values: Array) -> Array:
    return jnp.sum(values > rank_tolerance(values.dtype) * values[..., :1], axis=-1).astype(jnp.int32)


def controllability(
    grasp: Grasp,
    body: RigidBody,
    *,
    gravity: Float[ArrayLike, "*batch d"] | None = None,
    force: Float[ArrayLike, "*batch kn"] | None = None,
    tolerance: float = 1e-8,
) -> Controllability:
    """``rank [B_c A_c B_c] = m`` (11.32), the equilibrium it is about, and what both together prove.

    grasp      any batch axes; body: a ``RigidBody`` whose batch axes broadcast with the grasp's
    gravity    m/s^2 in the grasp's axes, one vector or one a lane; None: (0, 0, -9.81), in the plane (0, -9.81)
    force      (*batch, k n) the equilibrating forces; None: looked for, strictly inside the cones if there are any
    tolerance  of the solvers behind the equilibrium and the wrench resistance

    Rank counts singular values above 64 eps times the largest one. Nothing raises inside; wrong
    shapes raise ValueError. Sources: (11.29)-(11.33) with errata 9 and 10; Kalman 1963.
    """
    linear = linearize(grasp, body, force=force, gravity=gravity, tolerance=tolerance)
    resistance = wrench_resistance(grasp, tolerance=tolerance, verdict_only=True)
    return _proved(linear, resistance.status, body, scaled_system(grasp, body, gravity))


@eqx.filter_jit
def _proved(linear: Linearization, resistance: Array, body: RigidBody, system: Scaled) -> Controllability:
    """Ranks, the motions behind them, and what they prove about the equilibrium."""
    status = jnp.broadcast_to(resistance, linear.status.shape)
    broken = (linear.status == Status.INVALID.value)[..., None, None]
    system = system._replace(B_c=jnp.where(broken, 0.0, system.B_c), A_c=jnp.where(broken, 0.0, system.A_c))
    m = system.A_c.shape[-1]

    values, left = left_svd(jnp.concatenate([system.B_c, system.A_c @ system.B_c], axis=-1))
    reduced_rank, alone = _rank(values), _rank(singular_values(system.B_c))
    # [B A B A^2 B A^3 B] has [B_c A_c B_c] in its upper and in its lower rows and nothing else; A^4 = 0.
    rank = 2 * reduced_rank
    A, B = first_order(system.A_c, system.B_c)

    full = reduced_rank == m
    verdict = _verdict(linear.status, status, full)
    unknown = verdict == Status.INVALID.value
    motion = _least_worked(left[..., -1], body, system)
    weakest, effort = _weakest(A, B, system)
    none = unknown[..., None]
    return Controllability(
        verdict,
        jnp.where(unknown, -1, rank),
        jnp.where(unknown, -1, reduced_rank),
        jnp.where(unknown, -1, alone),
        nan_where(none, values),
        jnp.where(none, 0.0, motion),
        jnp.where(none, 0.0, weakest),
        jnp.where(full & ~unknown, effort, jnp.inf),
        linear.status,
        status,
        linear.force,
    )


def _verdict(point: Array, resistance: Array, full: Array) -> Array:
    """What equilibrium, wrench resistance and full rank prove together."""
    known = is_equilibrium(point)
    absent = (point == Status.NO_EQUILIBRIUM.value) | (point == Status.NOT_BALANCED.value)
    invalid = (point == Status.INVALID.value) | (resistance == Status.INVALID.value)
    return first_of(
        [
            (invalid, Status.INVALID),
            (absent, Status.NO_EQUILIBRIUM),
            # an internal force moves any equilibrium of a resistant grasp inside the cones
            (known & full & (resistance == Status.RESISTANT.value), Status.RESISTANT),
            (known & ~full, Status.NOT_CONTROLLABLE),
            (full & (point == Status.NON_MARGINAL.value), Status.CONTROLLABLE),
            (full & (point == Status.MARGINAL.value), Status.MARGINAL),
        ],
        Status.UNDECIDED,
    )


def _units(system: Scaled, dimension: int) -> Array:
    """(m,) what a scaled motion (translation; rotation) is multiplied by to be in m and rad."""
    one = jnp.ones_like(system.length)
    turns = wrench_dimension(dimension) - dimension
    return jnp.stack([system.length] * dimension + [one] * turns, axis=-1)


def _least_worked(left: Array, body: RigidBody, system: Scaled) -> Array:
    """xi with ``xi . M [B_c A_c B_c]`` zero, or least: M^-1 times the wrench ``left``, its last left singular vector.

    Its part in M-orthogonal terms is the motion that no controllable one takes part in.
    """
    d = body.dimension
    size = (body.mass * system.length**2)[..., None, None]
    inverse = body.where(body.valid).inverse_inertia * size
    turning = jnp.sum(inverse * left[..., None, d:], axis=-1)
    xi = jnp.concatenate([left[..., :d], turning], axis=-1)
    xi = xi / jnp.sqrt(jnp.sum(xi * xi, axis=-1, keepdims=True))
    largest = jnp.take_along_axis(xi, jnp.argmax(jnp.abs(xi), axis=-1)[..., None], axis=-1)
    return jnp.where(largest < 0, -xi, xi) * _units(system, d)


def _weakest(A: Array, B: Array, system: Scaled) -> tuple[Array, Array]:
    values, vectors = left_svd(gramian(A, B))  # its eigenvalues: it is positive semidefinite
    least, state = values[..., -1], vectors[..., -1]
    resolved = least > 4 * A.shape[-1] * jnp.finfo(A.dtype).eps * values[..., 0]
    effort = jnp.where(resolved, 1 / jnp.sqrt(jnp.where(resolved, least, 1.0) * HORIZON), jnp.inf)
    units = _units(system, 3 if A.shape[-1] == 12 else 2)
    both = jnp.concatenate([units, units / system.time[..., None]], axis=-1)
    return state * both, effort
