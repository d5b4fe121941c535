"""The force problem of one tile of grasps as a cone program (section 11.3, theory section 3), lanes on the last axis.

    min h(f)   subject to   G f + w = 0,  f_i in C_i,  f_n,i <= max_i,  |J^T f| <= tau_max

In folded forces s (f = mu s, gamma s, s) with lengths over L this is ``A s = -w``, one unit cone per contact. With
A = L_A Q, Q of orthonormal rows, and the load scaled to ``size``: ``Q u = b = -L_A^-1 w / size``, ``s = size u``. Rows
of A that depend on others drop out; a load outside their range is refuted by linear algebra alone.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ..backend import stage, to_lanes
from ..conic import (
    Cone,
    ConvexConeProgram,
    Curvature,
    cone_all,
    cone_any,
    cone_max,
    null_combination,
    residual_lower,
    solve_lower,
    vector_norm,
)
from ..contacts import Component, Contacts, Tile, nonzero, normal_first
from ..core import Array, load_limit, unit_roundoff
from .bounds import Barrier
from .criteria import Criterion

__all__ = ["Demand", "ForceProblem", "Load", "force_problem", "force_program"]


FAR = 1e16  # loads: beside such forces the load itself is rounding, so that a larger cap is none


class Demand(NamedTuple):
    """What is asked of each grasp, as rows.

    wrench    (N, m) in N and N m                 criterion  its weights one per row
    cap       (N, k) largest f_n in N, or None    log_det    (a, b, c), (N, k) each: log det P, or None
    jacobian  (N, k n, q), or None                torque     (N, q) tau_max, or None
    smoothing (N,) in units of the cost, or None
    """

    wrench: Array
    criterion: Criterion
    log_det: tuple[Array, Array, Array] | None
    cap: Array | None
    jacobian: Array | None
    torque: Array | None
    smoothing: Array | None = None

    def barrier(self) -> Barrier | None:
        """The criterion's fixed barrier, lanes last."""
        weight = self.criterion.barrier_weight
        if weight is None or self.log_det is None:
            return None
        return Barrier(weight, *(to_lanes(x) for x in self.log_det))


class Load(NamedTuple):
    """The load of a tile in the metric of A.

    wrench  (m, L): force and torque / L            rhs     (m, L): b
    size    (L,) N: forces are ``size u``           off     (L,) bool: outside the range of A
    twist   (m, L): for lanes that are off, a twist no force can oppose, with positive power of the load
    rest    (L,) bool: no load at all
    """

    wrench: Array
    rhs: Array
    size: Array
    off: Array
    twist: Array
    rest: Array


class ForceProblem(NamedTuple):
    """A tile's force problem: as asked, as the scaled program, and how to read that back.

    valid  (L,) bool: the numbers are a problem      row_norm  (q, L): E is divided by it, or None
    """

    tile: Tile
    demand: Demand
    program: ConvexConeProgram
    load: Load
    valid: Array
    row_norm: Array | None


@stage
def _scaled_wrench(force: Array, torque: Array, length: Array) -> tuple[Array, Array]:
    """(force; torque / L), and whether it is a load: 0, or of a size whose square neither over- nor underflows."""
    rows, limit = jnp.concatenate([force, torque / length]), load_limit(force.dtype)
    size = cone_max(jnp.abs(rows))
    fits = (size >= 1 / limit) & (size <= limit)
    finite = fits | ~cone_any(nonzero(jnp.concatenate([force, torque])))
    return jnp.where(finite, rows, jnp.zeros_like(rows)), finite


@stage
def _load_size(
    inner: Array, residual: Array, wrench: Array, norm: Array, weight: Array | None
) -> tuple[Array, Array, Array, Array]:
    """b, the size, whether the load is off the range, whether there is none."""
    dtype = norm.dtype
    size, outside, outer = vector_norm(inner), vector_norm(residual), vector_norm(wrench)
    rounding = jnp.asarray(256 * unit_roundoff(dtype), dtype) * (outer + norm * size)
    off = outside > rounding
    rest = outer == 0
    total = size if weight is None else size + weight
    total = jnp.where(total > 0, total, jnp.ones_like(total))
    return -inner / total, total, off, rest


