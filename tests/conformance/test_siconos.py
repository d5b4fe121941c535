"""Contact problems of the Siconos collection: bodies that rest on others, and local problems as cone programs."""

import clarabel
import numpy as np
import pytest
from clarabel_oracle import clarabel_margin
from published import read_bodies, read_contact_problem
from real_data import real_data
from scipy.linalg import block_diag
from scipy.sparse import csc_matrix

import jaxgrasp as jg
from jaxgrasp import Status

pytestmark = pytest.mark.realdata

LOADS = 32  # a body


def stacks():
    pytest.importorskip("h5py")
    bodies = read_bodies(real_data("conformance") / "siconos" / "Box_Stacks-i0122-82-5.hdf5")
    grasp = jg.Grasp(bodies.position, bodies.normal, jg.HardFinger(bodies.friction), bodies.active)
    return bodies, grasp


def clarabel_cones(P, q, A, b, cones):
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    return clarabel.DefaultSolver(csc_matrix(P), q, csc_matrix(A), b, cones, settings).solve()


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


def loads(bodies, G):
    """(bodies, LOADS, 6): the file's weight, forces from inside all cones, and directions at random."""
    rng = np.random.default_rng(8)
    count, k = bodies.active.shape
    w = np.empty((count, LOADS, 6))
    w[:, 0] = bodies.weight / np.linalg.norm(bodies.weight, axis=1, keepdims=True)
    inside = rng.normal(size=(count, 10, k, 3))
    inside[..., :2] *= (0.9 * bodies.friction * rng.random((count, 10, k, 1))) / np.linalg.norm(
        inside[..., :2], axis=-1, keepdims=True
    )
    inside[..., 2] = 1.0
    push = rng.random((count, 10, k, 1)) * bodies.active[:, None, :, None]
    w[:, 1:11] = -np.einsum("bij,blj->bli", G, (inside * push).reshape(count, 10, -1))
    other = rng.normal(size=(count, LOADS - 11, 6))
    w[:, 11:] = other / np.linalg.norm(other, axis=-1, keepdims=True)
    return w


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

    k, mu = bodies.active.shape[1], bodies.friction
    normal = np.arange(k) * 3 + 2
    cone = np.zeros((3 * k, 3 * k))
    for i in range(k):
        cone[3 * i, 3 * i + 2], cone[3 * i + 1, 3 * i], cone[3 * i + 2, 3 * i + 1] = -mu, -1.0, -1.0
    price = np.zeros(3 * k)
    price[normal] = 1.0
    cones = [clarabel.ZeroConeT(6), *[clarabel.SecondOrderConeT(3)] * k]
    for i, j in np.ndindex(*status.shape):
        A = np.concatenate([G[i], cone])
        answer = clarabel_cones(
            np.zeros((3 * k,) * 2), price, A, np.append(-wrench[i, j], np.zeros(3 * k)), cones
        )
        if status[i, j] == Status.STALLED:
            continue
        if held[i, j]:
            assert str(answer.status) == "Solved"
            np.testing.assert_allclose(answer.obj_val, out.cost[i, j], rtol=1e-6, atol=1e-8)
        else:
            assert str(answer.status) == "PrimalInfeasible"


DENSE = ["Rover4396", "FC3D_Example1", "FrictionContactProblem00394", "Rover1039", "Rover11211", "Rover4144",
         "Rover4493", "Rover4516", "Rover4622"]  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        n if n in DENSE[:1] else pytest.param(n, marks=pytest.mark.slow("test_local_problems_agree"))
        for n in DENSE
    ],
)
def test_local_problems_agree(name):
    """``min r.W r / 2 + q.r`` over the friction cones, the convex part of a contact problem; and Clarabel's value."""
    dimension, W, q, mu = read_contact_problem(real_data("conformance") / "siconos" / f"{name}.dat")
    W, size = (W + W.T) / 2, np.abs(q).max()
    contacts, n = len(mu), dimension
    blocks, A, cones = [], [], []
    for i in range(contacts):
        tangents = np.zeros((n - 1, n * contacts))
        tangents[np.arange(n - 1), n * i + 1 + np.arange(n - 1)] = 1.0
        height = np.zeros(n * contacts)
        height[n * i] = mu[i]
        blocks.append(jg.lmi.second_order_cone_lmi(tangents, np.zeros(n - 1), height, 0.0))
        A += [-height[None], -tangents]
        cones.append(clarabel.SecondOrderConeT(n))
    constant = block_diag(*(np.asarray(block[0]) for block in blocks))
    matrices = np.array([block_diag(*(np.asarray(b[1])[j] for b in blocks)) for j in range(n * contacts)])
    start = np.zeros(n * contacts)
    start[::n] = 1.0
    out = jg.lmi.lmi_minimize(jg.lmi.LMIProblem(q / size, constant, matrices, start, W))
    answer = clarabel_cones(np.triu(W), q / size, np.concatenate(A), np.zeros(n * contacts), cones)
    assert str(answer.status) == "Solved"
    room = 1e-7 * max(1.0, abs(answer.obj_val))
    assert float(out.lower) - room <= answer.obj_val <= float(out.upper) + room
    assert Status(out.status) in (Status.OPTIMAL, Status.STALLED)
    np.testing.assert_allclose(out.upper, answer.obj_val, rtol=1e-5, atol=1e-6)
