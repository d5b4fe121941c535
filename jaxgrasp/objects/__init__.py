"""What is grasped: built-in objects, meshes read from files, ray casts, and candidate contacts on them."""

from .builtin import OBJECTS, make_object
from .meshes import METRES_PER, Body, load_mesh
from .sampling import BLOCK, AntipodalSampler, SurfaceSampler, geometric_filter

__all__ = [
    "AntipodalSampler",
    "BLOCK",
    "Body",
    "METRES_PER",
    "OBJECTS",
    "SurfaceSampler",
    "geometric_filter",
    "load_mesh",
    "make_object",
]
