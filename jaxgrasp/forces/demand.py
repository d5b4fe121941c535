"""What is asked of each grasp, spread over all problems: loads, limits and weights."""

from __future__ import annotations

from typing import Any

import jax

from ..contacts import Contacts, Grasp, TorqueLimits, cleared, contacts_of
from ..core import Array, real_array, spread, widened, wrench_dimension
from .criteria import Criterion
from .problem import Demand

__all__ = ["demand_rows", "spread_loads"]


def spread_loads(grasp: Grasp, wrench: Any) -> tuple[Array, tuple[int, ...]]:
    """The wrench with all batch axes, and those axes: the grasp's, then any load axes."""
    m, batch = wrench_dimension(grasp.dimension), grasp.batch_shape
    array = real_array(wrench, "wrench").astype(grasp.dtype)
    if array.ndim < 1 or array.shape[-1] != m:
        raise ValueError(
            f"wrench must have shape (*batch, *loads, {m}): (force; torque about the centre of mass), got {array.shape}"
        )
    lead = array.shape[:-1]
    if not lead:
        return widened(array, (*batch, m)), batch
    if len(lead) < len(batch) or any(a not in (1, b) for a, b in zip(lead, batch, strict=False)):
        raise ValueError(
            f"the leading axes of wrench {array.shape} must start with the grasp's batch axes {batch} "
            "(further axes are several loads for each grasp)"
        )
    shape = (*batch, *lead[len(batch) :])
    return widened(array, (*shape, m)), shape


def _weight(value: Array, batch: tuple[int, ...], shape: tuple[int, ...]) -> Array:
    """One per problem: from one for all, one per grasp, or one per load."""
    if value.ndim == len(shape) > len(batch):
        return widened(value, shape)
    return spread(value, (), batch, "the criterion's weight", shape[len(batch) :])


def demand_rows(
    grasp: Grasp,
    wrench: Array,
    shape: tuple[int, ...],
    criterion: Criterion,
    max_normal: Any,
    torque_limits: Any,
) -> tuple[Contacts, Demand]:
    """Contacts and demand with one row for each problem of ``shape``; ValueError where a value does not fit."""
    batch, k, dtype = grasp.batch_shape, grasp.contacts, grasp.dtype
    loads = shape[len(batch) :]
    n = grasp.model.force_size(grasp.dimension)
    contacts = contacts_of(grasp)
    rows = Contacts(*(spread(x, x.shape[len(batch) :], batch, "grasp", loads) for x in contacts))
    criterion = jax.tree.map(lambda x: _weight(x.astype(dtype), batch, shape), criterion)
    log_det = None
    if criterion.barrier_weight is not None:
        terms = cleared(grasp).model.log_det_terms(grasp.dimension)
        a, b, c = (spread(x.astype(dtype), (k,), batch, "grasp", loads) for x in terms)
        log_det = (a, b, c)
    cap = None
    if max_normal is not None:
        cap = spread(real_array(max_normal, "max_normal").astype(dtype), (k,), batch, "max_normal", loads)
    jacobian = torque = None
    if isinstance(torque_limits, TorqueLimits):
        torque_limits = torque_limits.in_contact_axes(grasp)
    if torque_limits is not None:
        try:
            jacobian, torque = torque_limits
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"torque_limits must be a pair (J, tau_max): J of shape (*batch, {k * n}, q) and tau_max (q)"
            ) from error
        jacobian = real_array(jacobian, "the hand Jacobian J").astype(dtype)
        if jacobian.ndim < 2 or jacobian.shape[-2] != k * n:
            raise ValueError(
                f"the hand Jacobian J must have shape (*batch, {k * n}, q): one row for each force component "
                f"({k} contacts of {n}), one column for each joint, got {jacobian.shape}"
            )
        joints = jacobian.shape[-1]
        jacobian = spread(jacobian, (k * n, joints), batch, "the hand Jacobian J", loads)
        torque = spread(real_array(torque, "tau_max").astype(dtype), (joints,), batch, "tau_max", loads)
    return rows, Demand(wrench, criterion, log_det, cap, jacobian, torque)
