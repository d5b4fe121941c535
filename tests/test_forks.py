"""A child made by fork, after its parent used JAX, is told so instead of hanging."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CODE = """
import os, sys, warnings
warnings.simplefilter("ignore")  # JAX says that forking is not for it
import numpy as np
import jaxgrasp as jg
P = np.array([[-1.0, 0], [1, 0]])
grasp = jg.Grasp(P, -P, jg.HardFinger(0.5)) if {before} else None
child = os.fork()
if child:
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
try:
    {call}
except RuntimeError as error:
    os._exit(7 if "spawn" in str(error) else 8)
os._exit(0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.parametrize(
    ("before", "call", "code"),
    [
        (True, "jg.Grasp(P, -P, jg.HardFinger(0.5))", 7),
        (True, "jg.wrench_resistance(grasp)", 7),
        (True, "jg.guaranteed_radius(grasp)", 7),
        (False, "jg.Grasp(P, -P, jg.HardFinger(0.5))", 0),
    ],
)
def test_a_forked_child_is_told(before, call, code):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    text = CODE.format(before=before, call=call)
    done = subprocess.run([sys.executable, "-c", text], env=environment, timeout=120, check=False)
    assert done.returncode == code
