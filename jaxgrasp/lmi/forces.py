"""Grasp force optimisation (11.3) by the road of linear matrix inequalities: every criterion a second time.

Small and general, for teaching and for checking the structured solver: forces are written ``f = f_p + V z`` with
``G f_p = -w`` and V a basis of Null(G), the friction cones are the LMI ``P(f) >= 0`` of (11.14), every limit is a 1 x 1
block, and a primal-dual method does the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from ..contacts import Grasp, TorqueLimits, cleared, grasp_map, is_grasp, length_scale, null_space
from ..core import (
    Answer,
    Array,
    Float,
    Int,
    Status,
    gap_goal,
    nan_where,
    rank_tolerance,
    real_array,
    spread,
    wrench_dimension,
)
from ..forces import Criterion
from .feasibility import feasibility
from .friction import friction_lmi
from .primal_dual import minimize
from .problem import LMIProblem, LogDetTerm, bracket_words

__all__ = ["LMIForces", "lmi_forces"]


class LMIForces(Answer):
    """``lower <= min h <= upper``: contact forces and how far from optimal they can be.

    status  (*batch) int32, a ``Status``: OPTIMAL; STALLED, a strictly feasible force was found but the gap did not
            close; INFEASIBLE, the load is proved to have no feasible force; MARGINAL and UNDECIDED, neither was shown;
            INVALID
    force   (*batch, k n)  in N (torques N m), chapter's component order; NaN where none was found
    upper   (*batch)       the criterion at ``force``; infinite where INFEASIBLE, NaN where there is no force
    lower   (*batch)       no feasible force costs less
    """

    status: Int[Array, "*batch"]
    force: Float[Array, "*batch kn"]
    upper: Float[Array, "*batch"]
    lower: Float[Array, "*batch"]

    SENTENCES: ClassVar[Mapping[Status, str]] = {
        Status.OPTIMAL: "Optimal: the forces lie strictly inside every cone and limit, and the bound proves the cost.",
        Status.INFEASIBLE: "Infeasible: no admissible forces balance the load, and the multipliers prove it.",
        Status.MARGINAL: "Marginal: no forces lie inside cones and limits by more than the tolerance.",
        Status.INVALID: "Invalid: the numbers are not a grasp with a load, a criterion and limits.",
    }

    @property
    def gap(self) -> Float[Array, "*batch"]:
        """``upper - lower``: no feasible force is cheaper by more; 0 where INFEASIBLE."""
        return jnp.where(jnp.isinf(self.upper), 0.0, self.upper - self.lower)

    def values(self, index: int | tuple[int, ...] = ()) -> str:
        """The bracket of one lane's cost in words."""
        return bracket_words("Cost", self.lower, self.upper, index)


