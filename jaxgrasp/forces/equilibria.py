"""Definition 2 and Figure 11.1: can a grasp balance a load, with forces to spare, and how hard must it squeeze?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer
from jax.typing import ArrayLike

from ..conic import pseudo_inverse
from ..contacts import Grasp, TorqueLimits, cleared, folded_grasp_map, length_scale
from ..core import (
    Answer,
    Array,
    Bool,
    Float,
    Int,
    Status,
    first_of,
    largest_of,
    least_of,
    rank_tolerance,
    real_array,
    safe_root,
)
from ..resistance import wrench_resistance
from .criteria import Criterion, Gentlest, Robust, SmallestSum
from .demand import spread_loads
from .solve import OptimalForces, optimize_forces

__all__ = [
    "Equilibrium",
    "ResistibleWrenches",
    "Squeeze",
    "equilibrium",
    "resistible_wrenches",
    "squeeze",
]


class Equilibrium(Answer):
    """The kind of equilibrium of each grasp under its load (Definition 2), and the evidence.

    status        int32, a ``Status``: NON_MARGINAL, MARGINAL, NO_EQUILIBRIUM, UNDECIDED or INVALID
    force         (*batch, k n) N: balances the load inside the cones (on their edge where MARGINAL); zero where there
                  is NO_EQUILIBRIUM
    slack         (*batch) N: ``min_i f_n,i - psi_i(f_i)`` of ``force``; minus infinity where NO_EQUILIBRIUM
    escape_twist  (*batch, m): the proof of NO_EQUILIBRIUM; else zero
    """

    status: Int[Array, "*batch"]
    force: Float[Array, "*batch kn"]
    slack: Float[Array, "*batch"]
    escape_twist: Float[Array, "*batch m"]

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.MARGINAL: "Marginal equilibrium: forces balance the load, but some contact is at the edge of its "
        "friction cone.",
        Status.NO_EQUILIBRIUM: "No equilibrium: no admissible forces balance the load; the escape twist proves it.",
        Status.INVALID: "Invalid: the numbers are not a grasp with a load.",
    }


@eqx.filter_jit
def _slack(grasp: Grasp, force: Array) -> Array:
    n, loads = grasp.model.force_size(grasp.dimension), force.ndim - 1 - len(grasp.batch_shape)
    wide = _with_load_axes(cleared(grasp), loads)
    slack = wide.model.feasibility_slack(force.reshape(*force.shape[:-1], -1, n), grasp.dimension)
    return least_of(jnp.where(wide.active, slack, jnp.inf))


def _with_load_axes(grasp: Grasp, loads: int) -> Grasp:
    """The grasp with ``loads`` axes of length 1 after its batch axes."""
    axes = tuple(range(len(grasp.batch_shape), len(grasp.batch_shape) + loads))

    def widen(x: Array) -> Array:
        return jnp.expand_dims(x, axes)

    model = grasp.model.with_coefficients(
        widen(grasp.model.friction_coefficient), widen(grasp.model.torsion_coefficient)
    )
    return Grasp(widen(grasp.position), widen(grasp.normal), model, widen(grasp.active))


def equilibrium(
    grasp: Grasp, wrench: Float[ArrayLike, "*batch m"], *, tolerance: float = 1e-8
) -> Equilibrium:
    """None, marginal or non-marginal (Definition 2): ``G f + wrench = 0`` with f in, or strictly inside, the cones.

    ``wrench`` as for ``optimize_forces``; zero asks for equilibria without a load, of which f = 0 is a marginal one.
    NON_MARGINAL is proven by its force, the robust optimum, which exists iff some force is strictly inside;
    NO_EQUILIBRIUM by an escape twist. MARGINAL means that forces exist and the search for one strictly inside failed.
    """
    robust = optimize_forces(grasp, wrench, criterion=Robust(_weights(grasp, wrench)), tolerance=tolerance)
    inside = (robust.status == Status.OPTIMAL.value) & (_slack(grasp, robust.force) > 0)
    decided = inside | (robust.status == Status.INFEASIBLE.value) | (robust.status == Status.INVALID.value)
    edge = robust
    if isinstance(decided, Tracer) or not bool(jnp.all(decided)):
        edge = optimize_forces(grasp, wrench, criterion=SmallestSum(), tolerance=tolerance)
    return _equilibrium(grasp, inside, robust, edge)


@eqx.filter_jit
def _equilibrium(grasp: Grasp, inside: Array, robust: OptimalForces, edge: OptimalForces) -> Equilibrium:
    """What the robust optimum says, and the least forces where it says nothing; ``inside``: its forces are."""
    refuted = robust.status == Status.INFEASIBLE.value
    status = first_of(
        [
            (robust.status == Status.INVALID.value, Status.INVALID),
            (inside, Status.NON_MARGINAL),
            (refuted | (edge.status == Status.INFEASIBLE.value), Status.NO_EQUILIBRIUM),
            (edge.status == Status.OPTIMAL.value, Status.MARGINAL),
        ],
        Status.UNDECIDED,
    )
    force = jnp.where(inside[..., None], robust.force, edge.force)
    slack = jnp.where(status == Status.NO_EQUILIBRIUM.value, -jnp.inf, _slack(grasp, force))
    escape = jnp.where(refuted[..., None], robust.escape_twist, edge.escape_twist)
    return Equilibrium(status, force, slack, escape)


def _weights(grasp: Grasp, wrench: Any) -> Array:
    """A robust weight of the load's own size, so that the answer does not depend on the unit of force."""
    loads, shape = spread_loads(grasp, wrench)
    d = grasp.dimension
    length = length_scale(grasp).reshape(*grasp.batch_shape, *([1] * (len(shape) - len(grasp.batch_shape))))
    scaled = jnp.concatenate([loads[..., :d], loads[..., d:] / length[..., None]], axis=-1)
    size = jnp.sqrt(jnp.sum(scaled * scaled, axis=-1))
    return jnp.where(size > 0, size, jnp.ones_like(size))


