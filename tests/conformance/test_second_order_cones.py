"""Second-order cone problems with published values: as LMIs, points, costs and multipliers."""

import numpy as np
import pytest
from published import cone_problems
from scipy.linalg import block_diag

import jaxgrasp as jg
from jaxgrasp import Status

PROBLEMS = cone_problems()


@pytest.mark.parametrize("name", PROBLEMS)
def test_points_costs_and_multipliers_are_the_published_ones(name):
    """``|A x + b| <= c.x + d`` as a block with multiplier Z: (tr Z, 2 z) is that of (height, vector)."""
    problem = PROBLEMS[name]
    blocks = [jg.lmi.second_order_cone_lmi(*map(np.asarray, cone)) for cone in problem.cones]
    constant = block_diag(*(np.asarray(block[0]) for block in blocks))
    matrices = [block_diag(*(np.asarray(block[1])[i] for block in blocks)) for i in range(len(problem.cost))]
    out = jg.lmi.sdp_minimize(problem.cost, constant, np.array(matrices))
    assert out.status == Status.OPTIMAL
    np.testing.assert_allclose(out.upper, problem.value, atol=2e-6)
    assert float(out.lower) - 2e-6 <= problem.value <= float(out.upper) + 2e-6
    np.testing.assert_allclose(out.x, problem.x, atol=2e-4)
    Z, first = np.asarray(out.Z), 0
    for (A, *_), dual in zip(problem.cones, problem.duals, strict=True):
        last = first + len(A)
        block = Z[first : last + 1, first : last + 1]
        np.testing.assert_allclose(np.trace(block), dual[0], atol=2e-4)
        np.testing.assert_allclose(2 * block[-1, :-1], dual[1], atol=2e-4)
        first = last + 1
