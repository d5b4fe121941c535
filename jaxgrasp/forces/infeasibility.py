"""Proofs that a load cannot be held: a twist along which it does more work than admissible forces can take up.

The sum over the contacts is the support function of the admissible wrenches, with forces up to a limit; a twist with a
positive difference separates the load from them (Farkas).
"""

from __future__ import annotations

import jax.numpy as jnp

from ..backend import stage
from ..conic import ConvexConeProgram, cone_sum, rmatvec, tail_norm, vector_inner, vector_norm
from ..contacts import Folded
from ..core import Array, rounding_constant, unit_roundoff
from .problem import Load

__all__ = ["proven_separation", "proves", "separation"]

FORCE_LIMIT = 1e9  # loads: forces up to this many must be ruled out before infeasible counts as proven
POWER = 5000  # units of rounding, of |twist| |load|: less power may be rounding of numbers, as far as a checker knows


@stage
def separation(program: ConvexConeProgram, rows: Array, limit: float) -> Array:
    """``y.w - sum_i min(cap_i, limit) (|x_t,i| - x_0,i)+ - |beta|.bound`` over ``y.w``, x = A^T y + E^T beta.

    Positive, with y.w > 0: the load does more work along the twist y (the joints moving at beta) than forces up to
    ``limit`` times the load and torques up to their bounds can take up. Without limits: ``A_i^T y`` is in every cone.
    """
    m = program.rhs.shape[0]
    x = rmatvec(program.columns, rows)
    violation = program.exists * jnp.maximum(tail_norm(x) - x[0], jnp.zeros_like(x[0]))
    most = jnp.full_like(violation, limit)
    if program.cap is not None:
        most = jnp.minimum(most, program.cap)
    taken = cone_sum(violation * most)
    if program.bound is not None:
        taken = taken + cone_sum(jnp.abs(rows[m:]) * program.bound)
    power = -vector_inner(program.rhs, rows[:m])
    worth = power > 0
    return jnp.where(worth, 1 - taken / jnp.where(worth, power, jnp.ones_like(power)), -jnp.ones_like(power))


def proves(program: ConvexConeProgram, rows: Array) -> Array:
    """Whether ``rows`` prove that no forces up to ``FORCE_LIMIT`` times the load balance it."""
    return separation(program, rows, FORCE_LIMIT) > 0.5


@stage
def proven_separation(
    folded: Folded, program: ConvexConeProgram, twist: Array, beta: Array | None, load: Load, limit: float
) -> Array:
    """Power of the load along ``twist`` less what forces up to ``limit`` loads and the torques can take up, on A.

    Positive: the twist proves INFEASIBLE. Allows twice for the rounding the checker allows for, in its float64; a power
    that is none but for rounding in the dtype at work proves nothing.
    """
    rounding = rounding_constant() * unit_roundoff("float64")
    noise = max(rounding, POWER * unit_roundoff(folded.norm.dtype))
    x, blur = rmatvec(folded.columns, twist), folded.norm * vector_norm(twist)
    if beta is not None:
        joints = tuple(c[program.rhs.shape[0] :] for c in program.columns)
        x = tuple(a + b for a, b in zip(x, rmatvec(joints, beta), strict=True))
        blur = blur + vector_norm(beta)
    violation = program.exists * jnp.maximum(tail_norm(x) - x[0] + rounding * blur, jnp.zeros_like(x[0]))
    outer = vector_norm(load.wrench)
    most = jnp.broadcast_to(limit * outer, violation.shape)
    if program.cap is not None:
        most = jnp.minimum(most, program.cap * load.size)
    taken = cone_sum(violation * most)
    if beta is not None:
        taken = taken + cone_sum(jnp.abs(beta) * program.bound) * load.size
    power = vector_inner(twist, load.wrench)
    return power - noise * vector_norm(twist) * outer - taken
