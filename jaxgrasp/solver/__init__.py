"""A structured primal-dual interior-point solver for small second-order cone programs, thousands at a time.

It has never heard of grasping: it knows cones, a few dense equality constraints, and lanes.
"""

from .interior_point import Iterate, Progress, Stop, newton_step, solve
from .program import ConeProgram

__all__ = ["ConeProgram", "Iterate", "Progress", "Stop", "newton_step", "solve"]
