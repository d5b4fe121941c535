"""What counts as proved: exactly, to rounding, or not at all. Forged, damaged and hard cases with known answers."""

import json
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grasps import random_coefficients, random_contacts

import jaxgrasp as jg
from jaxgrasp import Status
from jaxgrasp.certificates import dyadic, elimination, enclosures, polytope, proof_lines, prove_epsilon
from jaxgrasp.certificates.rank import rounding_of, smallest_singular_value

EXACTLY, TO_ROUNDING, REFUSED = Status.PROVED_EXACTLY, Status.PROVED_TO_ROUNDING, Status.REFUSED
X64 = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="asks for float64")
TOOL = Path(__file__).parent.parent / "tools" / "check_proofs.py"
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
LOAD = np.array([0, 0, -3.0, 0, 0, 0])


def numbers(value):
    return [numbers(x) for x in value] if isinstance(value, list) else float.fromhex(value)


@pytest.fixture(scope="module")
def hard():
    """Cases that once went wrong, numbers as hexadecimal floats."""
    cases = json.loads((Path(__file__).parent / "tables" / "hard_cases.json").read_text())
    for case in cases.values():
        for name, value in case.items():
            case[name] = np.array(value if name == "facets" else numbers(value))
    return cases


def replaced(answer, **fields):
    names = list(fields)
    values = [jnp.asarray(x) for x in fields.values()]
    return eqx.tree_at(lambda a: [getattr(a, n) for n in names], answer, values)


def pinch(**fields):
    """Two hard fingers at x = -0.03 and 0.03 m, mu 0.5, that carry 3 N: the gentlest forces cost 3 N."""
    grasp = jg.Grasp([[-0.03, 0, 0], [0.03, 0, 0]], [[1.0, 0, 0], [-1, 0, 0]], jg.HardFinger(0.5))
    answer = jg.optimize_forces(grasp, LOAD)
    return grasp, replaced(answer, **fields) if fields else answer


def asked(wrench=LOAD):
    return {"wrench": wrench, "criterion": jg.Gentlest()}


# Forged ------------------------------------------------------------------------------------------------------


@X64
def test_a_polytope_that_leaves_the_origin_out_proves_nothing(hard):
    """Seven facets of a simplex beside the origin; a ray through a ridge once counted as met."""
    case = hard["forged_polytope"]
    grasp = jg.Grasp(case["position"], case["normal"], jg.HardFinger(0.8))
    answer = SimpleNamespace(
        status=np.int32(1), lower=case["lower"], upper=np.float64(1.0), direction=case["direction"],
        touching=np.zeros(12), forces=case["forces"], facets=case["facets"], torque_scale=case["scale"], norm="L1",
    )  # fmt: skip
    assert prove_epsilon(grasp, answer).status == REFUSED
    verdict = jg.wrench_resistance(grasp)
    assert verdict.status == Status.NOT_RESISTANT
    assert jg.prove(grasp, verdict).status == EXACTLY


@X64
@pytest.mark.parametrize("size", [1.0, 1e-165, 1e-300, 1e300])
def test_evidence_is_brought_to_size_one(size):
    """Squares of a tiny twist are 0, and 0 is not smaller than 0."""
    down = np.array([0, 0, -1.0, 0, 0, 0]) * size
    grasp, forged = pinch(
        status=jnp.int32(7), escape_twist=down, lower=np.inf, upper=np.inf, force=np.zeros(6)
    )
    assert not jg.check(grasp, forged, **asked())


@X64
@pytest.mark.parametrize("size", [1.0, 1e14, -1e14, 1e300, 0.0, np.nan])
def test_rounding_depends_on_the_problem_not_on_the_evidence(size):
    """Forces squeezed to 30 N balance the load, and 3 N suffice."""
    grasp, answer = pinch()
    squeezed = np.asarray(answer.force).reshape(2, 3).copy()
    squeezed[:, 2] = 30.0
    forged = replaced(
        answer,
        force=squeezed.ravel(),
        upper=30.0,
        lower=30.0,
        load_twist=size * np.asarray(answer.load_twist),
    )
    assert jg.check(grasp, answer, **asked())
    assert not jg.check(grasp, forged, **asked())


def generic(k=5, seed=3):
    position = np.random.default_rng(seed).normal(size=(k, 3))
    grasp = jg.Grasp(position, -position, jg.SoftFinger(0.8, 0.1))
    return grasp, jg.wrench_resistance(grasp)


