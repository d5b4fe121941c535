"""Answers with true evidence beside something that is false: refused, never an exception."""

import copy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp import Status
from jaxgrasp.certificates import prove_resistance

pytestmark = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="asks for float64")
LOAD = np.array([0, 0, -3.0, 0, 0, 0])
TOOL = Path(__file__).parent.parent / "tools" / "check_proofs.py"
ASKED = {"wrench": LOAD, "criterion": jg.Gentlest()}


def forged(answer, **fields):
    """A copy with other fields, of any kind."""
    out = copy.copy(answer)
    for name, value in fields.items():
        object.__setattr__(out, name, value)
    return out


@pytest.fixture(scope="module")
def held():
    """Five soft fingers, and a sixth contact that does not count."""
    position = np.random.default_rng(3).normal(size=(6, 3))
    grasp = jg.Grasp(position, -position, jg.SoftFinger(0.8, 0.1), active=np.arange(6) < 5)
    return grasp, jg.wrench_resistance(grasp)


@pytest.fixture(scope="module")
def pinch():
    """Two hard fingers that carry 3 N; the gentlest forces cost 3 N."""
    grasp = jg.Grasp([[-0.03, 0, 0], [0.03, 0, 0]], [[1.0, 0, 0], [-1, 0, 0]], jg.HardFinger(0.5))
    return grasp, jg.optimize_forces(grasp, LOAD)


def claim(grasp, **fields):
    """NOT_RESISTANT of six unknowns, without any bracket."""
    size = grasp.position.shape[-2] * len(grasp.model.components(3))
    nothing = {
        "status": np.int32(2), "lower": -np.inf, "upper": np.inf, "rank": np.int32(6),
        "internal_force": np.zeros(size), "escape_twist": np.zeros(6), "bound_twist": np.zeros(6),
    }  # fmt: skip
    return SimpleNamespace(**{**nothing, **fields})


def test_an_internal_force_that_does_not_balance(held):
    grasp, answer = held
    force = np.asarray(answer.internal_force).copy()
    assert jg.check(grasp, answer)
    force[2] *= 1.001
    assert not jg.check(grasp, forged(answer, internal_force=force, lower=-1.0))


def test_a_contact_that_does_not_count_presses_nothing(held):
    grasp, answer = held
    force = np.asarray(answer.internal_force).copy()
    force[-2] = 5.0
    assert not jg.check(grasp, forged(answer, internal_force=force))


@pytest.mark.parametrize("twist", [np.eye(6)[0], np.full(6, np.nan)], ids=["one", "nan"])
def test_a_grasp_that_holds_names_no_escape(held, pinch, twist):
    assert not jg.check(held[0], forged(held[1], escape_twist=twist))
    assert not jg.check(pinch[0], forged(pinch[1], escape_twist=twist), **ASKED)


@pytest.mark.parametrize("field", [{"status": 1.0}, {"rank": 6.0}, {"status": np.nan}], ids=str)
def test_a_status_is_a_whole_number(held, field):
    assert not jg.check(held[0], forged(held[1], **field))


def test_an_escape_twist_far_from_every_true_one():
    """The third contact opposes a motion along y at full speed; only motions along z are free."""
    normal = np.array([[1.0, 0, 0], [1, 1e-10, 0], [0, -1, 0]])
    grasp = jg.Grasp(np.zeros((3, 3)), normal, jg.Frictionless(np.zeros(3)))
    true, false = np.array([0, 0, 1.0, 0, 0, 0]), np.array([0, 1, 1e-3, 0, 0, 0])
    assert prove_resistance(grasp, claim(grasp, rank=np.int32(2), escape_twist=true)).status == 23
    assert prove_resistance(grasp, claim(grasp, rank=np.int32(2), escape_twist=false)).status == 25


def test_a_speed_that_is_next_to_nothing():
    """Normal and tangential speeds 10^320 apart: no float holds their ratio."""
    grasp = jg.Grasp([[0, 0, 0.0], [0.1, 0, 0]], [[1.0, 0, 0], [-1, 0, 0]], jg.SoftFinger(0.5, 1e-3))
    twist = np.array([1e-4, 1e-320, 0, 1, 0, 0])
    assert prove_resistance(grasp, claim(grasp, escape_twist=twist)).status == 25


