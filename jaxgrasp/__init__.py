"""jaxgrasp: does this grasp hold, with which forces, and how do I make it better?

Names follow the chapter "Wrench Resistant Grasps"; wrench resistance is what others call force closure.
"""

from .certificate import check_certificate
from .contacts import ContactModel, Frictionless, HardFinger, SoftFinger
from .grasp import (
    Grasp,
    folded_grasp_map,
    grasp_map,
    grasp_rank,
    grasp_singular_values,
    internal_force_part,
    null_space,
)
from .resistance import WrenchResistance, wrench_resistance
from .status import Status

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
    # 11.2 wrench resistance
    "wrench_resistance",
    "WrenchResistance",
    # answers and their proofs
    "Status",
    "check_certificate",
]
