"""Both sides of the duality gap of force optimisation: a criterion at forces, its lower bound at multipliers.

The bound is the dual function in closed form for every criterion, so it holds whatever the solver did.
``certificates.forces`` evaluates the same formulas again from the answer alone.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from ..backend import stage
from ..conic import (
    Cone,
    ConvexConeProgram,
    Curvature,
    cone_max,
    cone_min,
    cone_sum,
    determinant,
    entries,
    inner,
    interior_distance,
    rmatvec,
    tail_norm,
    vector_inner,
)
from ..core import Array

__all__ = ["barrier_loss", "cost_sensitivity", "criterion_value", "dual_value"]


class Barrier(NamedTuple):
    """``weight * sum_i log det P_i``, with ``log det P = on_normal log f_n + on_cone log(f_n^2 - psi^2) + constant``.

    weight (L,); the others (k, L).
    """

    weight: Array
    on_normal: Array
    on_cone: Array
    constant: Array


def _top(exists: Array, u: Cone) -> Array:
    return cone_max(jnp.where(exists > 0, u[0], jnp.full_like(u[0], -jnp.inf)))


def _log_det(barrier: Barrier, exists: Array, u: Cone, size: Array) -> Array:
    """``weight * sum log det P`` of the forces ``size u``; -inf where one is not inside its cone."""
    weight, on_normal, on_cone, constant = barrier
    one = jnp.ones_like(u[0])
    det = jnp.where((exists > 0) & (on_cone > 0), size * size * determinant(u), one)
    head = jnp.where(exists > 0, size * u[0], one)
    inside = (det > 0) & (head > 0)
    logs = on_normal * jnp.log(jnp.where(inside, head, one)) + on_cone * jnp.log(jnp.where(inside, det, one))
    return weight * cone_sum(jnp.where(inside, exists * (logs + constant), jnp.full_like(one, -jnp.inf)))


@stage
def criterion_value(
    program: ConvexConeProgram,
    u: Cone,
    size: Array,
    barrier: Barrier | None,
) -> Array:
    """The criterion at the forces ``size u``."""
    if program.price is not None:
        return size * cone_sum(program.price * u[0])
    if program.curvature is not None:
        return size * size * cone_sum(program.exists * inner(u, program.curvature.apply(u))) / 2
    top = size * _top(program.exists, u)
    if barrier is None:
        return top
    return top - _log_det(barrier, program.exists, u, size)


@stage
def cost_sensitivity(program: ConvexConeProgram, u: Cone, size: Array, barrier: Barrier) -> Array:
    """What relative errors of the forces ``size u`` do to the robust cost, over that cost: infinite on an edge."""
    one, tail = jnp.ones_like(u[0]), tail_norm(u)
    counted = (program.exists > 0) & (barrier.on_cone > 0)
    gap = jnp.where(counted, u[0] - tail, one)
    slopes = jnp.where(counted, barrier.on_cone * u[0], 0 * one) / jnp.where(gap > 0, gap, one)
    worst = barrier.weight * cone_sum(slopes) / (size * _top(program.exists, u) + barrier.weight)
    return jnp.where(cone_min(gap) > 0, worst, jnp.full_like(worst, jnp.inf))


class DualPoint(NamedTuple):
    """x = A^T y + E^T beta per cone, and the linear part of the dual function, ``y.w - |beta|.bound`` (L,)."""

    x: Cone
    gain: Array


@stage
def _dual_point(program: ConvexConeProgram, rows: Array) -> DualPoint:
    m = program.rhs.shape[0]
    gain = -vector_inner(program.rhs, rows[:m])
    if program.bound is not None:
        gain = gain - cone_sum(jnp.abs(rows[m:]) * program.bound)
    return DualPoint(rmatvec(program.columns, rows), gain)


def _level_multipliers(violation: Array, cap: Array | None, total: Array) -> Array:
    """Multipliers of the level, of sum ``total``, that cover most of ``violation`` (k, L): the dearest caps first."""
    wanted, zero = entries(violation), jnp.zeros_like(total)[None]
    caps = None if cap is None else entries(cap)
    rows = []
    for i, most in enumerate(wanted):
        before = zero
        for j, other in enumerate(wanted):
            if j == i:
                continue
            if caps is None:
                before = before + (other if j < i else zero)
            else:
                first = (caps[j] > caps[i]) | ((caps[j] == caps[i]) & (j < i))
                before = before + jnp.where(first, other, zero)
        rows.append(jnp.minimum(jnp.maximum(total - before, zero), most))
    return jnp.concatenate(rows)


@stage
def _linear_bound(program: ConvexConeProgram, dual: DualPoint) -> Array:
    """Dual value of prices and levels: the twist as it is, paying caps, or scaled to need none."""
    exists, x = program.exists, dual.x
    zero = jnp.zeros_like(exists)
    violation = exists * jnp.maximum(tail_norm(x) - x[0], zero)
    if program.price is not None:
        covered = jnp.minimum(violation, program.price)
        largest = cone_max(violation)
    else:
        covered = _level_multipliers(violation, program.cap, jnp.ones_like(violation[0]))
        largest = cone_sum(violation)
    needed = jnp.where(largest > 0, largest, jnp.ones_like(largest))
    scaled = jnp.where(largest > 0, dual.gain / needed, jnp.zeros_like(largest))
    over = violation - covered
    cap = jnp.full_like(over, jnp.inf) if program.cap is None else program.cap
    paid = cone_sum(jnp.where(over > 0, jnp.where(over > 0, over, 1) * cap, zero))
    return jnp.maximum(jnp.maximum(scaled, dual.gain - paid), jnp.zeros_like(scaled))


@stage
def _quadratic_bound(program: ConvexConeProgram, dual: DualPoint, u: Cone) -> Array:
    """Dual value with the tails' cost linearised at u, which convexity allows; s_0 minimised exactly in [0, cap]."""
    curvature: Curvature | None = program.curvature
    assert curvature is not None
    exists = program.exists
    tangent = curvature.apply(u)
    x = (dual.x[0], *(a + b for a, b in zip(dual.x[1:], tangent[1:], strict=True)))
    spent = inner(u, tangent) - u[0] * tangent[0]
    rho = jnp.maximum(tail_norm(x) - x[0], jnp.zeros_like(x[0]))
    flat = jnp.where(exists > 0, curvature.head, jnp.ones_like(exists))
    best = rho / flat
    if program.cap is not None:
        best = jnp.minimum(best, program.cap)
    return dual.gain + cone_sum(exists * (flat * best * best / 2 - rho * best - spent / 2))


