"""Contact problems of the Siconos collection: bodies that rest on others, and local problems as cone programs."""

import numpy as np
import pytest
from clarabel_oracle import clarabel_margin
from contact_problems import DENSE, clarabel_sums, loads, local_problem
from published import read_bodies
from real_data import real_data

import jaxgrasp as jg
from jaxgrasp import Status

pytestmark = pytest.mark.realdata


def stacks():
    pytest.importorskip("h5py")
    bodies = read_bodies(real_data("conformance") / "siconos" / "Box_Stacks-i0122-82-5.hdf5")
    grasp = jg.Grasp(bodies.position, bodies.normal, jg.HardFinger(bodies.friction), bodies.active)
    return bodies, grasp


def test_bodies_resting_on_others_are_not_resistant():
    """31 bodies, 11 on two contacts and 20 on three, friction 0.3: none is held against every load."""
    bodies, grasp = stacks()
    assert bodies.defect < 1e-6  # the recovered levers explain the file's torque rows
    np.testing.assert_array_equal(np.bincount(bodies.active.sum(1)), [0, 0, 11, 20])
    out = jg.wrench_resistance(grasp)
    assert np.all(np.asarray(out.status) == Status.NOT_RESISTANT)
    components = ["f_x", "f_y", "f_n"]
    for i in range(len(bodies.position)):
        margin, known = clarabel_margin(
            bodies.position[i], bodies.normal[i], bodies.friction, 0.0, bodies.active[i], components
        )
        assert known and margin < -1e-6
        if np.isneginf(margin):  # but for rounding
            assert float(out.upper[i]) < -1e9
        else:
            assert float(out.lower[i]) * (1 + 1e-6) <= margin <= float(out.upper[i]) * (1 - 1e-6)


def test_what_is_said_of_resting_bodies_is_proved():
    """Bodies on parallel normals have t* = -infinity but for rounding: no finite bracket below -1e12 is a number."""
    _, grasp = stacks()
    assert np.all(np.asarray(jg.check(grasp, jg.wrench_resistance(grasp))))


def test_loads_that_resting_bodies_can_hold():
    """992 loads: forces that balance them inside the cones, or a twist that excludes all; Clarabel says the same.

    Two contacts resist no turn about the line through them: a load that they hold balances only to rounding, and its
    forces may be found without a proof of their cost. No load made from admissible forces is called impossible.
    """
    bodies, grasp = stacks()
    G = np.asarray(jg.grasp_map(grasp))
    wrench = loads(bodies, G)
    out = jg.optimize_forces(grasp, wrench, criterion=jg.SmallestSum())
    status = np.asarray(out.status)
    two = bodies.active.sum(1) == 2
    assert np.all(np.isin(status, [Status.OPTIMAL, Status.INFEASIBLE, Status.STALLED]))
    assert np.all(status[~two] != Status.STALLED) and np.all(status[~two, 1:11] == Status.OPTIMAL)
    assert np.all(status[:, 1:11] != Status.INFEASIBLE)  # made of admissible forces
    proved = np.asarray(jg.check(grasp, out, wrench=wrench, criterion=jg.SmallestSum()))
    assert np.all(proved[status != Status.STALLED])
    force = np.asarray(out.force).reshape(*status.shape, -1)
    held = status == Status.OPTIMAL
    assert held.sum() >= 200
    missed = np.einsum("bij,blj->bli", G, force) + wrench
    assert np.all(np.linalg.norm(missed[held], axis=-1) < 1e-8 * np.linalg.norm(wrench[held], axis=-1))
    each = force.reshape(*status.shape, -1, 3)
    slack = bodies.friction * each[..., 2] - np.linalg.norm(each[..., :2], axis=-1)
    assert np.all(slack[held] > -1e-9 * np.abs(each[held]).max((-1, -2))[:, None])

    said = clarabel_sums(bodies, G, wrench)
    np.testing.assert_allclose(said[held], np.asarray(out.cost)[held], rtol=1e-6, atol=1e-8)
    assert np.all(np.isposinf(said[status == Status.INFEASIBLE]))


@pytest.mark.parametrize(
    "name",
    [
        n if n in DENSE[:1] else pytest.param(n, marks=pytest.mark.slow("test_local_problems_agree"))
        for n in DENSE
    ],
)
def test_local_problems_agree(name):
    """``min r.W r / 2 + q.r`` over the friction cones, the convex part of a contact problem; and Clarabel's value."""
    problem, value = local_problem(real_data("conformance") / "siconos" / f"{name}.dat")
    out = jg.lmi.lmi_minimize(problem)
    room = 1e-7 * max(1.0, abs(value))
    assert float(out.lower) - room <= value <= float(out.upper) + room
    assert Status(out.status) in (Status.OPTIMAL, Status.STALLED)
    np.testing.assert_allclose(out.upper, value, rtol=1e-5, atol=1e-6)
