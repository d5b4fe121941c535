"""How near the forces themselves are to the optimal ones, where those are unique: on the edge of cones, with mu = 0."""

import numpy as np
import pytest
from force_oracle import clarabel_forces
from force_problems import CRITERIA, problems
from shapes import HARD

import jaxgrasp as jg
from jaxgrasp import Status


def frictionless_support(dtype):
    """Two rows of frictionless contacts and one with friction: mu = 0 is a number like any other."""
    position = np.array([[-1.0, 0, 0], [1.0, 0, 0], [0.0, 0, -1.0], [0.0, 0, 1.0]], dtype)
    friction, active = np.array([0.0, 0.5, 0.0, 0.0], dtype), np.arange(HARD) < 3  # the last is padding
    return jg.Grasp(position, -position, jg.HardFinger(friction), active)


def test_forces_of_contacts_without_friction():
    """A load (p, 0, -w): the frictionless side takes p more than the other, the floor takes w; friction idles."""
    grasp = frictionless_support("float64")
    load = np.array([2.0, 0, -3.0, 0, 0, 0])
    for criterion in (jg.SmallestSum(), jg.LeastNorm()):
        out = jg.optimize_forces(grasp, load, criterion=criterion)
        assert int(out.status) == Status.OPTIMAL
        force = np.asarray(out.force).reshape(HARD, 3)
        np.testing.assert_allclose(force, [[0, 0, 0], [0, 0, 2], [0, 0, 3], [0, 0, 0]], atol=1e-6)
        assert bool(jg.check(grasp, out, wrench=load, criterion=criterion))


@pytest.mark.parametrize(
    ("name", "criterion", "count"),
    [
        ("planar hard", "least norm", 60),
        pytest.param("soft", "least norm", 300, marks=pytest.mark.slow),
        pytest.param("soft", "gentlest", 300, marks=pytest.mark.slow),
    ],
)
def test_unique_forces_to_one_millionth(name, criterion, count):
    """A sixth of the mu zero: the forces, not only their cost."""
    grasp, components, wrench, *_ = problems(name, False, count, seed=77)
    make, parameter = CRITERIA[criterion]
    tight, loose = (
        jg.optimize_forces(grasp, wrench, criterion=make(parameter), tolerance=t) for t in (1e-12, 1e-10)
    )
    smooth = np.asarray(loose.smooth & tight.smooth) & (np.asarray(tight.cost) > 0)
    assert smooth.mean() > 0.5
    exact = np.asarray(tight.force)
    top = np.maximum(np.abs(exact).max(-1), 1e-300)
    assert (np.abs(np.asarray(loose.force) - exact).max(-1) / top)[smooth].max() < 1e-6
    # Clarabel's gap of 1e-11 leaves the direction of a force on the edge of its cone open to its root.
    model = grasp.model
    fields = (
        grasp.position,
        grasp.normal,
        model.friction_coefficient,
        model.torsion_coefficient,
        grasp.active,
    )
    arrays = [np.asarray(x) for x in fields]
    errors = []
    for i in np.flatnonzero(smooth):
        answer, _, force = clarabel_forces(
            *[a[i] for a in arrays], components, wrench[i], criterion, parameter, None, None
        )
        if answer == "optimal":
            errors.append(np.abs(np.ravel(force) - exact[i]).max() / top[i])
    assert len(errors) > count / 3
    assert np.median(errors) < 1e-6
    assert np.quantile(errors, 0.95) < 1e-5
