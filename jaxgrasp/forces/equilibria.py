"""Definition 2 and Figure 11.1: can a grasp balance a load, with forces to spare, and how hard must it squeeze?"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer

from ..contacts import Grasp, folded_grasp_map, length_scale
from ..core import Array, Bool, Float, Int, SpokenEnum, Status, rank_tolerance
from ..resistance import wrench_resistance
from .criteria import Criterion, Gentlest, Robust, SmallestSum
from .solve import ForceOptimum, optimize_forces, spread_loads

__all__ = [
    "Equilibrium",
    "EquilibriumKind",
    "ResistibleWrenches",
    "Squeeze",
    "equilibrium",
    "resistible_wrenches",
    "squeeze",
]


class EquilibriumKind(SpokenEnum):
    """The three answers of Definition 2, and the two that admit there is none."""

    NONE = 1, "No equilibrium: no admissible forces balance the load; the escape twist proves it."
    MARGINAL = (
        2,
        "Marginal equilibrium: forces balance the load, but some contact is at the edge of its friction cone.",
    )
    NON_MARGINAL = 3, "Non-marginal equilibrium: forces strictly inside every friction cone balance the load."
    UNDECIDED = 4, "Undecided: the solver stopped before it had a proof either way."
    INVALID = 5, "Invalid: the numbers are not a grasp with a load."


class Equilibrium(eqx.Module):
    """The kind of equilibrium of each grasp under its load, and the evidence.

    kind          int32, an ``EquilibriumKind``
    force         (*batch, k n) N: balances the load inside the cones (on their edge where MARGINAL); zero where NONE
    slack         (*batch) N: ``min_i f_n,i - psi_i(f_i)`` of ``force``; minus infinity where NONE
    escape_twist  (*batch, m): the proof of NONE; else zero
    """

    kind: Int[Array, "*batch"]
    force: Float[Array, "*batch kn"]
    slack: Float[Array, "*batch"]
    escape_twist: Float[Array, "*batch m"]


def _slack(grasp: Grasp, force: Array) -> Array:
    n, loads = grasp.model.force_size(grasp.dimension), force.ndim - 1 - len(grasp.batch_shape)
    wide = _with_load_axes(grasp, loads)
    slack = wide.model.feasibility_slack(force.reshape(*force.shape[:-1], -1, n), grasp.dimension)
    return jnp.min(jnp.where(wide.active, slack, jnp.inf), axis=-1)


def _with_load_axes(grasp: Grasp, loads: int) -> Grasp:
    """The grasp with ``loads`` axes of length 1 after its batch axes."""
    axes = tuple(range(len(grasp.batch_shape), len(grasp.batch_shape) + loads))

    def widen(x: Array) -> Array:
        return jnp.expand_dims(x, axes)

    model = grasp.model.with_coefficients(
        widen(grasp.model.friction_coefficient), widen(grasp.model.torsion_coefficient)
    )
    return Grasp(widen(grasp.position), widen(grasp.normal), model, widen(grasp.active))


def equilibrium(grasp: Grasp, wrench: Float[Array, "*batch m"], tolerance: float = 1e-8) -> Equilibrium:
    """None, marginal or non-marginal (Definition 2): ``G f + wrench = 0`` with f in, or strictly inside, the cones.

    ``wrench`` as for ``optimize_forces``; zero asks for equilibria without a load, of which f = 0 is a marginal one.
    NON_MARGINAL is proven by its force, the robust optimum, which exists iff some force is strictly inside; NONE by an
    escape twist. MARGINAL means that forces exist and the search for one strictly inside failed.
    """
    robust = optimize_forces(grasp, wrench, Robust(_weights(grasp, wrench)), tolerance=tolerance)
    inside = (robust.status == Status.OPTIMAL.value) & (_slack(grasp, robust.force) > 0)
    decided = inside | (robust.status == Status.INFEASIBLE.value) | (robust.status == Status.INVALID.value)
    edge = robust
    if isinstance(decided, Tracer) or not bool(jnp.all(decided)):
        edge = optimize_forces(grasp, wrench, SmallestSum(), tolerance=tolerance)
    kind = jnp.full(robust.status.shape, EquilibriumKind.UNDECIDED.value, jnp.int32)

    def choose(value: EquilibriumKind, where: Array, otherwise: Array) -> Array:
        return jnp.where(where, jnp.int32(value.value), otherwise)

    kind = choose(EquilibriumKind.MARGINAL, edge.status == Status.OPTIMAL.value, kind)
    none = (robust.status == Status.INFEASIBLE.value) | (edge.status == Status.INFEASIBLE.value)
    kind = choose(EquilibriumKind.NONE, none, kind)
    kind = choose(EquilibriumKind.NON_MARGINAL, inside, kind)
    kind = choose(EquilibriumKind.INVALID, robust.status == Status.INVALID.value, kind)
    force = jnp.where(inside[..., None], robust.force, edge.force)
    slack = jnp.where(kind == EquilibriumKind.NONE.value, -jnp.inf, _slack(grasp, force))
    escape = jnp.where(
        (robust.status == Status.INFEASIBLE.value)[..., None], robust.escape_twist, edge.escape_twist
    )
    return Equilibrium(kind, force, slack, escape)


def _weights(grasp: Grasp, wrench: Any) -> Array:
    """A robust weight of the load's own size, so that the answer does not depend on the unit of force."""
    loads, shape = spread_loads(grasp, wrench)
    d = grasp.dimension
    length = length_scale(grasp).reshape(*grasp.batch_shape, *([1] * (len(shape) - len(grasp.batch_shape))))
    scaled = jnp.concatenate([loads[..., :d], loads[..., d:] / length[..., None]], axis=-1)
    size = jnp.sqrt(jnp.sum(scaled * scaled, axis=-1))
    return jnp.where(size > 0, size, jnp.ones_like(size))