class BarrierPrices(NamedTuple):
    """Where the dual function of the fixed barriers is taken: z_0 and p (k, L), and what the caps cost (L,)."""

    head: Array
    price: Array
    paid: Array


@stage
def _barrier_prices(program: ConvexConeProgram, x: Cone, u: Cone) -> BarrierPrices:
    """The prices that make the bound high.

    Where u_0 is at its level, ``phi z_0 / det z = psi / p = level`` fixes z_0 and p; elsewhere p is that of the forces.
    The level's multipliers, of sum 1, supply what z lacks, the dearest caps first; what is left is
    worth most at the largest u_0.
    """
    exists, phi, psi = program.exists, program.cone_floor, program.head_floor
    zero, one = jnp.zeros_like(exists), jnp.ones_like(exists)
    top = _top(exists, u)
    level, leads = top + zero, exists * jnp.where(u[0] >= top, one, zero)
    if program.cap is not None:
        level = jnp.minimum(level, program.cap)
    tail = tail_norm(x)
    wanted = jnp.where(phi > 0, (phi + jnp.sqrt(phi * phi + (2 * level * tail) ** 2)) / (2 * level), tail)
    needed = exists * jnp.maximum(wanted + psi / level - x[0], zero)
    price = exists * psi / jnp.where((exists > 0) & (needed <= 0), u[0], level)
    share = _level_multipliers(needed, program.cap, one[0])
    paid, over = jnp.zeros_like(one[0]), zero
    if program.cap is not None:
        # What is lacking costs the cap beyond the level, or, unpaid, a second-order loss of the barrier: the less.
        lacking = needed - share
        gap, floor = jnp.where(phi > 0, wanted - tail, psi / level), jnp.where(phi > 0, phi, psi)
        cheaper = (program.cap - top) * gap * gap <= floor / 2 * lacking
        paying = (cheaper | (lacking > gap / 2)) & jnp.isfinite(program.cap) & (exists > 0)
        over = jnp.where(paying, lacking, zero)
        paid = cone_sum(over * jnp.where(paying, program.cap, zero))
    spare = jnp.maximum(one[0] - cone_sum(share), zero[0]) / jnp.maximum(cone_sum(leads), one[0])
    head = share + leads * spare + over + x[0]
    # A contact without barrier only needs z in its cone.
    price = jnp.where(phi > 0, price, exists * (head - tail))
    return BarrierPrices(head - price, price, paid)


