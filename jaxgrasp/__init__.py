"""jaxgrasp: does this grasp hold, with which forces, and how do I make it better?

Names follow the chapter "Wrench Resistant Grasps"; wrench resistance is what others call force closure.
"""

from . import surfaces
from .certificates import check_certificate
from .conic import Stop
from .contacts import (
    ContactModel,
    Frictionless,
    Grasp,
    HardFinger,
    SoftFinger,
    folded_grasp_map,
    grasp_map,
    grasp_rank,
    grasp_singular_values,
    internal_force_part,
    null_space,
)
from .core import Status
from .core import __version__ as __version__
from .forces import (
    Criterion,
    Equilibrium,
    EquilibriumKind,
    ForceOptimum,
    Gentlest,
    LeastNorm,
    ResistibleWrenches,
    Robust,
    SmallestSum,
    Squeeze,
    SumOfSquares,
    equilibrium,
    optimize_forces,
    resistible_wrenches,
    squeeze,
)
from .lmi import (
    FrictionLMI,
    LMIFeasibility,
    LMIForces,
    LMIProblem,
    LMISolution,
    LogDetTerm,
    SDPSolution,
    friction_lmi,
    lmi_feasibility,
    lmi_forces,
    lmi_margin,
    lmi_minimize,
    margin_lmi,
    sdp_minimize,
    second_order_cone_lmi,
)
from .motion import (
    BodyState,
    ClosedLoop,
    ComputedTorque,
    Controllability,
    ControllabilityVerdict,
    ControlStatus,
    Gains,
    Linearization,
    MujocoPlant,
    OperatingPoint,
    Reference,
    Regulator,
    RigidBody,
    acceleration,
    advance,
    close_loop,
    controllability,
    controllability_matrix,
    coriolis,
    gramian,
    gravity_term,
    linearize,
    mass_matrix,
    mujoco_model,
    mujoco_plant,
    regulator,
    world_grasp_map,
)
from .quality import (
    CriticalFriction,
    EpsilonQuality,
    GuaranteedRadius,
    TaskQuality,
    critical_friction,
    epsilon_quality,
    friction_sweep,
    grasp_isotropy,
    grasp_volume,
    guaranteed_radius,
    task_quality,
    with_friction_factor,
)
from .report import explain_controllability
from .resistance import Trace, WrenchResistance, trace, wrench_resistance

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


def __getattr__(name: str):
    """Rooms that load more than NumPy and JAX are imported when they are first used."""
    if name in ("save_grasp", "load_grasp"):
        from . import formats

        return getattr(formats, name)
    raise AttributeError(f"module 'jaxgrasp' has no attribute {name!r}")