class Squeeze(eqx.Module):
    """``f_p + s f_int`` (11.2): the least squeeze that brings a particular solution into the friction cones.

    effort            (*batch) s_min, the mean normal force of the squeeze in N; infinite where squeezing cannot help
    force             (*batch, k n) N: ``particular + effort * internal``; zero where effort is infinite
    particular        (*batch, k n) N: f_p, balances the load, may pull or slide
    internal          (*batch, k n): f_int, mean normal force 1, strictly inside the cones, no net wrench
    """

    effort: Float[Array, "*batch"]
    force: Float[Array, "*batch kn"]
    particular: Float[Array, "*batch kn"]
    internal: Float[Array, "*batch kn"]


def squeeze(grasp: Grasp, wrench: Float[Array, "*batch m"]) -> Squeeze:
    """``s_min = min s >= 0  subject to  f_p + s f_int in C``: (11.2), Figure 11.1, Prop. 11.5.1.

    f_int is the internal force of the margin (``wrench_resistance``), f_p the solution of ``G f + wrench = 0`` of least
    norm in folded forces (f_t / mu, f_n, tau / gamma). Each contact gives a quadratic in s, and s_min is the largest
    root. Normal forces then grow in proportion to the squeeze. ``optimize_forces`` needs no more force than this.
    """
    loads, shape = spread_loads(grasp, wrench)
    verdict = wrench_resistance(grasp)
    batch, extra = len(grasp.batch_shape), len(shape) - len(grasp.batch_shape)
    k, n, d = grasp.contacts, grasp.model.force_size(grasp.dimension), grasp.dimension
    axes = tuple(range(batch, batch + extra))

    length = length_scale(grasp)[..., None]
    per_length = jnp.concatenate([jnp.ones_like(length)] * d + [1 / length] * (loads.shape[-1] - d), axis=-1)
    A = jnp.expand_dims(per_length[..., None] * folded_grasp_map(grasp), axes)
    scaled_load = loads * jnp.expand_dims(per_length, axes)
    cut = rank_tolerance(grasp.dtype)
    least = -jnp.einsum("...ij,...j->...i", jnp.linalg.pinv(A, rtol=cut), scaled_load)
    missing = jnp.einsum("...ij,...j->...i", A, least) + scaled_load
    balanced = jnp.sqrt(jnp.sum(missing * missing, -1)) <= 1e-9 * jnp.sqrt(jnp.sum(scaled_load**2, -1))

    scale = jnp.expand_dims(grasp.model.scaling(d), axes)
    index = grasp.model.normal_index(d)
    p = least.reshape(*shape, k, n)
    internal = jnp.expand_dims(verdict.internal_force, axes).reshape(*scale.shape[:-2], k, n)
    q = jnp.where(scale > 0, internal / jnp.where(scale > 0, scale, 1.0), 0.0)

    def form(a: Array, b: Array) -> Array:
        products = a * b
        return 2 * products[..., index] - jnp.sum(products, axis=-1)

    leading, middle, rest = form(q, q), form(p, q), form(p, p)
    live = jnp.expand_dims(grasp.active, axes)
    strict = jnp.where(live, (leading > 0) & (q[..., index] > 0), True)
    usable = jnp.all(strict, axis=-1) & balanced
    root = jnp.sqrt(jnp.maximum(middle * middle - leading * rest, 0.0))
    safe = jnp.where(leading > 0, leading, 1.0)
    effort = jnp.max(jnp.where(live, (root - middle) / safe, 0.0), axis=-1)
    effort = jnp.where(usable, jnp.maximum(effort, 0.0), jnp.inf)

    particular = (p * scale).reshape(*shape, k * n)
    flat = jnp.broadcast_to(internal, p.shape).reshape(*shape, k * n)
    finite = usable[..., None]
    force = jnp.where(finite, particular + jnp.where(usable, effort, 0.0)[..., None] * flat, 0.0)
    return Squeeze(effort, force, particular, flat)


