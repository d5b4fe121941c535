"""The checker: every answer proved again in float64, without trusting the solver.

Numpy only, and nothing else of this library: a bug elsewhere cannot make a wrong proof look right.
"""

from __future__ import annotations

import numpy as np

from .forces import check_forces
from .resistance import check_resistance

__all__ = ["check_certificate"]


def check_certificate(grasp, result, tolerance: float | None = None) -> np.ndarray:
    """True for each lane whose answer the evidence in ``result`` proves; shape of ``result.status``, numpy bool.

    grasp      a ``Grasp``
    result     what ``wrench_resistance(grasp)`` or ``optimize_forces(grasp, ..)`` returned, or anything with the same
               fields
    tolerance  for verdicts: the |t*| that MARGINAL may claim; by default what the result's own bracket claims, as long
               as that is below 1e-3. For forces: the relative gap that OPTIMAL may leave, by default 1e-6

    Runs on the host in float64 whatever the dtype of the grasp; a few operations a lane. What is asked of each status
    is written in ``certificate/resistance.py`` and ``certificate/forces.py``.
    """
    check = check_forces if hasattr(result, "force") else check_resistance
    return check(grasp, result, tolerance)
