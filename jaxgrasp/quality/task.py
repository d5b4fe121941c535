"""Quality measures beside the margin and epsilon: what a task asks for, and two of other tools.

    task       multiple = min_j 1 / effort_j,  effort_j = min {effort(f) : G f + w_j = 0, f in C}
    isotropy   sigma_min / sigma_max of the grasp map            volume   product of its singular values

The task's answers are optimal forces with their proofs (``forces``). Isotropy and volume know no friction cone: a grasp
that cannot squeeze may score well; they are here for comparison. Sources: Pollard 1996 (task wrenches); Li, Sastry 1988
(volume of the grasp map's ellipsoid); Kim et al. 2001 (isotropy).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike

from ..contacts import Grasp
from ..core import Answer, Array, Float, Int, Status, largest_of, nan_where
from ..forces import Gentlest, OptimalForces, SmallestSum, resistible_wrenches
from .unit_wrench_space import NORMS

__all__ = ["TaskQuality", "task_quality"]


class TaskQuality(Answer):
    """How well each grasp does a task of T wrenches; efforts in N.

    status    (*batch) int32, a ``Status``: OPTIMAL where every wrench can be held, INFEASIBLE where one cannot, STALLED
              where one is open, INVALID
    multiple  (*batch) the largest multiple of all task wrenches, and of their convex hull, that unit effort resists;
              1 / N. 0 where one of them cannot be resisted at all, NaN where INVALID
    effort    (*batch, T) the least effort that holds each wrench; infinite where none does
    worst     (*batch) int32, the wrench that takes most
    forces    the ``OptimalForces`` of every wrench: forces, bounds, escape twists
    """

    status: Int[Array, "*batch"]
    multiple: Float[Array, "*batch"]
    effort: Float[Array, "*batch T"]
    worst: Int[Array, "*batch"]
    forces: OptimalForces


def task_quality(
    grasp: Grasp, wrenches: Float[ArrayLike, "*batch T m"], *, norm: str = "L1", tolerance: float = 1e-8
) -> TaskQuality:
    """``min_j 1 / min {effort(f) : G f + w_j = 0, f in C}``: a task's wrenches, and the one that decides.

    wrenches  (T, m) or (*batch, T, m) loads on the object: force in N, torque about the centre of mass in N m
    norm      effort: "L1", the sum of the normal forces (``SmallestSum``), or "Linf", the largest (``Gentlest``)

    The least effort is convex in the load: what holds every w_j holds their convex hull. ``effort`` is the least force
    of each load case, its largest entry that of the worst case. Differentiable, with the proofs of ``optimize_forces``.
    """
    if norm not in NORMS:
        raise ValueError(f"norm must be one of {', '.join(NORMS)}, got {norm!r}")
    criterion = SmallestSum() if norm == "L1" else Gentlest()
    held = resistible_wrenches(grasp, wrenches, criterion=criterion, tolerance=tolerance)
    return _worst_of(held.status, held.forces)


@eqx.filter_jit
def _worst_of(status: Array, forces: OptimalForces) -> TaskQuality:
    """The quality of a task from the forces of its wrenches."""
    cost = forces.cost
    effort = jnp.where(status == Status.OPTIMAL.value, cost, jnp.inf)
    most = largest_of(effort)
    multiple = jnp.where(jnp.isfinite(most) & (most > 0), 1 / jnp.where(most > 0, most, 1.0), 0.0)
    multiple = jnp.where(most == 0, jnp.inf, multiple)
    invalid = jnp.any(status == Status.INVALID.value, axis=-1)
    worst = jnp.argmax(effort, axis=-1).astype(jnp.int32)
    multiple = nan_where(invalid, multiple)
    return TaskQuality(_whole(status), multiple, effort, worst, forces)


def _whole(status: Array) -> Array:
    """The status of a task from those of its wrenches (*batch, T): the worst one says it."""

    def some(value: Status) -> Array:
        return jnp.any(status == value.value, axis=-1)

    whole = jnp.where(some(Status.STALLED), Status.STALLED.value, Status.OPTIMAL.value)
    whole = jnp.where(some(Status.INFEASIBLE), Status.INFEASIBLE.value, whole)
    return jnp.where(some(Status.INVALID), Status.INVALID.value, whole).astype(jnp.int32)
