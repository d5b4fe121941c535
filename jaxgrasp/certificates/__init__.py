"""The checker: every answer proved again in float64, without trusting the solver.

Numpy only, and nothing else of this library: a bug elsewhere cannot make a wrong proof look right.
"""

from __future__ import annotations

import numpy as np

from .epsilon import check_epsilon
from .forces import check_forces
from .resistance import check_resistance

__all__ = ["check_certificate"]


def check_certificate(grasp, result, tolerance: float | None = None) -> np.ndarray:
    """True for each lane whose answer the evidence in ``result`` proves; shape of ``result.status``, numpy bool.

    grasp      a ``Grasp``
    result     what ``wrench_resistance(grasp)``, ``optimize_forces(grasp, ..)`` or ``epsilon_quality(grasp, ..,
               certificate=True)`` returned, or anything with the same fields
    tolerance  for verdicts: the |t*| that MARGINAL may claim; by default what the result's own bracket claims, as long
               as that is below 1e-3. For forces: the relative gap that OPTIMAL may leave, by default 1e-6. For
               epsilon: the rounding its bounds may show, by default 1e-9 of epsilon

    Runs on the host in float64 whatever the dtype of the grasp; a few operations a lane. What is asked of each status
    is written in ``certificates/resistance.py``, ``certificates/forces.py`` and ``certificates/epsilon.py``.
    """
    if hasattr(result, "facets"):
        check = check_epsilon
    else:
        check = check_forces if hasattr(result, "force") else check_resistance
    return check(grasp, result, tolerance)
