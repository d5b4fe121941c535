"""The Ferrari-Canny quality between two proven bounds: the largest ball of wrenches that unit effort resists.

    epsilon = max {r : every wrench |w| <= r is G f for some f in C, effort(f) <= 1} = min over |d| = 1 of h(d)

Lower bound: a polytope of wrenches of unit effort contains the ball (``polytope``). Upper bound: the support function
h at one direction, in closed form (``effort``). The polytope begins with the wrenches of the margin's internal force
and a little more, along the principal axes of the grasp map, so the origin is inside from the start. When the bracket
is as narrow as asked, Newton's method sharpens the direction (``weakest``), and with it the upper bound and the
derivative, which is that of d . G f with the touching forces f held: the envelope theorem.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from ..backend import batched, in_chunks, is_traced, map_tiles, varying_like
from ..certificates import prove_epsilon, proved_by
from ..conic import left_svd, solve
from ..contacts import Grasp, cleared
from ..core import Answer, Array, Bool, Float, Int, Status, nan_where
from ..resistance import WrenchResistance, wrench_resistance
from .polytope import Capacity, Polytope, begin, grow, widen
from .unit_wrench_space import NORMS, effort_map, extreme_force, scaled, support, torque_lengths
from .weakest_direction import Touch, weakest_direction

__all__ = ["EpsilonQuality", "epsilon_quality"]

CAPACITIES = (Capacity(1024, 64, 192, 256), Capacity(16384, 512, 2048, 2048))
CHUNK = 64  # grasps an executable takes at once when called on concrete arrays


@proved_by(lambda grasp, answer, problem, tolerance: prove_epsilon(grasp, answer, tolerance))
class EpsilonQuality(Answer):
    """``lower <= epsilon <= upper``, in N of resisted wrench (torques over ``torque_scale``) per N of effort.

    status       int32, the ``Status`` of wrench resistance; both bounds are 0 unless RESISTANT, NaN where INVALID
    lower        (*batch) radius of a ball inside the polytope of ``forces``
    upper        (*batch) h(direction): unit effort pushes no harder than this along ``direction``
    direction    (*batch, m) unit (F; tau / torque_scale): where the grasp is weakest. The load -direction is the worst
                 wrench; where not resistant the load along which nothing is resisted
    touching     (*batch, k n) forces of unit effort behind the worst wrench, about ``upper * direction``
    smooth       bool: ``upper`` is the value at an isolated weakest direction, to rounding, its derivative exact:
                 epsilon's own, unless another direction within the bracket is weaker still (with "Linf", 1 in 200).
                 Elsewhere the derivative is one finite choice, good to about the root of the bracket
    forces       (*batch, V, k n) unit effort each: the vertices of the polytope; zero beyond the last
    facets       (*batch, F, m) int32 vertex numbers; -1 beyond the last. Together they surround the origin
    torque_scale (*batch) m
    norm         "L1" or "Linf"

    ``forces`` and ``facets`` prove ``lower`` and are empty without ``certificate=True``.
    """

    status: Int[Array, "*batch"]
    lower: Float[Array, "*batch"]
    upper: Float[Array, "*batch"]
    direction: Float[Array, "*batch m"]
    touching: Float[Array, "*batch kn"]
    smooth: Bool[Array, "*batch"]
    forces: Float[Array, "*batch V kn"]
    facets: Int[Array, "*batch F m"]
    torque_scale: Float[Array, "*batch"]
    norm: str = eqx.field(static=True)

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """The bracket of one lane in words."""
        lower, upper = (np.asarray(x)[index] for x in (self.lower, self.upper))
        return "" if np.isnan(lower) else f"Epsilon ({self.norm}) between {lower:.6g} and {upper:.6g}."

    @property
    def width(self) -> Float[Array, "*batch"]:
        """``(upper - lower) / upper``; 0 where both are 0."""
        return jnp.where(
            self.upper > 0, (self.upper - self.lower) / jnp.where(self.upper > 0, self.upper, 1.0), 0.0
        )


class _Rows(NamedTuple):
    """What the search needs of each grasp."""

    A: Array  # (N, k, m, n)
    active: Array  # (N, k)
    internal: Array  # (N, k, n) scaled, mean normal force 1
    resistant: Array  # (N,)


class _Found(NamedTuple):
    lower: Array
    upper: Array
    direction: Array
    touching: Array  # (k, n) scaled
    smooth: Array
    forces: Array  # (V, k, n) scaled
    facets: Array


def _seed(A: Array, internal: Array, active: Array, norm: str) -> tuple[Array, Array]:
    """Orthogonal axes (m, m) inside W and the scaled forces (2 m, k, n) of +-each: half an internal force and more.

    A force v of norm r moves a contact's depth s_0 - |s_t| by at most sqrt(2) r, and the effort by sqrt(k) r (L1) or r.
    """
    k, m, n = A.shape
    wide = jnp.moveaxis(A, 0, 1).reshape(m, k * n)
    sigma, U = left_svd(wide)
    V = (U.T @ wide) / jnp.where(sigma > 0, sigma, 1.0)[:, None]
    count = jnp.sum(active, dtype=A.dtype)
    most = jnp.max(internal[:, 0]) if norm == "Linf" else count
    half = internal / (2 * most)
    depth = half[:, 0] - jnp.sqrt(jnp.sum(half[:, 1:] ** 2, axis=-1))
    depth = jnp.min(jnp.where(active, depth, jnp.inf))
    effort = 2 * jnp.sqrt(count) if norm == "L1" else jnp.asarray(2.0, A.dtype)
    size = jnp.minimum(depth / jnp.sqrt(jnp.asarray(2.0, A.dtype)), 1 / effort)
    more = (size * V).reshape(m, k, n)
    forces = jnp.stack([half + more, half - more], axis=1).reshape(2 * m, k, n)
    return (U * (sigma * size)).T, forces


def _normal_forces(polytope: Polytope) -> tuple[Array, Array]:
    """The unit normal d of the nearest facet and the scaled forces (k, n) at the foot of its perpendicular."""
    nearest = jnp.argmax(jnp.sum(polytope.polar**2, axis=-1))
    a = polytope.polar[nearest]
    corner = polytope.corners[nearest]
    weight = solve(polytope.points[corner].T, (a / jnp.sum(a * a))[:, None])[:, 0]
    weight = jnp.maximum(weight, 0.0)
    weight = weight / jnp.sum(weight)
    return a / jnp.sqrt(jnp.sum(a * a)), jnp.einsum("c,ckn->kn", weight, polytope.labels[corner])


def _search(A: Array, active: Array, internal: Array, norm: str, tolerance: Array) -> _Found:
    """One resistant grasp."""
    outermost = functools.partial(support, A, active, norm)
    axes, forces = _seed(A, internal, active, norm)
    polytope = begin(axes, forces)
    for capacity in CAPACITIES:
        polytope = grow(widen(polytope, capacity), outermost, tolerance, capacity)
    lower, upper, direction = polytope.lower, polytope.upper, polytope.direction
    normal, foot = _normal_forces(polytope)
    near = Touch(normal, foot, jnp.asarray(False))
    touch = weakest_direction(A, norm, near, upper)
    value, _ = extreme_force(A, active, norm, touch.direction)
    # Newton's point, or the nearest facet's own normal and foot; another direction only where neither bounds enough.
    better = (value <= upper) | (lower >= (1 - tolerance) * value)
    upper, direction = jnp.where(better, value, upper), jnp.where(better, touch.direction, direction)
    smooth = touch.sound & better
    used = jnp.any(polytope.polar != 0, axis=-1, keepdims=True)
    facets = jnp.where(used, polytope.corners, -1)
    return _Found(lower, upper, direction, touch.forces, smooth, polytope.labels, facets)


class _Plan(NamedTuple):
    """What is fixed at trace time."""

    norm: str
    certificate: bool


def _solve_rows(plan: _Plan, rows: _Rows, count: Array, tolerance: Array) -> _Found:
    def one(row: _Rows) -> _Found:
        A, active, internal, resistant = (x[0] for x in row)

        def search() -> _Found:
            found = _search(A, active, internal, plan.norm, tolerance)
            if plan.certificate:
                return found
            return found._replace(forces=found.forces[:0], facets=found.facets[:0])

        shapes = jax.eval_shape(search)
        none = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)._replace(
            facets=jnp.full(shapes.facets.shape, -1, shapes.facets.dtype)
        )
        cast = varying_like((row, tolerance))
        found = lax.cond(resistant, lambda: cast(search()), lambda: cast(none))
        return jax.tree.map(lambda x: x[None], found)

    return map_tiles(one, rows, count, 1)


@functools.cache
def _compiled(plan: _Plan) -> Callable[[_Rows, Array], _Found]:
    return jax.jit(batched(functools.partial(_solve_rows, plan), lambda rows: rows.resistant.shape, 1))


@functools.partial(jax.jit, static_argnames=("plan",))
def _solve_chunk(plan: _Plan, rows: _Rows, count: Array, tolerance: Array) -> _Found:
    return _solve_rows(plan, rows, count, tolerance)


def _on_host(plan: _Plan, rows: _Rows, tolerance: Array) -> _Found:
    """Chunks of one shape. Proofs are cut to the longest, so that memory follows what is used."""
    longest = [2 * rows.A.shape[-2], 0]

    def solve(part: _Rows, count: Array) -> _Found:
        found = jax.tree.map(np.asarray, _solve_chunk(plan, part, count, tolerance))
        if plan.certificate:
            for i, used in enumerate(
                (np.any(found.forces != 0, (0, 2, 3)), np.any(found.facets >= 0, (0, 2)))
            ):
                longest[i] = max(longest[i], int(np.flatnonzero(used).max(initial=-1)) + 1)
        return found

    found = in_chunks(solve, rows, rows.resistant.shape, CHUNK)
    return found._replace(
        forces=found.forces[..., : longest[0], :, :], facets=found.facets[..., : longest[1], :]
    )


def _to_components(grasp: Grasp, s: Array) -> Array:
    """Scaled forces (.., k, n), normal first, to (.., k n) in N in the order of the components."""
    index = grasp.model.normal_index(grasp.dimension)
    n = s.shape[-1]
    order = [*range(1, index + 1), 0, *range(index + 1, n)]
    scale = cleared(grasp).model.scaling(grasp.dimension)
    extra = s.ndim - scale.ndim
    scale = jnp.expand_dims(scale, tuple(range(scale.ndim - 2, scale.ndim - 2 + extra)))
    f = s[..., jnp.array(order)] * scale
    return f.reshape(*f.shape[:-2], f.shape[-2] * n)


def epsilon_quality(
    grasp: Grasp,
    *,
    norm: str = "L1",
    torque_scale: Float[ArrayLike, "*batch"] | None = None,
    tolerance: float = 0.01,
    certificate: bool = False,
) -> EpsilonQuality:
    """Ferrari-Canny quality, ``epsilon = max {r : all |w| <= r are G f, f in C, effort(f) <= 1}``, between bounds.

    grasp         a ``Grasp`` with any batch axes; works under ``jax.jit`` and ``jax.vmap``
    norm          effort: "L1", the sum of the normal forces, or "Linf", the largest
    torque_scale  m, a number or one a grasp: torques count as tau / torque_scale. By default the largest distance of a
                  contact from the centre of mass; give the object's radius to compare grasps of one object
    tolerance     ``lower >= (1 - tolerance) upper`` is the goal; the bounds hold wherever the search stops
    certificate   keep the polytope that proves ``lower``, about 30 kB a grasp, for ``check``

    Both bounds have the same derivative, that of epsilon: exact where ``smooth``, one finite choice elsewhere; second
    derivatives do not exist here. Exact friction cones, all contact models.
    Wrong types and names raise ValueError. Sources: Ferrari, Canny 1992; Zheng 2013; Pokorny, Kragic 2013.
    """
    if not isinstance(grasp, Grasp):
        raise ValueError(f"epsilon_quality takes a jaxgrasp.Grasp, got {type(grasp).__name__}")
    if norm not in NORMS:
        raise ValueError(f"norm must be one of {', '.join(NORMS)}, got {norm!r}")
    if isinstance(tolerance, int | float) and not 0 < tolerance < 1:
        raise ValueError(f"tolerance must be between 0 and 1, got {tolerance}")
    length = torque_lengths(grasp, torque_scale)
    A = effort_map(grasp, length)
    still: Any = jax.tree.map(lax.stop_gradient, grasp)
    verdict = wrench_resistance(still)
    resistant = verdict.status == Status.RESISTANT.value
    rows = _Rows(lax.stop_gradient(A), grasp.active, scaled(still, verdict.internal_force), resistant)
    plan = _Plan(norm, bool(certificate))
    goal = jnp.asarray(tolerance, grasp.dtype)
    traced = is_traced((rows, goal))
    found = _compiled(plan)(rows, goal) if traced else _on_host(plan, rows, goal)
    return _answer(grasp, verdict, A, length, found, norm)


@eqx.filter_jit
def _answer(
    grasp: Grasp, verdict: WrenchResistance, A: Array, length: Array, found: _Found, norm: str
) -> EpsilonQuality:
    """Both bounds with the derivative of epsilon; what is known of a grasp that is not resistant."""
    still: Any = jax.tree.map(lax.stop_gradient, grasp)
    resistant = verdict.status == Status.RESISTANT.value
    away = _unresisted(grasp, verdict.escape_twist, lax.stop_gradient(length))
    direction = jnp.where(resistant[..., None], found.direction, away)
    edge = _supports(lax.stop_gradient(A), grasp.active, norm, direction)
    # Where the search ends in a corner both are epsilon, and rounding must not turn them round.
    lower = _bound(verdict.status, jnp.minimum(found.lower, found.upper), jnp.zeros_like(edge))
    upper = _bound(verdict.status, found.upper, edge)
    # d(epsilon) = d . dA f with the touching wrench's d and f held, by the envelope theorem
    moved = jnp.where(resistant[..., None, None, None], A, lax.stop_gradient(A))
    slope = jnp.einsum("...m,...kmn,...kn->...", direction, moved, found.touching)
    change = slope - lax.stop_gradient(slope)
    nan = nan_where(verdict.status == Status.INVALID.value, jnp.zeros_like(edge))[..., None]
    return EpsilonQuality(
        verdict.status,
        lower + change,
        upper + change,
        direction + nan,
        _to_components(still, found.touching) + nan,
        found.smooth,
        _to_components(still, found.forces),
        found.facets,
        lax.stop_gradient(length),
        norm,
    )


def _unresisted(grasp: Grasp, twist: Array, length: Array) -> Array:
    """Where a grasp is not resistant, the unit direction (F; tau / length) that no force pushes along."""
    d = grasp.dimension
    away = -jnp.concatenate([twist[..., :d], twist[..., d:] * length[..., None]], axis=-1)
    size = jnp.sqrt(jnp.sum(away * away, axis=-1, keepdims=True))
    first = jnp.zeros_like(away).at[..., 0].set(1.0)
    return jnp.where(size > 0, away / jnp.where(size > 0, size, 1.0), first)


def _bound(status: Array, inside: Array, outside: Array) -> Array:
    """``inside`` where RESISTANT, 0 where NOT_RESISTANT, NaN where INVALID, else ``outside``."""
    value = jnp.where(status == Status.NOT_RESISTANT.value, 0.0, outside)
    value = jnp.where(status == Status.RESISTANT.value, inside, value)
    return nan_where(status == Status.INVALID.value, value)


@functools.partial(jax.jit, static_argnames=("norm",))
def _supports(A: Array, active: Array, norm: str, direction: Array) -> Array:
    """h(d) of every grasp of the batch."""
    batch = direction.shape[:-1]
    flat = (A.reshape(-1, *A.shape[len(batch) :]), active.reshape(-1, active.shape[-1]))
    value, _ = jax.vmap(lambda a, b, d: extreme_force(a, b, norm, d))(
        *flat, direction.reshape(-1, direction.shape[-1])
    )
    return value.reshape(batch)
