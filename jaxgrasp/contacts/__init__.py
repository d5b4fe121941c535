"""Section 11.1: contact models, grasps, the grasp map G, and the folded map A that carries mu and gamma."""

from .folded import Contacts, Folded, contacts_of, fold, normal_first, unfold
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
    Tile,
    minus_transposed,
    normalized,
    onto_null_space,
    project,
    smallest_slack,
    stored_norm,
    tile_of,
    to_body,
    to_twist,
)
from .tiled_derivatives import BatchAxes, filled, masked, safe_contacts, tiled, tiled_solver, zero_tangent
from .validity import is_grasp, sound_contacts

__all__ = [
    "Axes",
    "TorqueLimits",
    "component_vectors",
    "contact_frames",
    "force_vectors",
    "BatchAxes",
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
    "Tile",
    "cone_use",
    "contacts_of",
    "filled",
    "fold",
    "folded_grasp_map",
    "grasp_map",
    "grasp_rank",
    "grasp_singular_values",
    "internal_force_part",
    "into_cones",
    "is_grasp",
    "length_scale",
    "masked",
    "minus_transposed",
    "nearest_admissible",
    "normal_first",
    "normalized",
    "null_space",
    "onto_null_space",
    "project",
    "safe_contacts",
    "smallest_slack",
    "sound_contacts",
    "stored_norm",
    "tile_of",
    "tiled",
    "tiled_solver",
    "to_body",
    "to_twist",
    "unfold",
    "zero_tangent",
]
