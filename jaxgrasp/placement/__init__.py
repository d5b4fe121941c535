"""Contacts moved over a surface by gradients to where the grasp holds best, many starts at once."""

from .objectives import FLOOR, Epsilon, Margin, Objective
from .place import CANDIDATES, Placement, PlacementProgress, place_contacts
from .requirements import Apart, EdgeClearance, JawWidth, Requirement

__all__ = [
    "Apart",
    "CANDIDATES",
    "EdgeClearance",
    "Epsilon",
    "FLOOR",
    "JawWidth",
    "Margin",
    "Objective",
    "Placement",
    "PlacementProgress",
    "Requirement",
    "place_contacts",
]
