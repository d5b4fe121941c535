"""Contacts moved over a surface by gradients to where the grasp holds best, many starts at once."""

from .objectives import FLOOR, Epsilon, Margin, Objective
from .place import Placement, place_contacts
from .requirements import Apart, Beyond, EdgeClearance, JawWidth, Requirement, Within
from .search import CANDIDATES, PlacementProgress, Search

__all__ = [
    "Apart",
    "Beyond",
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
    "Search",
    "Within",
    "place_contacts",
]
