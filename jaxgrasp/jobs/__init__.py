"""Long work on many grasps: requests checked before any work, executors in chunks, shards, summaries."""

from .forces import balance_many, balance_one
from .load import LoadRequest, prepare_load
from .motion import CheckRequest, check, checked_columns, controllability_of, prepare_check
from .place import PlaceRequest, draw_best, place, prepare_place
from .request import Request, prepare_screen, provenance
from .screen import screen
from .summary import Summary

__all__ = [
    "CheckRequest",
    "LoadRequest",
    "PlaceRequest",
    "Request",
    "Summary",
    "balance_many",
    "balance_one",
    "check",
    "checked_columns",
    "controllability_of",
    "draw_best",
    "place",
    "prepare_check",
    "prepare_load",
    "prepare_place",
    "prepare_screen",
    "provenance",
    "screen",
]