@stage
def _conjugates(program: ConvexConeProgram, x: Cone, prices: BarrierPrices) -> Array:
    """``phi - phi log phi + phi/2 log det z + psi - psi log psi + psi log p`` (k, L)."""
    exists, one = program.exists, jnp.ones_like(program.exists)
    z = (jnp.where(exists > 0, prices.head, one), *(exists * v for v in x[1:]))
    det = jnp.where(interior_distance(z) > 0, determinant(z), 0 * one)
    value = _conjugate(program.cone_floor, det, 0.5) + _conjugate(program.head_floor, prices.price, 1.0)
    return jnp.where(exists > 0, value, 0 * one)


@stage
def _with_conjugates(gain: Array, paid: Array, value: Array) -> Array:
    return gain - paid + cone_sum(value)


def _barrier_bound(program: ConvexConeProgram, dual: DualPoint, u: Cone) -> Array:
    """Dual value of the fixed barriers."""
    # One stage would recompute the logarithms so often that the CPU backend splits it over threads; a kernel may not.
    prices = _barrier_prices(program, dual.x, u)
    return _with_conjugates(dual.gain, prices.paid, _conjugates(program, dual.x, prices))


def _conjugate(floor: Array, value: Array, power: float) -> Array:
    one = jnp.ones_like(floor)
    some = floor > 0
    safe = jnp.where(some, floor, one)
    log = jnp.where(value > 0, jnp.log(jnp.where(value > 0, value, one)), jnp.full_like(value, -jnp.inf))
    return jnp.where(some, safe - safe * jnp.log(safe) + power * safe * log, jnp.zeros_like(floor))


@stage
def _unscaled(bound: Array, barrier: Barrier, exists: Array, size: Array) -> Array:
    """Back from forces u to forces ``size u`` under the logarithms."""
    weight, on_normal, on_cone, constant = barrier
    log = jnp.log(size)
    return size * bound - weight * cone_sum(exists * ((on_normal + 2 * on_cone) * log + constant))


def dual_value(
    program: ConvexConeProgram,
    rows: Array,
    u: Cone,
    size: Array,
    barrier: Barrier | None,
) -> Array:
    """What no admissible forces can undercut, from the multipliers ``rows``; u near the optimum makes it close."""
    dual = _dual_point(program, rows)
    if program.curvature is not None:
        return _scaled(_scaled(_quadratic_bound(program, dual, u), size), size)
    if program.head_floor is None:
        return _scaled(_linear_bound(program, dual), size)
    assert barrier is not None
    return _unscaled(_barrier_bound(program, dual, u), barrier, program.exists, size)


@stage
def barrier_loss(program: ConvexConeProgram, rows: Array, u: Cone, blur: Array) -> Array:
    """What the bound loses where all x_0 are less by ``blur`` (L,): infinite where z may leave its cone."""
    x, phi, psi = rmatvec(program.columns, rows), program.cone_floor, program.head_floor
    prices, tail, exists = _barrier_prices(program, x, u), tail_norm(x), program.exists > 0
    zero, one = jnp.zeros_like(tail), jnp.ones_like(tail)
    gap = jnp.where(phi > 0, prices.head - tail, prices.price)
    inside = exists & (gap > 4 * blur)
    slope = jnp.where(phi > 0, phi * prices.head / (prices.head + tail), psi) / jnp.where(inside, gap, one)
    loss = 1.2 * blur * cone_sum(jnp.where(inside, slope, zero))
    return jnp.where(cone_max(jnp.where(exists & ~inside, one, zero)) > 0, jnp.full_like(loss, jnp.inf), loss)


@stage
def _scaled(x: Array, size: Array) -> Array:
    return x * size