@X64
@pytest.mark.parametrize(
    "forged",
    [
        {"lower": 1e9}, {"lower": 1e9, "upper": 2e9}, {"rank": jnp.int32(2)}, {"lower": np.nan}, {"upper": np.nan},
        {"upper": -np.inf, "lower": -np.inf}, {"status": jnp.int32(2)}, {"status": jnp.int32(3)},
        {"status": jnp.int32(5)}, {"status": jnp.int32(6)}, {"bound_twist": np.zeros(6)},
    ],
    ids=str,
)  # fmt: skip
def test_every_field_is_proved(forged):
    grasp, answer = generic()
    assert answer.status == Status.RESISTANT and jg.prove(grasp, answer).status == EXACTLY
    assert not jg.check(grasp, replaced(answer, **forged))


@X64
def test_both_ends_of_the_bracket_are_proved_to_the_last_digits():
    grasp, answer = generic()
    lower, upper = float(answer.lower), float(answer.upper)
    width = upper - lower
    assert width < 1e-7
    assert not jg.check(grasp, replaced(answer, lower=lower + 0.999 * width))
    assert not jg.check(grasp, replaced(answer, upper=upper - 0.999 * width))
    assert jg.check(grasp, replaced(answer, lower=lower - 1e-12, upper=upper + 1e-12))


@X64
def test_the_callers_problem_is_proved():
    grasp, answer = pinch()
    assert jg.check(grasp, answer, **asked())
    for wrench in (2 * LOAD, -LOAD, LOAD + 1e-9, LOAD * np.nan):
        assert not jg.check(grasp, answer, **asked(wrench))
    assert not jg.check(grasp, answer, wrench=LOAD, criterion=jg.SmallestSum())
    assert not jg.check(grasp, answer, **asked(), max_normal=2.9)


@X64
@pytest.mark.parametrize(
    "field",
    [
        {"status": np.zeros((1, 1), np.int32)}, {"lower": np.array("high")}, {"upper": np.array(1j)},
        {"internal_force": np.zeros(3)}, {"escape_twist": np.zeros((6, 1))}, {"rank": None},
        {"bound_twist": np.array([object()] * 6)}, {"status": [[1], [2, 3]]}, {"lower": {}},
    ],
    ids=list("abcdefghi"),
)  # fmt: skip
def test_a_malformed_answer_is_refused_without_an_exception(field):
    from jaxgrasp.certificates import Malformed, prove_resistance

    grasp, answer = generic()
    names = ("status", "lower", "upper", "rank", "internal_force", "escape_twist", "bound_twist")
    whole = {name: np.asarray(getattr(answer, name)) for name in names}
    assert prove_resistance(grasp, SimpleNamespace(**whole)).status == EXACTLY
    with pytest.raises(Malformed):
        prove_resistance(grasp, SimpleNamespace(**{**whole, **field}))
    moved = eqx.tree_at(lambda a: a.lower, answer, jnp.zeros((2, 2)))
    assert not jg.check(grasp, moved)


# Hard --------------------------------------------------------------------------------------------------------


@X64
@pytest.mark.parametrize("name", ["nearly_deficient", "ill_conditioned"])
def test_nothing_is_said_that_is_refused(hard, name):
    """In 70 digits the first is resistant with t* about 0.4; the margin of the second is -0.63631069."""
    case = hard[name]
    grasp = jg.Grasp(case["position"], case["normal"], jg.SoftFinger(case["friction"], case["torsion"]))
    answer = jg.wrench_resistance(grasp)
    assert jg.check(grasp, answer)
    if name == "ill_conditioned":
        assert answer.lower <= -0.636310685 and answer.upper >= -0.636310695
        assert answer.status in (Status.NOT_RESISTANT, Status.UNDECIDED)
        forged = replaced(answer, lower=-0.6355388955, upper=-0.6355388952)
        assert not jg.check(grasp, forged)
    else:
        assert answer.status in (Status.RESISTANT, Status.UNDECIDED)
        assert not jg.check(grasp, replaced(answer, status=jnp.int32(2)))


@X64
@pytest.mark.parametrize(
    ("size", "dtype"),
    [(1.0, "float64"), (1e-160, "float64"), (1e155, "float64"), (1e-20, "float32"), (1e20, "float32")],
)
def test_sizes_of_every_kind(size, dtype):
    grasp = jg.Grasp(
        (size * TETRAHEDRON).astype(dtype), -TETRAHEDRON.astype(dtype), jg.HardFinger(np.asarray(0.5, dtype))
    )
    answer = jg.wrench_resistance(grasp)
    assert answer.status in (Status.RESISTANT, Status.INVALID, Status.UNDECIDED)
    assert jg.check(grasp, answer)


