"""jaxgrasp: does this grasp hold, with which forces, and how do I make it better?

Names follow the chapter "Wrench Resistant Grasps"; wrench resistance is what others call force closure.
"""

from . import surfaces
from .certificate import check_certificate
from .closed_loop import ClosedLoop, close_loop
from .contacts import ContactModel, Frictionless, HardFinger, SoftFinger
from .control import ComputedTorque, ControlStatus, Gains, Reference
from .controllability import (
    Controllability,
    ControllabilityVerdict,
    controllability,
    controllability_matrix,
    gramian,
)
from .controllability_words import explain_controllability
from .criteria import Criterion, Gentlest, LeastNorm, Robust, SmallestSum, SumOfSquares
from .critical_friction import CriticalFriction, critical_friction, friction_sweep, with_friction_factor
from .dynamics import (
    BodyState,
    RigidBody,
    acceleration,
    advance,
    coriolis,
    gravity_term,
    mass_matrix,
    world_grasp_map,
)
from .epsilon import EpsilonQuality, epsilon_quality
from .equilibrium import (
    Equilibrium,
    EquilibriumKind,
    ResistibleWrenches,
    Squeeze,
    equilibrium,
    resistible_wrenches,
    squeeze,
)
from .forces import ForceOptimum, optimize_forces
from .grasp import (
    Grasp,
    folded_grasp_map,
    grasp_map,
    grasp_rank,
    grasp_singular_values,
    internal_force_part,
    null_space,
)
from .guaranteed_radius import GuaranteedRadius, guaranteed_radius
from .linearization import Linearization, OperatingPoint, linearize
from .lmi import (
    FrictionLMI,
    LMIFeasibility,
    LMIProblem,
    LMISolution,
    LogDetTerm,
    SDPSolution,
    friction_lmi,
    lmi_feasibility,
    lmi_margin,
    lmi_minimize,
    margin_lmi,
    sdp_minimize,
    second_order_cone_lmi,
)
from .lmi_forces import LMIForces, lmi_forces
from .measures import TaskQuality, grasp_isotropy, grasp_volume, task_quality
from .regulator import Regulator, regulator
from .resistance import WrenchResistance, wrench_resistance
from .simulation import MujocoPlant, mujoco_model, mujoco_plant
from .solver import Stop
from .status import Status
from .tracing import Trace, load_grasp, save_grasp, trace

__version__ = "0.1.0"

__all__ = [
    # 11.1 contacts, grasps, internal forces
    "ContactModel",
    "Frictionless",
    "HardFinger",
    "SoftFinger",
    "Grasp",
    "grasp_map",
    "folded_grasp_map",
    "grasp_rank",
    "grasp_singular_values",
    "null_space",
    "internal_force_part",
    # 11.2 friction cones as linear matrix inequalities
    "friction_lmi",
    "FrictionLMI",
    "margin_lmi",
    "lmi_margin",
    "lmi_minimize",
    "lmi_feasibility",
    "sdp_minimize",
    "second_order_cone_lmi",
    "LMIProblem",
    "LogDetTerm",
    "LMISolution",
    "LMIFeasibility",
    "SDPSolution",
    # 11.2 wrench resistance (force closure)
    "wrench_resistance",
    "WrenchResistance",
    "Stop",
    "trace",
    "Trace",
    "save_grasp",
    "load_grasp",
    # 11.3 grasp force optimisation
    "optimize_forces",
    "ForceOptimum",
    "Criterion",
    "Gentlest",
    "Robust",
    "SmallestSum",
    "SumOfSquares",
    "LeastNorm",
    "equilibrium",
    "Equilibrium",
    "EquilibriumKind",
    "squeeze",
    "Squeeze",
    "resistible_wrenches",
    "ResistibleWrenches",
    "lmi_forces",
    "LMIForces",
    # quality: how good is the grasp
    "epsilon_quality",
    "EpsilonQuality",
    "critical_friction",
    "CriticalFriction",
    "friction_sweep",
    "with_friction_factor",
    "guaranteed_radius",
    "GuaranteedRadius",
    "task_quality",
    "TaskQuality",
    "grasp_isotropy",
    "grasp_volume",
    # 11.4 dynamics and controllability
    "RigidBody",
    "BodyState",
    "mass_matrix",
    "coriolis",
    "gravity_term",
    "world_grasp_map",
    "acceleration",
    "advance",
    "linearize",
    "Linearization",
    "OperatingPoint",
    "controllability",
    "Controllability",
    "ControllabilityVerdict",
    "explain_controllability",
    "controllability_matrix",
    "gramian",
    "mujoco_plant",
    "mujoco_model",
    "MujocoPlant",
    "close_loop",
    "ClosedLoop",
    "ComputedTorque",
    "Regulator",
    "regulator",
    "Gains",
    "Reference",
    "ControlStatus",
    # surfaces to put contacts on
    "surfaces",
    # answers and their proofs
    "Status",
    "check_certificate",
]