class Squeeze(Answer):
    """``f_p + s f_int`` (11.2): the least squeeze that brings a particular solution into the friction cones.

    status            int32, a ``Status``: OPTIMAL, INFEASIBLE where no squeeze helps, INVALID
    effort            (*batch) s_min, the mean normal force of the squeeze in N; infinite where squeezing cannot help
    force             (*batch, k n) N: ``particular + effort * internal``; zero where effort is infinite
    particular        (*batch, k n) N: f_p, balances the load, may pull or slide
    internal          (*batch, k n): f_int, mean normal force 1, strictly inside the cones, no net wrench
    """

    status: Int[Array, "*batch"]
    effort: Float[Array, "*batch"]
    force: Float[Array, "*batch kn"]
    particular: Float[Array, "*batch kn"]
    internal: Float[Array, "*batch kn"]

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.OPTIMAL: "Held: squeezing along the internal force brings every contact into its friction cone.",
        Status.INFEASIBLE: "Not held: no squeeze along the internal force brings every contact into its friction cone.",
        Status.INVALID: "Invalid: the numbers are not a grasp with a load.",
    }


def squeeze(grasp: Grasp, wrench: Float[ArrayLike, "*batch m"]) -> Squeeze:
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
    least = -jnp.einsum("...ij,...j->...i", pseudo_inverse(A, cut), scaled_load)
    missing = jnp.einsum("...ij,...j->...i", A, least) + scaled_load
    balanced = jnp.sqrt(jnp.sum(missing * missing, -1)) <= 1e-9 * jnp.sqrt(jnp.sum(scaled_load**2, -1))

    scale = jnp.expand_dims(cleared(grasp).model.scaling(d), axes)
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
    root = safe_root(middle * middle - leading * rest)
    safe = jnp.where(leading > 0, leading, 1.0)
    effort = largest_of(jnp.where(live, (root - middle) / safe, 0.0))
    effort = jnp.where(usable, jnp.maximum(effort, 0.0), jnp.inf)

    particular = (p * scale).reshape(*shape, k * n)
    flat = jnp.broadcast_to(internal, p.shape).reshape(*shape, k * n)
    finite = usable[..., None]
    force = jnp.where(finite, particular + jnp.where(usable, effort, 0.0)[..., None] * flat, 0.0)
    sound = jnp.expand_dims(verdict.status != Status.INVALID.value, axes) & jnp.all(
        jnp.isfinite(loads), axis=-1
    )
    held = jnp.where(usable, jnp.int32(Status.OPTIMAL.value), jnp.int32(Status.INFEASIBLE.value))
    status = jnp.where(sound, held, jnp.int32(Status.INVALID.value))
    return Squeeze(status, effort, force, particular, flat)


class ResistibleWrenches(Answer):
    """Which of a set of T wrenches each grasp can hold, and with how little force.

    status   (*batch, T) int32, a ``Status``: OPTIMAL where the wrench can be held
    forces   the ``OptimalForces`` of every wrench, with their proofs
    """

    status: Int[Array, "*batch T"]
    forces: OptimalForces

    SENTENCES: ClassVar[Mapping[Status, str]] = OptimalForces.SENTENCES

    @property
    def held(self) -> Bool[Array, "*batch T"]:
        """Whether optimal forces for this wrench were found."""
        return self.status == Status.OPTIMAL.value

    @property
    def cost(self) -> Float[Array, "*batch T"]:
        """The criterion at the optimal forces; infinite where the wrench is not held."""
        return jnp.where(self.held, self.forces.cost, jnp.inf)

    @property
    def share(self) -> Float[Array, "*batch"]:
        """The part of the T wrenches that are held, 0 to 1."""
        return jnp.mean(self.held.astype(self.forces.cost.dtype), axis=-1)

    @property
    def worst(self) -> Int[Array, "*batch"]:
        """The wrench that costs most, or one that cannot be held."""
        return jnp.argmax(self.cost, axis=-1).astype(jnp.int32)


def resistible_wrenches(
    grasp: Grasp,
    wrenches: Float[ArrayLike, "*batch T m"],
    *,
    criterion: Criterion | None = None,
    max_normal: Float[ArrayLike, "*batch k"] | None = None,
    torque_limits: TorqueLimits
    | tuple[Float[ArrayLike, "*batch kn q"], Float[ArrayLike, "*batch q"]]
    | None = None,
    tolerance: float = 1e-8,
) -> ResistibleWrenches:
    """Which task wrenches can be held, and with how little force: ``min h(f)`` subject to ``G f + w_j = 0``, f in C.

    ``wrenches`` (T, m) go to every grasp, (*batch, T, m) to their own. Criterion (``Gentlest()`` by default), limits
    and tolerance as for ``optimize_forces``; every answer carries its proof in ``.forces``.
    """
    array = real_array(wrenches, "wrenches")
    if array.ndim < 2:
        raise ValueError(f"wrenches must have shape (T, m) or (*batch, T, m), got {array.shape}")
    if array.ndim == 2:
        array = jnp.broadcast_to(array, (*grasp.batch_shape, *array.shape))
    criterion = Gentlest() if criterion is None else criterion
    forces = optimize_forces(
        grasp,
        array,
        criterion=criterion,
        max_normal=max_normal,
        torque_limits=torque_limits,
        tolerance=tolerance,
    )
    return ResistibleWrenches(forces.status, forces)