@X64
@pytest.mark.parametrize(("mu", "dtype"), [(1e-14, "float64"), (1e-6, "float32")])
def test_friction_below_rounding_holds_only_by_rounding(mu, dtype):
    """In exact arithmetic the grasp is resistant, t* = 1; no measured mu can tell it from 0."""
    grasp = jg.Grasp(
        TETRAHEDRON.astype(dtype), -TETRAHEDRON.astype(dtype), jg.HardFinger(np.asarray(mu, dtype))
    )
    answer = jg.wrench_resistance(grasp)
    found = jg.prove(grasp, answer)
    assert found.status in (EXACTLY, TO_ROUNDING)
    if answer.status == Status.NOT_RESISTANT:
        assert found.status == TO_ROUNDING and 0 < found.distance <= 64 * np.finfo(dtype).eps
        assert "only by rounding" in found.sentence()
    else:
        assert answer.status == Status.RESISTANT


@X64
@pytest.mark.parametrize("turned", [False, True])
def test_two_fingers_on_a_line(turned):
    """Nothing holds the turn about the line; turned, the line is straight only to rounding, but two points have one."""
    R = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0] if turned else np.eye(3)
    p = np.array([[-0.03, 0, 0], [0.03, 0, 0]]) @ R.T
    grasp = jg.Grasp(p, -p, jg.HardFinger(0.5))
    answer = jg.wrench_resistance(grasp)
    assert answer.status == Status.NOT_RESISTANT and answer.rank == 5
    assert jg.prove(grasp, answer).status == EXACTLY


@X64
def test_three_fingers_on_a_line_hold_only_by_rounding():
    direction = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    p = np.array([-0.03, 0.01, 0.03])[:, None] * direction
    grasp = jg.Grasp(p, [[1.0, 0, 0], [0, 1, 0], [0, 0, -1.0]], jg.HardFinger(0.5))
    answer = jg.wrench_resistance(grasp)
    found = jg.prove(grasp, answer)
    assert answer.status == Status.NOT_RESISTANT and found.status == TO_ROUNDING
    assert 0 < found.distance < 64 * np.finfo(float).eps
    assert not jg.check(grasp, replaced(answer, escape_twist=np.eye(6)[0]))


# Genuine -----------------------------------------------------------------------------------------------------


@X64
@pytest.mark.parametrize("model", ["soft", "hard", "frictionless", "planar"])
def test_what_the_solver_says_is_proved(model):
    dimension = 2 if model == "planar" else 3
    rng = np.random.default_rng(7)
    p, n, kind = random_contacts(rng, 150, 5, dimension)
    mu, gamma = random_coefficients(rng, 150, 5)
    models = {"soft": jg.SoftFinger(mu, gamma), "frictionless": jg.Frictionless(0 * mu)}
    grasp = jg.Grasp(p, n, models.get(model, jg.HardFinger(mu)))
    answer = jg.wrench_resistance(grasp)
    found = jg.prove(grasp, answer)
    assert (found.status != REFUSED).all()
    general = (kind < 4) & (mu > 0).all(axis=1)
    if model != "frictionless":
        assert (found.status[general] == EXACTLY).all()
    held = np.asarray(answer.status) == Status.RESISTANT
    assert (found.status[held] == EXACTLY).all()  # by rounding nothing holds
    assert (found.distance[found.status == EXACTLY] == 0).all()


# Written down ------------------------------------------------------------------------------------------------


def written(path, lines):
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    told = subprocess.run([sys.executable, "-I", TOOL, path], capture_output=True, text=True, timeout=120)
    assert not told.stderr
    return told


@pytest.fixture(scope="module")
def lines():
    rng = np.random.default_rng(5)
    p, n, _ = random_contacts(rng, 40, 4, 3)
    mu, gamma = random_coefficients(rng, 40, 4)
    grasp = jg.Grasp(p, n, jg.SoftFinger(mu, gamma))
    answer = jg.wrench_resistance(grasp)
    return [x for x in proof_lines(grasp, answer, jg.prove(grasp, answer)) if x is not None]


@X64
def test_proofs_can_be_sent(lines, tmp_path):
    told = written(tmp_path / "p.jsonl", lines)
    assert told.returncode == 0 and "0  REFUSED" in told.stdout
    assert sum(int(row.split()[0]) for row in told.stdout.splitlines()) == len(lines) >= 38


def _first(lines, claim):
    return json.loads(json.dumps(next(x for x in lines if x["claim"] == claim and x["margin"][0])))


def _bit(value):
    """The last bit of a number turned."""
    head = value[0] if isinstance(value, list) else value
    moved = float(np.nextafter(float.fromhex(head), np.inf)).hex()
    return [moved, *value[1:]] if isinstance(value, list) else moved


