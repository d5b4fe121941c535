"""Definitions 3-4: friction cones as linear matrix inequalities; the second road to margins and forces."""

from .feasibility import LMIFeasibility, SDPSolution, lmi_feasibility, sdp_minimize, second_order_cone_lmi
from .forces import LMIForces, lmi_forces
from .friction import FrictionLMI, friction_lmi, lmi_margin, margin_lmi
from .primal_dual import lmi_minimize
from .problem import LMIProblem, LMISolution, LogDetTerm

__all__ = [
    "FrictionLMI",
    "LMIFeasibility",
    "LMIForces",
    "LMIProblem",
    "LMISolution",
    "LogDetTerm",
    "SDPSolution",
    "friction_lmi",
    "lmi_feasibility",
    "lmi_forces",
    "lmi_margin",
    "lmi_minimize",
    "margin_lmi",
    "sdp_minimize",
    "second_order_cone_lmi",
]
