"""A sturdier second attempt at the margin, in pairs of floats, for the few lanes that the first leaves undecided.

The dual of the margin's cone program (``problem``) has six unknowns. Its central path, with B = A - a e^T / k,

    minimise  tau a.y - sum_i log det z_i,    z = e / k - B^T y,    tau to infinity,

is followed by Newton steps of dual scaling: from each, u = (g - F'' dz) / tau with g = -F' solves B u = -a exactly and
lies in the cones as soon as the step is shorter than 1 in the norm of F''. A is not factored: its rows are
orthonormalised, T A = Q, and the twist of A for y is T^T y. The evidence is rounded to the grasp's precision first and
judged then: the force projected onto Null(A), the twist multiplied by A^T, both in pairs, so that what is reported is
true of the numbers that are stored. Loops and whole arrays keep the program small; speed matters little here.

Source: Benson, Ye, Zhang, Solving large-scale sparse semidefinite programs for combinatorial optimization, 2000.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..backend import fori_loop, to_lanes, while_loop
from ..conic import Pair, pair, pair_roundoff, pair_sqrt, pair_sum, pair_where
from ..contacts import Component, Contacts, normal_first
from ..core import Array, Status, first_of, frame_components, unit_roundoff
from .verdict import Verdict, lower_end

__all__ = ["second_attempt"]

BUDGET, PATIENCE = 90, 8  # iterations; how many in a row may bring nothing
RADIUS = 0.8  # a Newton step this short gives forces inside the cones
AHEAD = 10.0  # how far ahead of the forces found the next target on the path lies
NEAREST = 0.9  # of the way to the boundary


class _Problem(NamedTuple):
    """A and scales of the folded forces: (m, d, k, L) and (d, k, L); Q and T with ``T A = Q``; who exists (k, L)."""

    A: Pair
    scale: Array
    Q: Pair
    T: Pair
    exists: Array
    length: Array
    dimension: int

    @property
    def count(self) -> Array:
        return jnp.sum(self.exists, axis=0)


def _stack(parts: list[Pair]) -> Pair:
    return jax.tree.map(lambda *x: jnp.stack(x), *parts)


def _fold(
    contacts: Contacts, components: tuple[Component, ...], valid: Array, length: Array
) -> tuple[Pair, Array]:
    """A (m, d, k, L) of valid lanes, and the factors (d, k, L) between forces and folded forces."""
    position, normal, friction, torsion, active = (to_lanes(x) for x in contacts)
    dimension, live = position.shape[1], active & valid
    last = np.eye(dimension, dtype=position.dtype)[-1:, :, None]
    point, raw = (
        jnp.swapaxes(jnp.where(live[:, None], x, y), 0, 1) for x, y in ((position, 0 * last), (normal, last))
    )
    lengths = 1.0 / pair(length)
    point = pair(point) * lengths
    half = 2.0 ** (jnp.finfo(raw.dtype).maxexp // 2)  # exact, so that no reciprocal underflows
    raw = jnp.where(jnp.max(jnp.abs(raw), axis=0) > 1, raw / half, raw * half)
    rows = pair(raw) / jnp.max(jnp.abs(raw), axis=0)
    unit = rows / pair_sqrt(pair_sum(rows * rows, 0))
    sign = jnp.where(raw[-1] >= 0, 1.0, -1.0).astype(raw.dtype)
    coordinates: Any = tuple(unit[i] for i in range(dimension))
    frames: Any = frame_components(coordinates, sign)  # the same formula, of pairs
    exists, mu, gamma = (jnp.where(live, x, 0) for x in (jnp.ones_like(friction), friction, torsion))
    directions, scale = [], []
    for component in normal_first(components):
        if component is Component.SPIN:
            continue
        tangent = frames[0 if component is Component.TANGENT_1 else -1]
        directions.append(unit if component is Component.NORMAL else _stack(list(tangent)))
        scale.append(exists if component is Component.NORMAL else mu)
    force = _moved(_stack(directions) * jnp.stack(scale)[:, None])  # (dimension, d, k, L)
    if dimension == 2:
        moment = point[:1, None] * force[1:] - point[1:, None] * force[:1]
    else:
        turned = [
            _rolled(point, 1)[:, None] * _rolled(force, 2),
            _rolled(point, 2)[:, None] * _rolled(force, 1),
        ]
        moment = turned[0] - turned[1]
    A = _joined(force, moment)
    if Component.SPIN in components:
        spin = unit * (gamma * lengths)
        A = _joined(A, _joined(_zeros(spin), spin)[:, None], 1)
        scale.append(gamma)
    return A, jnp.stack(scale)


def _moved(x: Pair) -> Pair:
    return jax.tree.map(lambda v: jnp.swapaxes(v, 0, 1), x)


def _rolled(x: Pair, by: int) -> Pair:
    """x_(i + by) at i, along the first axis."""
    return jax.tree.map(lambda v: jnp.roll(v, -by, 0), x)


def _joined(x: Pair, y: Pair, axis: int = 0) -> Pair:
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis), x, y)


def _zeros(x: Pair) -> Pair:
    return jax.tree.map(jnp.zeros_like, x)


def _orthonormal(A: Pair) -> tuple[Pair, Pair]:
    """``Q = T A`` with orthonormal rows, by modified Gram-Schmidt; rows that depend on others become zero."""
    m, d, k, lanes = A.hi.shape
    identity = jnp.broadcast_to(jnp.eye(m, dtype=A.hi.dtype)[:, :, None], (m, m, lanes))
    flat = jax.tree.map(lambda x: x.reshape(m, d * k, lanes), A)
    wide = _joined(flat, pair(identity), 1)
    floor = jnp.sqrt(jnp.max(jnp.sum(flat.hi * flat.hi, axis=1), axis=0)) * (
        2.0**12 * pair_roundoff(A.hi.dtype)
    )

    def one(i: Array, rows: Pair) -> Pair:
        j = i % m  # twice round: what the first pass leaves of the rows above, the second takes
        row = jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, j, 0, keepdims=False), rows)
        head = row[: d * k]
        norm = pair_sqrt(pair_sum(head * head, 0))
        there = norm.hi > floor
        safe = pair_where(there, norm, pair(jnp.ones_like(norm.hi)))
        row = row / safe[None]
        row = pair_where(there[None], row, pair(jnp.zeros_like(row.hi)))
        overlap = pair_sum(rows[:, : d * k] * row[: d * k][None], 1)
        overlap = pair_where((jnp.arange(m) > j)[:, None], overlap, pair(jnp.zeros_like(overlap.hi)))
        rows = rows - overlap[:, None] * row[None]
        return jax.tree.map(lambda x, r: lax.dynamic_update_index_in_dim(x, r, j, 0), rows, row)

    wide = fori_loop(0, 2 * m, one, wide)
    Q = jax.tree.map(lambda x: x[:, : d * k].reshape(m, d, k, lanes), wide)
    return Q, wide[:, d * k :]


def _times(A: Pair, s: Pair) -> Pair:
    """``A s``: (m, L)."""
    return pair_sum(A * s[None], 1, 2)


def _transposed(A: Pair, y: Pair) -> Pair:
    """``A^T y``: (d, k, L)."""
    return pair_sum(A * y[:, None, None], 0)


def _mirrored(x: Pair, axis: int = 0) -> Pair:
    """(x_0, -x_1, ..) along an axis."""
    sign = (
        jnp.where(jnp.arange(x.hi.shape[axis]) > 0, -1.0, 1.0)
        .astype(x.hi.dtype)
        .reshape(-1, *(1,) * (x.hi.ndim - 1 - axis))
    )
    return Pair(sign * x.hi, sign * x.lo)


def _solved(H: Pair, rhs: Pair) -> Pair:
    """``H^-1 rhs`` (m, r, L) by elimination without pivoting, for positive definite H (m, m, L)."""
    m = H.hi.shape[0]
    wide = _joined(H, rhs, 1)

    def one(j: Array, rows: Pair) -> Pair:
        row = jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, j, 0, keepdims=False), rows)
        pivot = jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, j, 0), row)
        there = pivot.hi > 0
        row = row / pair_where(there, pivot, pair(jnp.ones_like(pivot.hi)))
        row = pair_where(there, row, pair(jnp.zeros_like(row.hi)))
        column = jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, j, 1), rows)
        others = (jnp.arange(m) != j)[:, None, None]
        rows = rows - pair_where(others, column, pair(jnp.zeros_like(column.hi))) * row[None]
        return jax.tree.map(lambda x, r: lax.dynamic_update_index_in_dim(x, r, j, 0), rows, row)

    return fori_loop(0, m, one, wide)[:, m:]


class _State(NamedTuple):
    """Where the path is: y; the best forces u and multipliers so far, their bracket, and steps without progress."""

    y: Pair
    u: Pair
    best: Pair
    lower: Array
    upper: Array
    idle: Array
    running: Array


def _step(B: Pair, a: Pair, exists: Array, state: _State, goal: Array) -> _State:
    """One Newton step of dual scaling, and the forces that it shows."""
    count = jnp.sum(exists, axis=0)
    share = pair(exists) / pair(count)
    zero = jnp.zeros_like(exists)
    v = _transposed(B, state.y)
    z = _stack([share - v[0], *(-v[i] for i in range(1, v.hi.shape[0]))])
    padding = exists == 0
    z = pair_where(padding, pair(jnp.zeros_like(z.hi).at[0].set(1.0)), z)
    inverse = 1.0 / pair_sum(z * _mirrored(z), 0)
    w = _mirrored(z) * inverse[None]
    along = pair_sum(B * w[None], 1)  # (m, k, L)
    C = (w[None] * along[:, None]).scaled(4.0) - _mirrored(B, 1) * inverse.scaled(2.0)
    H = pair_sum(B[:, None] * C[None], 2, 3)
    force = pair_sum(along, 1).scaled(2.0)  # B g
    dy = _solved(H, jax.tree.map(lambda p, q: jnp.stack([-p, -q], 1), a, force))
    ends = jax.tree.map(lambda x, y, z: jnp.stack([x, x, z], 1), a, a, force)
    p, q, r = -pair_sum(ends * dy[:, np.array([0, 1, 1])], 0).hi
    safe = jnp.where(p > 0, p, jnp.ones_like(p))
    disc = q * q - p * (r - RADIUS * RADIUS)
    inside = (disc > 0) & (p > 0)
    tau = (jnp.sqrt(jnp.where(inside, disc, jnp.zeros_like(disc))) - q) / safe
    inside = inside & (tau > 0)
    tau = jnp.where(inside, tau, jnp.maximum(-q / safe, jnp.full_like(q, 1e-3)))

    def direction(tau: Array) -> tuple[Pair, Pair]:
        step = dy[:, 0] * tau + dy[:, 1]
        return step, -_transposed(B, step)

    _, dz = direction(tau)
    bent = (w * pair_sum(w * dz, 0)).scaled(2.0) - _mirrored(dz) * inverse
    u = (w - bent) * (1.0 / pair(tau)).scaled(2.0)
    u = pair_where(padding, pair(jnp.zeros_like(u.hi)), u)
    lower = jnp.where(inside, (1.0 + -pair_sum(u[0], 0) / count).hi, -jnp.inf)
    upper = (1.0 + pair_sum(a * state.y, 0)).hi
    better, tighter = state.running & (lower > state.lower), state.running & (upper < state.upper)

    step, dz = direction(jnp.where(inside, AHEAD * tau, tau))
    mean = pair_sum(w * dz, 0)
    least = mean.hi - jnp.sqrt(
        jnp.maximum((mean * mean - pair_sum(dz * _mirrored(dz), 0) * inverse).hi, jnp.zeros_like(zero))
    )
    rate = jnp.max(jnp.where(padding, zero, -least), axis=0)
    length = 1 / jnp.maximum(jnp.ones_like(rate), rate / NEAREST)
    finite = jnp.all(jnp.isfinite(step.hi), axis=0) & jnp.isfinite(length)
    y = pair_where(state.running & finite, state.y + step * length, state.y)

    found = state._replace(
        y=y,
        u=pair_where(better, u, state.u),
        best=pair_where(tighter, state.y, state.best),
        lower=jnp.where(better, lower, state.lower),
        upper=jnp.where(tighter, upper, state.upper),
    )
    width, before = found.upper - found.lower, state.upper - state.lower
    idle = jnp.where(width < 0.9 * before, 0, state.idle + 1)
    size = jnp.maximum(jnp.ones_like(width), jnp.abs(found.lower))
    decided = width <= 0.25 * jnp.maximum(found.lower, -found.upper)
    done = (width <= goal * size) & (decided | (width <= 1e-3 * goal * size))
    return found._replace(idle=idle, running=state.running & finite & ~done & (idle < PATIENCE))


def _path(problem: _Problem, goal: Array) -> tuple[Pair, Pair]:
    """Folded forces and multipliers of A at the end of the path."""
    Q, exists, count = problem.Q, problem.exists, problem.count
    a = pair_sum(Q[:, 0], 1)
    mean = a[:, None] * (pair(exists) / pair(count))[None]
    first = Q[:, :1] - mean[:, None]
    B = jax.tree.map(lambda x, y: jnp.concatenate([x, y[:, 1:]], 1), first, Q)
    zero = jax.tree.map(jnp.zeros_like, a)
    u = jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), Q)
    one = jnp.ones_like(count)
    start = _State(zero, u, zero, -jnp.inf * one, one, jnp.zeros(one.shape, jnp.int32), one > 0)

    def body(carry: tuple[Array, _State]) -> tuple[Array, _State]:
        return carry[0] + 1, _step(B, a, exists, carry[1], goal)

    def unfinished(carry: tuple[Array, _State]) -> Array:
        return (carry[0] < BUDGET) & jnp.any(carry[1].running)

    end = while_loop(unfinished, body, (jnp.int32(0), start), (problem, goal))[1]
    t = 1.0 + -pair_sum(end.u[0], 0) / count
    s = jax.tree.map(lambda x, h: jnp.concatenate([h[None], x[1:]]), end.u, exists * t + end.u[0])
    return s, pair_sum(problem.T * (-end.best)[:, None], 0)


def _projected(problem: _Problem, s: Pair) -> Pair:
    """The internal force of A next to s, mean normal force 1."""
    for _ in range(2):
        s = s - _transposed(problem.Q, _times(problem.Q, s))
    total = pair_sum(s[0], 0)
    return s * (problem.count / pair_where(total.hi > 0, total, pair(jnp.ones_like(total.hi))))


def _depth(x: Pair, exists: Array) -> Array:
    """``min_i x_0,i - |x_1..,i|`` (L,)."""
    depth = x[0] - pair_sqrt(pair_sum(x[1:] * x[1:], 0)) if x.hi.shape[0] > 1 else x[0]
    return jnp.min(jnp.where(exists > 0, depth.hi, jnp.inf), axis=0)


def _force(problem: _Problem, s: Pair) -> tuple[Array, Array, Array, Array]:
    """The forces that are stored (d, k, L), the margin that they prove, its error, and whether their mean is right."""
    size = jnp.sqrt(jnp.sum(s.hi * s.hi, axis=(0, 1)))
    stored = (s * problem.scale).hi
    there = problem.scale > 0
    again = pair(jnp.where(there, stored, 0)) / jnp.where(there, problem.scale, 1)
    exact = _projected(problem, again)
    total = jnp.sum(again.hi[0], axis=0)
    spread = jnp.sqrt(jnp.sum(problem.T.hi * problem.T.hi, axis=(0, 1)))
    error = 2.0**10 * pair_roundoff(size.dtype) * size * (1 + spread) * (1 + size)
    return stored, _depth(exact, problem.exists), error, (total > 0) & jnp.isfinite(error)


def _twist(problem: _Problem, twist: Pair) -> tuple[Array, Array, Array]:
    """The twist that is stored (m, L), what it proves of t* as an upper bound, and how deep in all cones it is."""
    m, dimension, exists, count = twist.hi.shape[0], problem.dimension, problem.exists, problem.count
    rotation = (jnp.arange(m) >= dimension)[:, None]
    body = twist.hi / jnp.where(rotation, problem.length, 1)
    largest = jnp.max(jnp.abs(body), axis=0)
    stored = body / jnp.where(largest > 0, largest, 1)
    stored = stored / jnp.sqrt(jnp.sum(stored * stored, axis=0))
    xi = pair(stored) * jnp.where(rotation, problem.length, 1)
    x = _transposed(problem.A, xi)
    size = jnp.sqrt(jnp.sum(xi.hi * xi.hi, axis=0)) * jnp.sqrt(jnp.sum(problem.A.hi**2, axis=(0, 1, 2)))
    error = 2.0**10 * pair_roundoff(size.dtype) * size
    total = pair_sum(x[0], 0)
    reach = pair_sqrt(pair_sum(x[1:] * x[1:], 0)) - x[0] if x.hi.shape[0] > 1 else -x[0]
    worst = jnp.argmax(jnp.where(exists > 0, reach.hi, -jnp.inf), axis=0)[None]
    gauge = (
        jax.tree.map(lambda v: jnp.take_along_axis(v, worst, 0)[0], reach) * count + total + 2 * count * error
    )
    descent = total + -(count * error)
    useful = (descent.hi > 0) & (gauge.hi > 0)
    one = pair(jnp.ones_like(size))
    upper = 1.0 + -pair_where(useful, descent, pair(jnp.zeros_like(size))) / pair_where(useful, gauge, one)
    return stored, upper.hi, _depth(x, exists) - error


def second_attempt(
    components: tuple[Component, ...],
    dimension: int,
    contacts: Contacts,
    length: Array,
    first: Verdict,
    tolerance: Array,
) -> Verdict:
    """The verdict of one tile of rows, lanes last: of the second attempt where it proves more than the ``first``."""
    valid = first.status != Status.INVALID.value
    A, scale = _fold(contacts, components, valid, length)
    exists = (scale[0] > 0).astype(length.dtype)
    problem = _Problem(A, scale, *_orthonormal(A), exists, length, dimension)
    s, y = _path(problem, tolerance)
    s = _projected(problem, s)  # what is stored balances to rounding
    stored, slack, error, sound = _force(problem, s)
    twist, upper, depth = _twist(problem, y)

    eps = unit_roundoff(length.dtype)
    m = A.hi.shape[0]
    # Room for a checker that projects with other rounded lengths, in float64 at best.
    room = 256 * unit_roundoff("float64")
    lower = jnp.where(sound, slack - error - (room + 4 * eps) * jnp.abs(slack) - room, -jnp.inf)
    upper = upper + room + (room + 4 * eps) * jnp.abs(upper)
    lower = lower_end(lower, upper, (room + 4 * eps) * (1 + jnp.abs(upper)))
    full = first.rank >= m
    status = first_of(
        [
            (full & sound & (slack > 2 * error), Status.RESISTANT),
            (depth > 0, Status.NOT_RESISTANT),
            (full & (lower >= -tolerance) & (upper <= tolerance), Status.MARGINAL),
        ],
        Status.UNDECIDED,
    )
    order = normal_first(components)
    parts = jnp.stack([stored[order.index(c)] for c in components], axis=1)
    force = parts.reshape(-1, parts.shape[-1])
    escape = jnp.where(status == Status.RESISTANT.value, jnp.zeros_like(twist), twist)
    found = Verdict(status, lower, upper, first.rank, force, escape, twist)
    proved = (status != Status.UNDECIDED.value) | (upper - lower < first.upper - first.margin)
    better = proved & (first.status == Status.UNDECIDED.value)
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), found, first)