def lmi_forces(
    grasp: Grasp,
    wrench: Float[ArrayLike, "*batch m"],
    *,
    criterion: Criterion,
    max_normal: Float[ArrayLike, "*batch k"] | None = None,
    torque_limits: TorqueLimits
    | tuple[Float[ArrayLike, "*batch kn q"], Float[ArrayLike, "*batch q"]]
    | None = None,
    tolerance: float = 1e-8,
) -> LMIForces:
    """``min h(f)  subject to  P(f) >= 0,  G f + wrench = 0,  f_n <= max_normal,  |J^T f| <= tau_max`` (Definition 5).

    wrench         (*batch, *loads, m), (m,) for all grasps, or any leading axes for a single grasp; N and N m
    criterion      Gentlest(), Robust(), SmallestSum(), SumOfSquares(), LeastNorm(): h
    max_normal     a number or what broadcasts to (*batch, k), in N; optional
    torque_limits  (J, tau_max): J (*batch, k n, q) or (k n, q), tau_max (*batch, q) or (q,) in N m, or a
                   ``TorqueLimits``, whose J may be in body or world axes; optional

    An LMI feasibility problem finds the start; ``lmi_minimize`` takes it from there to a gap of
    ``tolerance * max(1, |h|)`` in units of the load. A second road: for small problems, one after another. Wrong
    shapes and types raise ValueError.
    """
    if not isinstance(criterion, Criterion):
        raise ValueError(f"criterion must be one such as jaxgrasp.Gentlest(), got {criterion!r}")
    batch, dtype = grasp.batch_shape, grasp.dtype
    wrench = _load(grasp, wrench)
    limit = None
    if max_normal is not None:
        limit = spread(
            real_array(max_normal, "max_normal").astype(dtype), (grasp.contacts,), batch, "max_normal"
        )
    torques = None
    if isinstance(torque_limits, TorqueLimits):
        torque_limits = torque_limits.in_contact_axes(grasp)
    if torque_limits is not None:
        J, largest = torque_limits
        J = real_array(J, "J of torque_limits")
        if J.ndim < 2:
            raise ValueError(f"J of torque_limits must have shape (*batch, k n, q), got {J.shape}")
        rows = grasp.contacts * grasp.model.force_size(grasp.dimension)
        J = spread(J.astype(dtype), (rows, J.shape[-1]), batch, "J of torque_limits")
        largest = real_array(largest, "tau_max of torque_limits").astype(dtype)
        torques = J, spread(largest, J.shape[-1:], batch, "tau_max of torque_limits")
    criterion = jax.tree.map(
        lambda x: spread(x.astype(dtype), (), batch, "the criterion's weight"), criterion
    )
    return _solve(grasp, wrench, criterion, limit, torques, tolerance)


def _load(grasp: Grasp, wrench) -> Array:
    """(*batch, *loads, m)."""
    batch, m = grasp.batch_shape, wrench_dimension(grasp.dimension)
    array = real_array(wrench, "wrench")
    if array.ndim == 1 and array.shape == (m,):
        return jnp.broadcast_to(array.astype(grasp.dtype), (*batch, m))
    if (
        array.ndim < 1
        or array.shape[-1] != m
        or array.shape[: len(batch)] != batch
        or array.ndim <= len(batch)
    ):
        raise ValueError(
            f"wrench must have shape (*batch, *loads, {m}) with batch {batch}, or ({m},), got {array.shape}"
        )
    return array.astype(grasp.dtype)


@eqx.filter_jit
def _solve(grasp: Grasp, wrench, criterion, limit, torques, tolerance: float) -> LMIForces:
    axes = len(grasp.batch_shape)
    loads = wrench.shape[axes:-1]
    goal = gap_goal(tolerance, grasp.dtype)

    def flat(leaf: Array) -> Array:
        return leaf.reshape(-1, *leaf.shape[axes:])

    # One after another, see primal_dual.minimize.
    optimize = jax.custom_batching.sequential_vmap(_optimize)

    def one_grasp(parts, rows: Array) -> LMIForces:
        return jax.vmap(lambda row: optimize(*parts, row, goal))(rows)

    lanes = jax.tree.map(flat, (grasp, criterion, limit, torques))
    rows = wrench.reshape(math.prod(grasp.batch_shape), math.prod(loads), wrench.shape[-1])
    out = jax.vmap(one_grasp)(lanes, rows)
    return jax.tree.map(lambda leaf: leaf.reshape(*grasp.batch_shape, *loads, *leaf.shape[2:]), out)


# One grasp, one load -----------------------------------------------------------------------------------


class _Reduced(eqx.Module):
    """The constraints in z, ``f = size (f_p + V z)`` with ``G f = -w``: an LMI and rows ``g + H z >= 0``."""

    size: Array  # of the load; 1 where there is none
    particular: Array  # f_p
    V: Array
    rest: Array  # |G f_p + w| / size
    constant: Array  # P(f) / size = constant + sum_j z_j matrices_j
    matrices: Array
    g: Array
    H: Array

    def force(self, z: Array) -> Array:
        return self.particular + self.V @ z


