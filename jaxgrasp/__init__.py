"""jaxgrasp: does this grasp hold, with which forces, and how do I make it better?

Names follow the chapter "Wrench Resistant Grasps". What others call it, and what it is called here:

    force closure, wrench closure         wrench_resistance(grasp).status == Status.RESISTANT
    form closure                          the same with Frictionless() contacts
    grasp matrix, grasp map G             grasp_map(grasp)
    point contact with friction, PCWF     HardFinger(friction)
    soft finger, SFCE                     SoftFinger(friction, torsion)
    internal forces, Null(G)              null_space(grasp), contacts.internal_force_part(grasp, force)
    force distribution, grasping force    optimize_forces(grasp, wrench), the forces of a hand that squeezes: squeeze
      optimisation, GFO
    joint torque limits                   torque_limits=TorqueLimits(J, tau_max)
    Ferrari-Canny, epsilon, largest ball  epsilon_quality(grasp)
    task wrench space                     task_quality(grasp, wrenches)
    grasp isotropy, volume                quality.grasp_isotropy(grasp), quality.grasp_volume(grasp)
    small-time local controllability      controllability(grasp, body)
    grasp synthesis, grasp refinement     place_contacts(surface)
    certificate, proof                    check(grasp, answer, ..), prove(grasp, answer, ..)

Rooms, from the ground up: core, certificates, backend, conic, contacts, resistance, forces, quality, motion, lmi,
objects, surfaces, placement, formats, report, jobs, cli. ``import jaxgrasp.X`` is a module for each.
"""

import importlib

from . import lmi as lmi
from . import surfaces as surfaces
from .certificates import check, prove
from .contacts import (
    Frictionless,
    Grasp,
    HardFinger,
    SoftFinger,
    TorqueLimits,
    contact_frames,
    force_vectors,
    grasp_map,
    grasp_rank,
    null_space,
)
from .core import Answer, Status
from .core import __version__ as __version__
from .forces import (
    Gentlest,
    LeastNorm,
    OptimalForces,
    Robust,
    SmallestSum,
    SumOfSquares,
    equilibrium,
    optimize_forces,
    resistible_wrenches,
    squeeze,
)
from .motion import (
    BodyState,
    ComputedTorque,
    Gains,
    RigidBody,
    close_loop,
    controllability,
    linearize,
    regulator,
)
from .quality import critical_friction, epsilon_quality, guaranteed_radius, task_quality
from .resistance import WrenchResistance, trace, wrench_resistance

__all__ = [
    # 11.1 contacts, grasps, internal forces
    "Frictionless",
    "HardFinger",
    "SoftFinger",
    "Grasp",
    "grasp_map",
    "grasp_rank",
    "null_space",
    "contact_frames",
    "force_vectors",
    # 11.2 wrench resistance (force closure)
    "wrench_resistance",
    "WrenchResistance",
    "trace",
    # 11.3 grasp force optimisation
    "optimize_forces",
    "OptimalForces",
    "Gentlest",
    "Robust",
    "SmallestSum",
    "SumOfSquares",
    "LeastNorm",
    "TorqueLimits",
    "equilibrium",
    "squeeze",
    "resistible_wrenches",
    # quality: how good is the grasp
    "epsilon_quality",
    "critical_friction",
    "guaranteed_radius",
    "task_quality",
    # placement: how to make it better
    "place_contacts",
    # 11.4 dynamics and controllability
    "RigidBody",
    "BodyState",
    "linearize",
    "controllability",
    "ComputedTorque",
    "Gains",
    "regulator",
    "close_loop",
    # answers, their proofs, and files
    "Answer",
    "Status",
    "check",
    "prove",
    "save_grasp",
    "load_grasp",
]

# Names and rooms that load more than NumPy and JAX: imported when they are first used.
_LATER = {"place_contacts": "placement", "save_grasp": "formats", "load_grasp": "formats"}
_LATER_ROOMS = ("backend", "certificates", "conic", "objects", "placement", "formats", "report", "jobs")


def __getattr__(name: str):
    if name in _LATER_ROOMS:
        return importlib.import_module(f".{name}", __name__)
    if name in _LATER:
        return getattr(importlib.import_module(f".{_LATER[name]}", __name__), name)
    from .core import renamed

    raise AttributeError(renamed(name))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_LATER_ROOMS})
