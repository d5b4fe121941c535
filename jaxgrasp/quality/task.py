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

from ..contacts import Grasp
from ..core import Array, Float, Int, Status
from ..forces import ForceOptimum, Gentlest, SmallestSum, resistible_wrenches
from .unit_wrench_space import NORMS

__all__ = ["TaskQuality", "task_quality"]


class TaskQuality(eqx.Module):
    """How well each grasp does a task of T wrenches; efforts in N.

    multiple  (*batch) the largest multiple of all task wrenches, and of their convex hull, that unit effort resists;
              1 / N. 0 where one of them cannot be resisted at all, NaN where INVALID
    effort    (*batch, T) the least effort that holds each wrench; infinite where none does
    worst     (*batch) int32, the wrench that takes most
    optimum   the ``ForceOptimum`` of every wrench: forces, bounds, escape twists
    """

    multiple: Float[Array, "*batch"]
    effort: Float[Array, "*batch T"]
    worst: Int[Array, "*batch"]
    optimum: ForceOptimum


def task_quality(
    grasp: Grasp, wrenches: Float[Array, "*batch T m"], norm: str = "L1", tolerance: float = 1e-8
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
    held = resistible_wrenches(grasp, wrenches, criterion, tolerance=tolerance)
    status, cost = held.optimum.status, held.optimum.cost
    effort = jnp.where(status == Status.OPTIMAL.value, cost, jnp.inf)
    most = jnp.max(effort, axis=-1)
    multiple = jnp.where(jnp.isfinite(most) & (most > 0), 1 / jnp.where(most > 0, most, 1.0), 0.0)
    multiple = jnp.where(most == 0, jnp.inf, multiple)
    invalid = jnp.any(status == Status.INVALID.value, axis=-1)
    worst = jnp.argmax(effort, axis=-1).astype(jnp.int32)
    return TaskQuality(jnp.where(invalid, jnp.nan, multiple), effort, worst, held.optimum)
