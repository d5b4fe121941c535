"""Section 11.1: contact models, grasps, the grasp map G, and the folded map A that carries mu and gamma."""

from .folded import Contacts, Folded, contacts_of, fold, unfold
from .frames import Axes, TorqueLimits, component_vectors, contact_frames, force_vectors
from .friction_cones import cone_use, into_cones, nearest_admissible
from .grasp import Grasp
from .grasp_map import (
    folded_grasp_map,
    grasp_map,
    grasp_rank,
    grasp_singular_values,
    internal_force_part,
    length_scale,
    null_space,
)
from .models import MODELS, Component, ContactModel, Frictionless, HardFinger, SoftFinger
from .projection import (
    Projection,
    minus_transposed,
    normalized,
    onto_null_space,
    project,
    smallest_slack,
    stored_norm,
    to_twist,
)
from .tiled_derivatives import kept, masked, safe_contacts, tiled, tiled_solver, zero_tangent

__all__ = [
    "Axes",
    "TorqueLimits",
    "component_vectors",
    "contact_frames",
    "force_vectors",
    "Component",
    "ContactModel",
    "Contacts",
    "Folded",
    "Frictionless",
    "Grasp",
    "HardFinger",
    "MODELS",
    "Projection",
    "SoftFinger",
    "cone_use",
    "contacts_of",
    "fold",
    "folded_grasp_map",
    "grasp_map",
    "grasp_rank",
    "grasp_singular_values",
    "internal_force_part",
    "into_cones",
    "kept",
    "length_scale",
    "masked",
    "minus_transposed",
    "nearest_admissible",
    "normalized",
    "null_space",
    "onto_null_space",
    "project",
    "safe_contacts",
    "smallest_slack",
    "stored_norm",
    "tiled",
    "tiled_solver",
    "to_twist",
    "unfold",
    "zero_tangent",
]