def _optimize(grasp: Grasp, criterion: Criterion, limit, torques, wrench: Array, goal: Array) -> LMIForces:
    reduced = _reduce(grasp, limit, torques, wrench)
    phase = feasibility(*_with_rows(reduced.constant, reduced.matrices, reduced.g, reduced.H), goal)
    start = nan_where(phase.status != Status.FEASIBLE.value, phase.x)
    problem, scale, offset = _problem(grasp, criterion, reduced, start)
    end = minimize(problem, goal)

    force = reduced.size * reduced.force(end.x[: reduced.V.shape[1]])
    valid = is_grasp(grasp) & jnp.all(jnp.isfinite(wrench))
    status = jnp.where(phase.status == Status.FEASIBLE.value, end.status, phase.status)
    status = jnp.where(reduced.rest > goal, Status.INFEASIBLE.value, status)
    status = jnp.where(valid, status, Status.INVALID.value).astype(jnp.int32)
    found = (status == Status.OPTIMAL.value) | (status == Status.STALLED.value)
    without = jnp.where(found, 0.0, jnp.inf)
    without = nan_where(~found & (status != Status.INFEASIBLE.value), without)
    return LMIForces(
        status=status,
        force=nan_where(~found, force),
        upper=jnp.where(found, criterion.cost(grasp, force), without),
        lower=jnp.where(found, scale * end.lower + offset, without),
    )


def _reduce(grasp: Grasp, limit, torques, wrench: Array) -> _Reduced:
    """``f_p`` is the least force with ``G f = -w`` along the components that exist; ranks as in ``null_space``."""
    per_length = jnp.where(jnp.arange(len(wrench)) < grasp.dimension, 1.0, 1 / length_scale(grasp))
    per_length = per_length.astype(grasp.dtype)
    load = wrench * per_length
    size = jnp.linalg.norm(load)
    size = jnp.where(size > 0, size, 1.0)
    scaling = jnp.where(grasp.active[:, None], cleared(grasp).model.scaling(grasp.dimension), 0.0)
    exists = scaling.reshape(-1) != 0  # components with coefficient 0 stay exactly 0
    G = jnp.where(exists, grasp_map(grasp), 0.0) * per_length[:, None]
    left, values, right = jnp.linalg.svd(G, full_matrices=False)
    kept = values > rank_tolerance(grasp.dtype) * jnp.maximum(values[0], 1.0)
    particular = -right.T @ jnp.where(kept, left.T @ (load / size) / jnp.where(kept, values, 1.0), 0.0)
    particular = jnp.where(exists, particular, 0.0)
    V, cones = jnp.where(exists[:, None], null_space(grasp), 0.0), friction_lmi(grasp)
    return _Reduced(
        size,
        particular,
        V,
        jnp.linalg.norm(G @ particular + load / size),
        cones.P(particular),
        cones.reduced(V),
        *_limits(grasp, limit, torques, size, particular, V),
    )


def _limits(grasp: Grasp, limit, torques, size: Array, particular: Array, V: Array) -> tuple[Array, Array]:
    """Rows of ``g + H z >= 0``: ``max_normal >= f_n`` and ``tau_max >= +-J^T f``. An infinite limit is 1 >= 0."""
    bounds, rows, none = [], [], []
    if limit is not None:
        bounds.append(limit)
        rows.append(jnp.eye(len(particular), dtype=V.dtype)[_normal_entries(grasp)])
        none.append(jnp.isposinf(limit) | ~grasp.active)
    if torques is not None:
        J, largest = torques
        bounds += [largest, largest]
        rows += [J.T, -J.T]
        none += [jnp.isposinf(largest)] * 2
    if not bounds:
        return jnp.zeros(0, V.dtype), jnp.zeros((0, V.shape[1]), V.dtype)
    row, free = jnp.concatenate(rows), jnp.concatenate(none)
    g = jnp.where(free, 1.0, jnp.concatenate(bounds) / size - row @ particular)
    H = jnp.where(free[:, None], 0.0, -row @ V)
    length = jnp.abs(g) + jnp.linalg.norm(H, axis=1)
    length = jnp.where(length > 0, length, 1.0)
    return g / length, H / length[:, None]