def load_of(tile: Tile, demand: Demand) -> tuple[Load, Array]:
    """The load in the metric of A, and which lanes are finite."""
    folded, factor = tile.folded, tile.projection.factor
    wrench = to_lanes(demand.wrench)
    rows, finite = _scaled_wrench(wrench[: tile.dimension], wrench[tile.dimension :], folded.length)
    inner, residual = solve_lower(factor, rows), residual_lower(factor, rows)
    rhs, size, off, rest = _load_size(inner, residual, rows, folded.norm, demand.criterion.barrier_weight)
    return Load(rows, rhs, size, off, null_combination(factor, residual), rest), finite


@stage
def _scaled_caps(cap: Array, exists: Array, size: Array) -> tuple[Array, Array]:
    """Scaled caps, infinite for none; lanes whose caps are positive numbers."""
    good = (cap > 0) | (exists == 0)  # NaN compares false
    cap = jnp.where(good & (exists > 0), cap / size, jnp.full_like(cap, jnp.inf))
    return jnp.where(cap < FAR, cap, jnp.full_like(cap, jnp.inf)), cone_all(good)


class TorqueRows(NamedTuple):
    """``|E s| <= bound``: E with normal components first, what its rows were divided by, and which lanes are numbers.

    Rows are divided by |J_j| or the limit, whichever is larger: a limit far above all torques is then like any other
    that is not reached, and an infinite one is a row of zeros.
    """

    columns: Cone
    bound: Array
    norm: Array
    sound: Array


def torque_rows(
    demand: Demand,
    contacts: Contacts,
    exists: Array,
    size: Array,
    components: tuple[Component, ...],
    row_norm: Array | None = None,
) -> TorqueRows:
    """The rows of ``|J^T f| <= tau_max`` for forces ``size u``."""
    order = normal_first(components)

    @stage
    def run(
        jacobian: Array, torque: Array, exists: Array, size: Array, friction: Array, torsion: Array
    ) -> TorqueRows:
        scale = {Component.NORMAL: jnp.ones_like(friction), Component.SPIN: torsion}
        zero = jnp.zeros_like(jacobian[0])
        parts, square = [], zero
        for c in order:
            factor, row = scale.get(c, friction), components.index(c)
            rows = []
            for i in range(exists.shape[0]):
                value = jnp.where(exists[i] > 0, jacobian[i * len(order) + row] * factor[i], zero)
                rows.append(value)
                square = square + value * value
            parts.append(rows)
        good = torque > 0  # NaN compares false
        reach = jnp.where(good, torque, jnp.ones_like(torque)) / size
        sound = cone_all(jnp.isfinite(square) & good)
        limited = jnp.isfinite(reach) & jnp.isfinite(square)
        reach = jnp.where(limited, reach, jnp.ones_like(reach))
        norm = row_norm
        if norm is None:
            longest = jnp.maximum(jnp.sqrt(jnp.where(limited, square, zero)), reach)
            norm = jnp.where(limited & (longest > 0), longest, jnp.full_like(reach, jnp.inf))
        used = jnp.isfinite(norm)
        safe = jnp.where(used, norm, jnp.ones_like(norm))
        columns = tuple(jnp.stack([jnp.where(used, x / safe, zero) for x in rows], axis=1) for rows in parts)
        return TorqueRows(columns, jnp.where(used, reach / safe, jnp.ones_like(reach)), norm, sound)

    assert demand.jacobian is not None and demand.torque is not None
    limits = to_lanes(demand.jacobian), to_lanes(demand.torque)
    return run(*limits, exists, size, to_lanes(contacts.friction), to_lanes(contacts.torsion))


@stage
def _joined(upper: Cone, lower: Cone) -> Cone:
    return tuple(jnp.concatenate([a, b]) for a, b in zip(upper, lower, strict=True))