@pytest.mark.parametrize("squeeze", [1e3, 1e12, 1e14])
def test_a_bound_gains_nothing_by_forces_that_are_far_too_large(pinch, squeeze):
    grasp, answer = pinch
    force = np.asarray(answer.force).reshape(2, 3).copy()
    force[:, 2] = squeeze
    stalled = forged(answer, status=np.int32(8), force=force.ravel(), upper=squeeze)
    assert jg.check(grasp, forged(stalled, lower=2.9 if squeeze < 1e13 else 1.5), **ASKED)
    assert not jg.check(grasp, forged(stalled, lower=3.001), **ASKED)


def test_beside_what_is_claimed_nothing_is_said(pinch):
    grasp, _ = pinch
    wrench = np.array([0, 0, -3.0, 0.1, 0, 0])
    lost = jg.optimize_forces(grasp, wrench)
    assert lost.status == Status.INFEASIBLE
    question = {**ASKED, "wrench": wrench}
    assert jg.check(grasp, lost, **question)
    assert not jg.check(grasp, forged(lost, load_twist=np.ones(6)), **question)
    broken = jg.Grasp([[-0.03, 0, 0], [0.03, 0, 0]], [[1.0, 0, 0], [0, 0, 0]], jg.HardFinger(0.5))
    verdict, forces = jg.wrench_resistance(broken), jg.optimize_forces(broken, LOAD)
    assert jg.check(broken, verdict) and jg.check(broken, forces, **ASKED)
    assert np.isnan(jg.prove(broken, forces, **ASKED).lower)
    assert not jg.check(broken, forged(verdict, internal_force=np.ones(6)))
    assert not jg.check(broken, forged(forces, force=np.ones(6)), **ASKED)


def test_a_turned_jacobian_is_rounded():
    """J is across the normal, (1, 7, 5) . (5, 0, -1) = 0: no joint feels the force, and 8.66 N hold the load."""
    normal = np.array([1.0, 7, 5])
    grasp = jg.Grasp(0.01 * np.array([-normal, normal]), [normal, -normal], jg.Frictionless(np.zeros(2)))
    J = np.zeros((6, 1))
    J[:3, 0] = 2.0**20 * np.array([5.0, 0, -1])
    limits = jg.TorqueLimits(J, [1e-12], axes="body")
    wrench = np.concatenate([-normal, np.zeros(3)])
    question = {"wrench": wrench, "criterion": jg.Gentlest(), "torque_limits": limits}
    answer = jg.optimize_forces(grasp, wrench, torque_limits=limits)
    assert answer.status == Status.OPTIMAL and jg.check(grasp, answer, **question)
    twist = np.concatenate([-normal / np.linalg.norm(normal), np.zeros(3)])
    for rate in (1.0, -1.0):
        false = forged(
            answer, status=np.int32(7), force=np.zeros(2), lower=np.inf, upper=np.inf, escape_twist=twist,
            joint_rates=np.array([rate * 8589934592.0 * 1.0000001]), load_twist=np.zeros(6),
        )  # fmt: skip
        assert not jg.check(grasp, false, **question)


@pytest.mark.parametrize(
    "field",
    [
        {"status": np.nan}, {"status": np.inf}, {"status": 1.5}, {"facets": np.arange(6)}, {"facets": np.int32(3)},
        {"forces": np.zeros((0, 24))}, {"facets": np.zeros((0, 6), int)}, {"norm": ["L1"]}, {"torque_scale": 1e-300},
    ],
    ids=list("abcdefghi"),
)  # fmt: skip
def test_a_damaged_polytope_is_refused_without_an_exception(held, field):
    grasp, _ = held
    size = 24
    damaged = SimpleNamespace(
        status=np.int32(1), lower=0.1, upper=99.0, direction=np.eye(6)[0], touching=np.zeros(size), norm="L1",
        forces=np.zeros((7, size)), facets=np.zeros((7, 6), int), torque_scale=1.0,
    )  # fmt: skip
    answer = jg.quality.EpsilonQuality(**{**vars(damaged), "smooth": np.bool_(False)})
    assert not jg.check(grasp, forged(answer, **field))


def test_a_line_as_deep_as_python_goes(tmp_path):
    """JSON is read a little deeper than a message about it can be written."""
    lines = (
        '{"dimension": 3, "position": [['
        + '{"a": ' * depth
        + "1"
        + "}" * depth
        + ', "0x0.0p+0", "0x0.0p+0"]]}'
        for depth in range(960, 1000)
    )
    (tmp_path / "p.jsonl").write_text("\n".join(lines))
    told = subprocess.run(
        [sys.executable, "-I", TOOL, tmp_path / "p.jsonl"], capture_output=True, text=True, timeout=60
    )
    assert not told.stderr and told.stdout.count("REFUSED: no") == 40