@X64
def test_forged_lines_are_refused_by_number(lines, tmp_path):
    yes, no = _first(lines, "RESISTANT"), _first(lines, "NOT_RESISTANT")
    forged = []
    for line, field, value in [
        (yes, "claim", "NOT_RESISTANT"), (yes, "claim", 7), (yes, "margin", [(2.0).hex(), (3.0).hex()]),
        (yes, "margin", [None, (-1.0).hex()]), (yes, "friction", ["0x0.0p+0"] * 4),
        (yes, "force", [["0x0.0p+0"] * 3] * 4),
        (yes, "position", yes["normal"]), (yes, "force", None), (yes, "spin", []), (no, "twist", ["0x0.0p+0"] * 6),
        (no, "claim", "RESISTANT"), (no, "proof", "to rounding"), (no, "twist", ["nan"] * 6), (yes, "dimension", 2),
        (no, "twist", ["0x1.0p+9999"] * 6), (no, "twist", ["1e5"] * 6), (yes, "dimension", 3.0),
        (yes, "normal", [[]] * 4),
    ]:  # fmt: skip
        forged.append({**line, field: value})
    moved = json.loads(json.dumps(yes))
    moved["force"][0][0] = _bit(moved["force"][0][0])
    told = written(tmp_path / "p.jsonl", [*forged, moved, yes])
    assert told.returncode == 1
    refused = [f"line {i + 1}: REFUSED" in told.stdout for i in range(len(forged) + 2)]
    assert refused == [True] * (len(forged) + 1) + [False]


def test_damaged_lines_are_refused_by_number(tmp_path):
    path = tmp_path / "p.jsonl"
    huge = '{"claim": ' + "9" * 1_100_000 + "}"
    path.write_bytes(b"\n[1]\n{" + b"[" * 5000 + b"\n\xff\xfe\n" + huge.encode() + b'\n{"claim": 1')
    told = subprocess.run([sys.executable, "-I", TOOL, path], capture_output=True, text=True, timeout=60)
    assert told.returncode == 1 and not told.stderr
    assert [f"line {i}: REFUSED" in told.stdout for i in range(1, 7)] == [True] * 6
    assert "line 5: REFUSED: longer than 1000000 bytes" in told.stdout


def test_the_checker_of_lines_is_short_and_alone():
    text = TOOL.read_text()
    assert len(text.splitlines()) <= 250
    imported = {line.split()[1] for line in text.splitlines() if line.startswith(("import ", "from "))}
    assert imported == {"json", "math", "os", "re", "sys", "fractions"}


# Parts -------------------------------------------------------------------------------------------------------


def test_floats_are_integers():
    values = [0.0, -0.1, 5e-324, 1e300, 3.0]
    found, exponent = dyadic.integers(values)
    assert [Fraction(x) * Fraction(2) ** exponent for x in found] == [Fraction(v) for v in values]


def test_elimination_is_exact():
    rng = np.random.default_rng(1)
    for _ in range(50):
        columns = rng.integers(-9, 10, (5, 4))
        columns[4] = columns[0] + 2 * columns[1]
        right = columns.T @ rng.integers(-5, 6, 5)
        x, d, rank = elimination.solve(columns.tolist(), right.tolist())
        assert d > 0 and (columns.T @ np.array(x, object) == d * right).all()
        assert rank == np.linalg.matrix_rank(columns)
        null = elimination.null_vector(columns[:3].tolist(), [3, 1, 4, 1])
        assert null and (columns[:3] @ np.array(null, object) == 0).all()
    assert elimination.solve([[1, 0], [2, 0]], [1, 1]) is None
    assert elimination.null_vector(np.eye(3, dtype=int).tolist(), [1, 2, 3]) is None
    assert elimination.independent([[1, 0, 2], [0, 1, 0]]) and not elimination.independent([[1, 2], [2, 4]])


@pytest.mark.parametrize("value", [2, Fraction(1, 3), Fraction(10) ** 200, Fraction(1, 10**200), 4, 0])
def test_roots_lie_between_fractions(value):
    value = Fraction(value)
    low, high = (f(value, 40) for f in (enclosures.root_below, enclosures.root_above))
    assert low * low <= value <= high * high and high - low <= high * Fraction(1, 10**39)


def test_the_smallest_singular_value_is_never_overestimated():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(400, 6, 12))
    A[:, 5] = A[:, 4] + 10.0 ** rng.uniform(-17, 0, (400, 1)) * A[:, 5]
    found = smallest_singular_value(A, rounding_of(A))
    true = np.linalg.svd(A, compute_uv=False)[:, -1]
    assert (found <= true * (1 + 1e-12)).all()
    assert (found[true > 1e-5] > 0.3 * true[true > 1e-5]).all()


def test_a_cube_surrounds_its_ball():
    """Twelve triangles; turned so that no ray of ours meets a ridge by chance; one facet less is open."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    facets = np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])
    assert polytope.ball_inside(corners, facets) == pytest.approx(1, rel=1e-12)
    assert polytope.ball_inside(corners, facets) <= 1
    assert polytope.ball_inside(corners, facets[1:]) == 0
    assert polytope.ball_inside(corners + np.array([1.5, 0, 0]), facets) == 0
    assert polytope.ball_inside(corners, np.concatenate([facets, facets])) == 0
