"""Long work on many grasps: requests checked before any work (``plan_*``), executors in chunks, shards, summaries."""

from .check import check, controllability_of
from .check_request import CheckPlan, CheckRequest, plan_check
from .forces import forces_of_file, forces_of_row
from .forces_request import ForcesPlan, ForcesRequest, plan_forces
from .outputs import writable
from .place import Placed, draw_best, place
from .place_request import PlacePlan, PlaceRequest, plan_place
from .prove import ProofSummary, prove_verdicts
from .screen import screen
from .screen_request import ScreenPlan, ScreenRequest, plan_screen
from .summary import ForceSummary, Summary

__all__ = [
    "CheckPlan",
    "CheckRequest",
    "ForceSummary",
    "ForcesPlan",
    "ForcesRequest",
    "PlacePlan",
    "PlaceRequest",
    "Placed",
    "ProofSummary",
    "ScreenPlan",
    "ScreenRequest",
    "Summary",
    "check",
    "controllability_of",
    "draw_best",
    "forces_of_file",
    "forces_of_row",
    "place",
    "plan_check",
    "plan_forces",
    "plan_place",
    "plan_screen",
    "prove_verdicts",
    "screen",
    "writable",
]
