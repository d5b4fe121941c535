"""Section 11.4: the grasped body's dynamics, controllability, controllers, and closed loops with MuJoCo."""

from .closed_loop import ClosedLoop, Simulation, close_loop
from .computed_torque import ComputedTorque, ContactController, Gains, Reference
from .controllability import Controllability, controllability, controllability_matrix, gramian
from .linearization import Linearization, linearize
from .mujoco import MujocoPlant, mujoco_model, mujoco_plant
from .regulator import Regulator, regulator
from .rigid_body import (
    BodyState,
    RigidBody,
    acceleration,
    advance,
    coriolis,
    gravity_term,
    mass_matrix,
    world_grasp_map,
)

__all__ = [
    "BodyState",
    "ClosedLoop",
    "ComputedTorque",
    "ContactController",
    "Controllability",
    "Gains",
    "Linearization",
    "MujocoPlant",
    "Reference",
    "Regulator",
    "RigidBody",
    "Simulation",
    "acceleration",
    "advance",
    "close_loop",
    "controllability",
    "controllability_matrix",
    "coriolis",
    "gramian",
    "gravity_term",
    "linearize",
    "mass_matrix",
    "mujoco_model",
    "mujoco_plant",
    "regulator",
    "world_grasp_map",
]
