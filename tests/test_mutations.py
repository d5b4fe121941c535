"""What the checker must refuse: damaged answers of every kind, and forgeries that were once accepted."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from damaged_answers import attack, attack_problem, attack_shapes, replaced
from mutated_kinds import kind_of

import jaxgrasp as jg

TOOL = Path(__file__).resolve().parents[1] / "tools" / "check_proofs.py"
EXACTLY, TO_ROUNDING, REFUSED = 23, 24, 25
P = np.array([[-0.03, 0, 0], [0.03, 0, 0]])
PINCH, LOAD = jg.Grasp(P, -P, jg.HardFinger(0.5)), np.array([0, 0, -3.0, 0, 0, 0])


@pytest.fixture(scope="module")
def gentlest():
    return jg.optimize_forces(PINCH, LOAD)


def status_of(answer, grasp=PINCH, load=LOAD, criterion=None):
    return int(jg.prove(grasp, answer, wrench=load, criterion=criterion or jg.Gentlest()).status)


@pytest.mark.parametrize("name", ["verdicts", "gentlest", "epsilon"])
def test_no_false_answer_is_accepted(name):
    kind, rng, false, holes = kind_of(name, 6), np.random.default_rng(0), 0, []
    assert kind.check(kind.answer).all()
    for field in kind.fields:
        counts, found = attack(kind, field, rng)
        _, more = attack_shapes(kind, field)
        false += sum(c["false"] for c in counts.values())
        holes += found + more
    assert false > 250
    assert holes + attack_problem(kind)[1] == []


@pytest.mark.slow("test_no_false_answer_is_accepted")
@pytest.mark.parametrize("name", ["robust, limits", "least norm, limits", "smallest sum", "sum of squares"])
def test_no_false_forces_are_accepted(name):
    kind, rng = kind_of(name, 20), np.random.default_rng(1)
    found = [hole for field in kind.fields for hole in attack(kind, field, rng)[1]]
    assert found + attack_problem(kind)[1] == []


@pytest.mark.parametrize("odd", [1e9, np.inf, np.nan, "much", [1.0, 2.0], 1 + 2j])
def test_the_answer_does_not_choose_its_own_gap(gentlest, odd):
    force = np.asarray(gentlest.force).copy()
    force[[2, 5]] = 30.0
    squeezed = replaced(gentlest, force=force, upper=30.0, lower=0.0, smoothing=odd)
    assert status_of(squeezed) == REFUSED
    assert status_of(replaced(gentlest, smoothing=odd)) != REFUSED


def test_large_forces_lend_no_room_to_the_lower_bound(gentlest):
    force = np.asarray(gentlest.force).copy()
    force[[2, 5]] = 1e15
    assert status_of(replaced(gentlest, status=8, force=force, upper=np.inf, lower=10.0)) == REFUSED
    assert status_of(replaced(gentlest, status=8, upper=np.inf)) == EXACTLY
    assert status_of(replaced(gentlest, status=8, upper=np.inf, lower=3.001)) == REFUSED


@pytest.mark.parametrize("near", [3e-16, 4e-15, 1e-14])
def test_forces_on_the_edge_lend_no_room_to_the_robust_cost(near):
    """Next to the edge a relative error of eps is worth any cost: 3.06 N is not the optimum 3.0128 N."""
    criterion = jg.Robust(1e-3)
    answer = jg.optimize_forces(PINCH, LOAD, criterion=criterion)
    force = np.asarray(answer.force).copy()
    force[[2, 5]] = 3 * (1 + near)
    edge = replaced(answer, force=force, upper=float(criterion.cost(PINCH, force)))
    assert edge.upper - answer.upper > 0.04
    assert status_of(answer, criterion=criterion) != REFUSED
    assert status_of(edge, criterion=criterion) == REFUSED
    assert status_of(replaced(edge, status=8, upper=np.inf, lower=3.02), criterion=criterion) == REFUSED


@pytest.mark.parametrize("speed", [1e-3, 1.0, 100.0, 1e-310])
def test_a_turn_about_the_axis_is_no_slide_along_it(speed):
    """The pinch along z does not notice a turn about z; a load along z it holds."""
    p = P[:, [1, 2, 0]]
    grasp = jg.Grasp(p, -p, jg.HardFinger(0.5))
    twist = np.array([0, 0, -1.0, 0, 0, speed])
    answer = jg.optimize_forces(grasp, LOAD)
    lost = replaced(answer, status=7, force=np.zeros(6), upper=np.inf, lower=np.inf, escape_twist=twist)
    assert status_of(lost, grasp) == REFUSED
    verdict = jg.wrench_resistance(grasp)
    assert jg.check(grasp, verdict)
    assert not jg.check(grasp, replaced(verdict, escape_twist=twist))
    quality = jg.epsilon_quality(grasp, certificate=True)
    assert jg.check(grasp, quality)
    assert not jg.check(grasp, replaced(quality, direction=-twist / np.linalg.norm(twist)))


def test_padding_presses_nothing():
    p = np.concatenate([P, [[0, 0.05, 0]]])
    grasp = jg.Grasp(p, -p, jg.HardFinger(0.5), np.array([True, True, False]))
    answer = jg.optimize_forces(grasp, LOAD)
    assert status_of(answer, grasp) != REFUSED
    for odd in (1e6, np.nan):
        force = np.asarray(answer.force).copy()
        force[-1] = odd
        assert status_of(replaced(answer, force=force), grasp) == REFUSED


@pytest.mark.parametrize("status", range(1, 6))
def test_infinite_ends_of_a_bracket_are_answered(status):
    grasp = kind_of("verdicts", 6).check.args[0][0]
    answer = jg.wrench_resistance(grasp)
    assert not jg.check(grasp, replaced(answer, status=status, lower=np.inf, upper=np.inf))


def test_an_unknown_criterion_is_named(gentlest):
    class Mine(jg.Gentlest):
        """Not one of ours."""

    for other in (Mine(), jg.Gentlest, "gentlest", 5):
        with pytest.raises(ValueError, match="criteria are Gentlest"):
            jg.check(PINCH, gentlest, wrench=LOAD, criterion=other)


@pytest.mark.parametrize("scale", [1e-200, 1e-300, np.inf])
@pytest.mark.parametrize("status", [3, 4])
def test_a_torque_scale_lends_no_room_to_the_upper_bound(scale, status):
    kind = kind_of("epsilon", 6)
    grasp, lane = kind.check.args[0], int(np.flatnonzero(kind.answer.status == 1)[0])
    along = np.eye(kind.answer.direction.shape[-1])[0]
    forged = replaced(
        kind.answer[lane], status=status, lower=0.0, upper=1e-9, torque_scale=scale, direction=along
    )
    assert not jg.check(grasp[lane], forged)


def test_marginal_needs_a_direction_that_nearly_escapes():
    kind = kind_of("epsilon", 6)
    for lane in np.flatnonzero(kind.answer.status == 1):
        forged = replaced(kind.answer[lane], status=3, lower=0.0)
        assert not jg.check(kind.check.args[0][lane], forged)


def test_the_shape_of_a_refusal_is_that_of_the_problem():
    grasp = jg.Grasp(np.tile(P, (4, 1, 1)), np.tile(-P, (4, 1, 1)), jg.HardFinger(0.5))
    load = np.tile(LOAD, (1, 3, 1))
    answer = jg.optimize_forces(grasp, np.tile(LOAD, (4, 3, 1)))
    for force in (answer.force, "no forces"):
        said = replaced(answer, force=force)
        assert jg.check(grasp, said, wrench=load, criterion=jg.Gentlest()).shape == (4, 3)


def floats(rows):
    return [floats(x) if isinstance(x, list) else float(x).hex() for x in rows]


def pinch_line(**fields):
    line = {
        "dimension": 2, "position": floats([[-1, 0], [1, 0]]), "normal": floats([[1, 0], [-1, 0]]),
        "friction": floats([0.5, 0.5]), "torsion": floats([0, 0]), "claim": "RESISTANT", "proof": "exactly",
        "force": floats([[1, 0], [-1, 0]]), "spin": floats([0, 0]), "margin": [None, None],
    }  # fmt: skip
    return line | fields


FORGED = {
    # Frictionless and planar: nothing holds a force along y; a torque about a normal is no substitute.
    "torsion in the plane": pinch_line(
        position=floats([[-1, 0], [1, 0], [-1, 1], [1, 1]]), normal=floats([[1, 0], [-1, 0]] * 2),
        friction=floats([0] * 4), torsion=floats([1] * 4), force=floats([[1, 0], [-1, 0]] * 2), spin=floats([0] * 4),
    ),
    "a number that underflows": pinch_line(torsion=["0x1.0p-1080"] * 2),
    "a number that overflows": pinch_line(friction=["0x1.0p+9999"] * 2),
    "far from rounding": pinch_line(
        claim="NOT_RESISTANT", proof="to rounding", friction=floats([9e-5] * 2), within=9e-5.hex(),
        twist=floats([0, 1, 0]),
    ),
    "letters that do not print": pinch_line(friction=["\u2603\udcff"] * 2),
    "deep": "[" * 100_000,
}  # fmt: skip


def test_the_tool_refuses_forged_lines(tmp_path):
    lines = [json.dumps(pinch_line()), *(x if isinstance(x, str) else json.dumps(x) for x in FORGED.values())]
    path = tmp_path / "proofs.jsonl"
    path.write_text("\n".join(lines) + "\n")
    ascii_only = {"PYTHONIOENCODING": "ascii", "PATH": ""}
    run = [sys.executable, str(TOOL)]
    told = subprocess.run(
        [*run, str(path)], capture_output=True, text=True, timeout=60, env=ascii_only, check=False
    )
    assert told.stderr == ""
    assert told.returncode == 1
    assert "1  RESISTANT exactly" in told.stdout
    assert [line.split(":")[0] for line in told.stdout.splitlines() if "REFUSED:" in line] == [
        f"line {i}" for i in range(2, len(lines) + 1)
    ]


@pytest.mark.parametrize("name", ["/dev/zero", "/nowhere", "."])
def test_the_tool_reads_files_only(name):
    told = subprocess.run(
        [sys.executable, str(TOOL), name], capture_output=True, text=True, timeout=20, check=False
    )
    assert told.returncode == 2
    assert len((told.stdout + told.stderr).splitlines()) == 1
