"""How good a grasp is: Ferrari-Canny epsilon, critical friction, guaranteed radius, task and spectral measures."""

from .boundary_along import facet_normal
from .critical_friction import CriticalFriction, critical_friction, friction_sweep, with_friction_factor
from .epsilon import EpsilonQuality, epsilon_quality
from .guaranteed_radius import GuaranteedRadius, guaranteed_radius
from .spectral import grasp_isotropy, grasp_volume
from .task import TaskQuality, task_quality
from .unit_wrench_space import NORMS, effort_map, signed_supports, torque_lengths

__all__ = [
    "CriticalFriction",
    "EpsilonQuality",
    "GuaranteedRadius",
    "NORMS",
    "TaskQuality",
    "critical_friction",
    "effort_map",
    "epsilon_quality",
    "facet_normal",
    "friction_sweep",
    "grasp_isotropy",
    "grasp_volume",
    "guaranteed_radius",
    "signed_supports",
    "task_quality",
    "torque_lengths",
    "with_friction_factor",
]