def curvature(
    criterion: Criterion, contacts: Contacts, exists: Array, components: tuple[Component, ...]
) -> Curvature | None:
    """D of ``<s, D s> / 2``, or None."""
    order = normal_first(components)

    @stage
    def run(criterion: Criterion, exists: Array, friction: Array, torsion: Array) -> tuple[Array | None, ...]:
        parts = [criterion.curvature(c, friction, torsion) for c in order]
        return tuple(None if x is None else 2 * jnp.where(exists > 0, x, jnp.zeros_like(x)) for x in parts)

    parts = run(criterion, exists, to_lanes(contacts.friction), to_lanes(contacts.torsion))
    head = parts[0]
    if head is None:
        return None
    tail = parts[1] if parts[1:] else jnp.zeros_like(head)
    last = parts[-1] if Component.SPIN in order else None
    assert tail is not None
    return Curvature(head, tail, last)


@stage
def _floors(barrier: Barrier, exists: Array, size: Array) -> tuple[Array, Array]:
    share = exists * (barrier.weight / size)
    return 2 * share * barrier.on_cone, share * barrier.on_normal


@stage
def _all(flags: list[Array]) -> Array:
    return reduce(jnp.logical_and, flags)


@stage
def _positive_weight(weight: Array) -> tuple[Array, Array]:
    good = (weight > 0) & jnp.isfinite(weight)
    return jnp.where(good, weight, jnp.ones_like(weight)), good


def force_program(
    contacts: Contacts,
    exists: Array,
    columns: Cone,
    rhs: Array,
    size: Array,
    demand: Demand,
    components: tuple[Component, ...],
    row_norm: Array | None = None,
) -> tuple[ConvexConeProgram, Array | None, Array]:
    """The program for forces ``size u``, ``columns u = rhs``; the norms of its torque rows; which limits are numbers.

    ``row_norm`` fixes what the torque rows are divided by.
    """
    criterion = demand.criterion
    sound, cap, bound = [exists[0] == exists[0]], None, None
    if demand.jacobian is not None:
        limits = torque_rows(demand, contacts, exists, size, components, row_norm)
        columns, bound, row_norm = _joined(columns, limits.columns), limits.bound, limits.norm
        sound.append(limits.sound)
    if demand.cap is not None:
        cap, good = _scaled_caps(to_lanes(demand.cap), exists, size)
        sound.append(good)
    cone_floor = head_floor = None
    barrier = demand.barrier()
    if barrier is not None:
        cone_floor, head_floor = _floors(barrier, exists, size)
    curved = curvature(criterion, contacts, exists, components)
    program = ConvexConeProgram(
        columns,
        rhs,
        exists,
        exists if criterion.price else None,
        curved,
        jnp.ones_like(size) if criterion.level else None,
        cap,
        bound,
        cone_floor,
        head_floor,
        None if demand.smoothing is None else _per_size(demand.smoothing, size, curved is not None),
    )
    return program, row_norm, _all(sound)


def _per_size(smoothing: Array, size: Array, squared: bool) -> Array:
    return smoothing / (size * size) if squared else smoothing / size


def force_problem(tile: Tile, demand: Demand) -> ForceProblem:
    """The program of a tile: numbers that are no problem are replaced by harmless ones, and said to be invalid."""
    criterion = demand.criterion
    sound = [tile.folded.valid]
    for name in ("weight", "length"):
        value = getattr(criterion, name, None)
        if value is not None:
            value, good = _positive_weight(value)
            criterion = eqx.tree_at(lambda c, name=name: getattr(c, name), criterion, value)
            sound.append(good)
    safe = demand._replace(criterion=criterion)
    load, finite = load_of(tile, safe)
    program, norm, good = force_program(
        tile.contacts,
        tile.folded.exists,
        tile.projection.basis.columns,
        load.rhs,
        load.size,
        safe,
        tile.components,
    )
    return ForceProblem(tile, demand, program, load, _all([*sound, finite, good]), norm)