def _normal_entries(grasp: Grasp) -> slice:
    return slice(grasp.model.normal_index(grasp.dimension), None, grasp.model.force_size(grasp.dimension))


def _with_rows(constant: Array, matrices: Array, g: Array, H: Array) -> tuple[Array, Array]:
    """The LMI with ``g + H z >= 0`` as further 1 x 1 blocks."""
    q, r = len(constant), len(g)
    total = jnp.zeros((1 + H.shape[1], q + r, q + r), constant.dtype)
    total = total.at[:, :q, :q].set(jnp.concatenate([constant[None], matrices]))
    index = q + jnp.arange(r)
    total = total.at[:, index, index].set(jnp.concatenate([g[None], H.T]))
    return total[0], total[1:]


def _problem(
    grasp: Grasp, criterion: Criterion, reduced: _Reduced, z: Array
) -> tuple[LMIProblem, Array, Array]:
    """The LMI problem from the strictly feasible z, and (scale, offset): the cost is ``scale * value + offset``."""
    if criterion.level:
        return _level_problem(grasp, criterion, reduced, z)

    def cost(force: Array) -> Array:
        return criterion.cost(grasp, force)

    # Linear or quadratic: the criterion is its own Taylor polynomial at the particular force.
    V, size = reduced.V, reduced.size
    slope = V.T @ jax.grad(cost)(reduced.particular)
    curvature = None if criterion.price else V.T @ jax.hessian(cost)(reduced.particular) @ V
    scale = size if criterion.price else size * size
    lmi = _with_rows(reduced.constant, reduced.matrices, reduced.g, reduced.H)
    return LMIProblem(slope, *lmi, z, curvature), scale, scale * cost(reduced.particular)


def _level_problem(
    grasp: Grasp, criterion: Criterion, reduced: _Reduced, z: Array
) -> tuple[LMIProblem, Array, Array]:
    """One more variable, ``xi >= f_n,i``, and -log det P where the criterion counts it."""
    normal, active, size = _normal_entries(grasp), grasp.active, reduced.size
    g = jnp.concatenate([reduced.g, jnp.where(active, -reduced.particular[normal], 1.0)])
    H = jnp.concatenate([reduced.H, jnp.where(active[:, None], -reduced.V[normal], 0.0)])
    on_level = jnp.concatenate([jnp.zeros_like(reduced.g), active.astype(g.dtype)])
    H = jnp.concatenate([H, on_level[:, None]], axis=1)
    constant = reduced.constant
    matrices = jnp.concatenate([reduced.matrices, jnp.zeros_like(constant)[None]])
    top = jnp.max(jnp.where(active, reduced.force(z)[normal], -jnp.inf))
    start = jnp.append(z, top + 1.0)
    cost = jnp.zeros_like(start).at[-1].set(1.0)

    log_det, offset = None, jnp.zeros_like(size)
    if criterion.barrier_weight is not None:
        on_normal, on_cone, _ = cleared(grasp).model.log_det_terms(grasp.dimension)
        counted = _counted(on_cone, len(constant))
        log_det = LogDetTerm(
            criterion.barrier_weight / size,
            jnp.where(counted, constant, jnp.eye(len(constant), dtype=g.dtype)),
            jnp.where(counted, matrices, 0.0),
        )
        degree = jnp.sum(jnp.where(active, on_normal + 2 * on_cone, 0.0))
        offset = -criterion.barrier_weight * degree * jnp.log(size)
    lmi = _with_rows(constant, matrices, g, H)
    return LMIProblem(cost, *lmi, start, log_det=log_det), size, offset


def _counted(on_cone: Array, order: int) -> Array:
    """Entries of P that its log det counts: whole blocks, but of a contact without friction f_n alone, once."""
    entries = (on_cone[:, None] > 0) | (jnp.arange(order // len(on_cone)) == 0)
    entries = entries.reshape(-1)
    return entries[:, None] & entries[None, :]