class ResistibleWrenches(eqx.Module):
    """Which of a set of T wrenches each grasp can hold, and with how little force.

    held     (*batch, T) bool: OPTIMAL forces were found        optimum  the ``ForceOptimum`` of every wrench
    share    (*batch) of the wrenches that are held             cost     (*batch, T); infinite where not held
    worst    (*batch) int32: the wrench that costs most, or one that cannot be held
    """

    held: Bool[Array, "*batch T"]
    optimum: ForceOptimum

    @property
    def cost(self) -> Float[Array, "*batch T"]:
        return jnp.where(self.held, self.optimum.cost, jnp.inf)

    @property
    def share(self) -> Float[Array, "*batch"]:
        return jnp.mean(self.held.astype(self.optimum.cost.dtype), axis=-1)

    @property
    def worst(self) -> Int[Array, "*batch"]:
        return jnp.argmax(self.cost, axis=-1).astype(jnp.int32)


def resistible_wrenches(
    grasp: Grasp,
    wrenches: Float[Array, "*batch T m"],
    criterion: Criterion | None = None,
    max_normal: Any = None,
    torque_limits: tuple[Any, Any] | None = None,
    tolerance: float = 1e-8,
) -> ResistibleWrenches:
    """Which task wrenches can be held, and with how little force: ``min h(f)`` subject to ``G f + w_j = 0``, f in C.

    ``wrenches`` (T, m) go to every grasp, (*batch, T, m) to their own. Criterion (``Gentlest()`` by default), limits
    and tolerance as for ``optimize_forces``; every answer carries its proof in ``.optimum``.
    """
    array = jnp.asarray(wrenches)
    if array.ndim < 2:
        raise ValueError(f"wrenches must have shape (T, m) or (*batch, T, m), got {array.shape}")
    if array.ndim == 2:
        array = jnp.broadcast_to(array, (*grasp.batch_shape, *array.shape))
    criterion = Gentlest() if criterion is None else criterion
    optimum = optimize_forces(grasp, array, criterion, max_normal, torque_limits, tolerance)
    return ResistibleWrenches(optimum.status == Status.OPTIMAL.value, optimum)
