"""``jaxgrasp forces`` as a user runs it: three hard fingers throughout, so that the tests compile little."""

import json
import os
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import jaxgrasp as jg
from jaxgrasp import Status
from jaxgrasp.backend.device import precision
from jaxgrasp.cli.main import main
from jaxgrasp.core.errors import UserError
from jaxgrasp.forces.named_criteria import CRITERIA, make_criterion
from jaxgrasp.formats.parquet import read_metadata
from jaxgrasp.jobs import forces as loading
from jaxgrasp.jobs.forces_request import ForcesRequest, plan_forces
from jaxgrasp.jobs.summary import ForceSummary
from jaxgrasp.report.answers import ForceAnswer
from jaxgrasp.report.force_words import contact_rows, cost_words, infeasible_words, load_words

WEIGHT = 0.3 * 9.81
LOAD = ["--mass", "0.3", "--gravity", "0,0,-1"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, dtype):
    """A screened file of 300 grasps, and the forces of all of them, as the command line writes them."""
    folder = tmp_path_factory.mktemp("forces")
    screened, forces = str(folder / "mug.grasps.parquet"), str(folder / "forces.parquet")
    sample = ["--samples", "300", "--fingers", "3", "--chunk", "256", "--dtype", dtype]
    assert main(["screen", "mug", *sample, "-o", screened]) == 0
    assert main(["forces", screened, *LOAD, "--chunk", "128", "-o", forces]) == 0
    return folder


@pytest.fixture
def screened(folder):
    return str(folder / "mug.grasps.parquet")


@pytest.fixture
def written(folder):
    return pq.read_table(folder / "forces.parquet")


def column(table, name, *shape):
    """A column as an array; nulls are zeros."""
    values = table[name].to_pylist()
    return np.asarray([np.zeros(shape) if value is None else value for value in values], float)


def as_asked(table, metadata):
    """Grasp and answer from the file alone, in float64."""
    n, k = len(table), metadata["fingers"]
    position = column(table, "position", k, 3) - np.asarray(metadata["centre_of_mass"])
    grasp = jg.Grasp(
        position,
        column(table, "normal", k, 3),
        jg.HardFinger(column(table, "friction", k)),
        column(table, "active", k) > 0,
    )
    nothing = np.zeros(n, np.int32)
    answer = jg.OptimalForces(
        status=table["status"].to_numpy(),
        force=column(table, "force", 3 * k),
        upper=table["cost"].to_numpy(),
        lower=table["lower"].to_numpy(),
        escape_twist=column(table, "escape_twist", 6),
        load_twist=column(table, "load_twist", 6),
        joint_rates=np.zeros((n, 0)),
        smooth=nothing > 0,
        iterations=nothing,
        stop=nothing,
    )
    return grasp, answer, np.asarray(metadata["load"]["wrench"])


# Many grasps -----------------------------------------------------------------------------------------


def test_every_answer_in_the_file_is_proved_again(folder, written):
    metadata = read_metadata(folder / "forces.parquet")
    with precision("float64"):
        grasp, answer, wrench = as_asked(written, metadata)
        proved = jg.check(grasp, answer, wrench=wrench, criterion=jg.Gentlest())
        wrong = jg.check(grasp, answer, wrench=-wrench, criterion=jg.Gentlest())
    assert proved.all()
    claims = np.isin(answer.status, (Status.OPTIMAL, Status.INFEASIBLE))
    assert claims.sum() > 290 and not wrong[claims].any()
    assert (answer.status == Status.OPTIMAL).sum() > 20
    assert (answer.status == Status.INFEASIBLE).sum() > 200


def test_the_forces_balance_the_load_in_the_meshs_frame(folder, written):
    metadata = read_metadata(folder / "forces.parquet")
    held = written.filter(pa.array(written["status"].to_numpy() == Status.OPTIMAL))
    pull = column(held, "contact_force", 3, 3)
    lever = column(held, "position", 3, 3) - np.asarray(metadata["centre_of_mass"])
    force, torque = pull.sum(axis=1), np.cross(lever, pull).sum(axis=1)
    size = np.linalg.norm(pull, axis=(1, 2))
    assert np.abs(force - [0, 0, WEIGHT]).max(axis=1) == pytest.approx(0, abs=1e-11 * size.max())
    assert np.abs(torque).max(axis=1) == pytest.approx(0, abs=1e-12 * size.max())
    normal = column(held, "normal", 3, 3)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    press = np.sum(normal * pull, axis=-1)
    rub = np.linalg.norm(pull - press[..., None] * normal, axis=-1)
    assert (rub <= 0.5 * press + 1e-9 * size[:, None]).all()
    assert np.max(press, axis=1) == pytest.approx(held["cost"].to_numpy(), rel=1e-12)


def test_nulls_and_numbers_fit_the_status(written):
    status = written["status"].to_numpy()
    lost = status == Status.INFEASIBLE
    for name in ("force", "contact_force", "load_twist"):
        assert (written[name].is_null().to_numpy() == lost).all()
    assert (written["escape_twist"].is_null().to_numpy() == ~lost).all()
    assert np.isposinf(written["cost"].to_numpy()[lost]).all()
    work = column(written, "escape_twist", 6)[lost] @ [0, 0, -WEIGHT, 0, 0, 0]
    assert (work > 0).all()
    held = status == Status.OPTIMAL
    cost, lower = written["cost"].to_numpy()[held], written["lower"].to_numpy()[held]
    assert (lower <= cost).all() and (cost - lower <= 4.1e-8 * np.maximum(cost, WEIGHT)).all()


def test_metadata_say_what_was_asked(folder, screened, dtype):
    metadata = read_metadata(folder / "forces.parquet")
    assert metadata["load"] == {
        "wrench": [0, 0, -WEIGHT, 0, 0, 0],
        "mass": 0.3,
        "gravity": [0, 0, -1],
        "g": 9.81,
    }
    assert metadata["criterion"] == {"name": "gentlest", "weight": None, "length": None, "unit": "N"}
    source = read_metadata(Path(screened))
    for name in ("object", "unit", "centre_of_mass", "model", "fingers"):
        assert metadata[name] == source[name]
    assert metadata["contacts"]["name"] == screened and len(metadata["contacts"]["sha256"]) == 64
    assert metadata["max_normal"] is None and metadata["dimension"] == 3 and source["dtype"] == dtype
    assert "--gravity 0.0,0.0,-1.0" in metadata["command"]


def test_status_chooses_rows_and_chunks_change_no_bit(capsys, screened, written):
    verdict = pq.read_table(screened, columns=["status"])["status"].to_numpy()
    chosen = np.flatnonzero(verdict == Status.RESISTANT)
    words = ["forces", screened, *LOAD, "--status", "resistant", "--chunk", "7", "--threads", "2"]
    assert main(words) == 0
    told = capsys.readouterr()
    assert told.err == "" and "written to mug.forces.parquet" in told.out
    found = pq.read_table("mug.forces.parquet")
    assert found["row"].to_pylist() == list(chosen) and len(chosen) > 10
    assert pq.ParquetFile("mug.forces.parquet").metadata.row_group(0).num_rows == 7
    assert found.equals(written.take(chosen))
    assert sorted(os.listdir()) == ["mug.forces.parquet"]


def test_the_summary_counts_and_quantiles(capsys, screened, written):
    assert main(["forces", screened, "--mass", "0.3", "-o", "again.parquet", "--chunk", "128"]) == 0
    told = capsys.readouterr()
    (line,) = told.err.splitlines()
    assert line == "jaxgrasp: down is taken to be -z of the mesh's frame; --gravity says otherwise"
    status, cost = written["status"].to_numpy(), written["cost"].to_numpy()
    held = status == Status.OPTIMAL
    claims = held.sum() + (status == Status.INFEASIBLE).sum()
    assert f"│ optimal    │ {held.sum():>6,} │" in told.out
    assert f"proved again in float64 without the solver: {claims:,} of {claims:,}" in told.out
    assert "cost in N (gentlest), where optimal" in told.out and "grasps/s overall" in told.out
    assert "Load: 0.3 kg, 2.943 N at the centre of mass along (0, 0, -1)." in told.out
    line = next(line for line in told.out.splitlines() if line.startswith("│") and line.count("│") == 8)
    smallest, *_, largest = (float(word) for word in line.strip("│").split("│"))
    assert (smallest, largest) == pytest.approx((cost[held].min(), cost[held].max()), rel=1e-3)
    assert pq.read_table("again.parquet").equals(written)


def test_a_file_of_forces_is_a_source_too(folder, written):
    answers = str(folder / "forces.parquet")
    assert main(["forces", answers, *LOAD, "--status", "optimal", "-o", "twice.parquet"]) == 0
    again = pq.read_table("twice.parquet")
    held = written.filter(pa.array(written["status"].to_numpy() == Status.OPTIMAL))
    assert again.drop_columns(["row"]).equals(held.drop_columns(["row"]))


def test_invalid_grasps_keep_their_rows(capsys, dtype):
    grasp = ring()
    position = np.stack([np.asarray(grasp.position, float)] * 3)
    normal = np.stack([np.asarray(grasp.normal, float)] * 3)
    normal[1, 0] = 0.0
    contacts = pa.table({"grasp_id": [4, 5, 9], "position": position.tolist(), "normal": normal.tolist()})
    pq.write_table(contacts, "ring.parquet")
    words = ["--com", "0,0,0", "--chunk", "256", "--dtype", dtype, "-o", "verdicts.parquet"]
    assert main(["screen", "ring.parquet", *words]) == 0
    assert main(["forces", "verdicts.parquet", *LOAD, "-o", "out.parquet"]) == 0
    found = pq.read_table("out.parquet")
    assert found["status"].to_pylist() == [Status.OPTIMAL, Status.INVALID, Status.OPTIMAL]
    assert found["grasp_id"].to_pylist() == [4, 5, 9]
    assert found["force"].is_null().to_pylist() == [False, True, False]
    assert np.isnan(found["cost"].to_numpy()[1])
    capsys.readouterr()
    assert main(["explain", "out.parquet", "1"]) == 0
    told = capsys.readouterr().out
    assert Status.INVALID.sentence in told and "Checked" not in told and "Cost" not in told


# One grasp -------------------------------------------------------------------------------------------


def ring(mu=0.5):
    """Three fingers at 120 degrees on a circle of 4 cm; each carries a third of a weight along the axis."""
    angle = 2 * np.pi * np.arange(3) / 3
    normal = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    with precision("float64"):
        return jg.Grasp(-0.04 * normal, normal, jg.HardFinger(mu))


def test_a_saved_grasp_in_words_has_the_closed_form(capsys):
    jg.save_grasp(ring(), "ring.npz")
    assert main(["forces", "ring.npz", "--wrench", "0,0,-3,0,0,0", "-o", "ring.parquet"]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    lines = told.out.splitlines()
    assert lines[:3] == [
        "Row 0 of ring.npz (grasp 0, hard contacts):",
        "Load: (0, 0, -3) N at the centre of mass and (0, 0, 0) N m about it.",
        Status.OPTIMAL.sentence,
    ]
    assert "Cost: 2 N (gentlest: the largest normal force), at most " in told.out
    assert "Checked again in float64: the proof holds." in lines and lines[-1] == "written to ring.parquet"
    rows = [line.split() for line in lines if line.split()[:1] in (["0"], ["1"], ["2"])]
    for words in rows:
        assert words[3:6] == ["2.000", "100.0", "%"] and words[-1] == "1.000)"
    found = pq.read_table("ring.parquet")
    assert column(found, "contact_force", 3, 3)[0] == pytest.approx(
        2 * np.asarray(ring().normal, float) + [0, 0, 1], abs=1e-7
    )


def test_explain_says_the_same_from_the_file_alone(capsys, folder, screened, written):
    answers = str(folder / "forces.parquet")
    for status in (Status.OPTIMAL, Status.INFEASIBLE):
        row = int(np.flatnonzero(written["status"].to_numpy() == status)[0])
        assert main(["forces", screened, *LOAD, "--row", str(row)]) == 0
        _, *now = capsys.readouterr().out.splitlines()
        assert main(["explain", answers, str(row)]) == 0
        title, *later = capsys.readouterr().out.splitlines()
        assert title == f"Row {row} of {answers} (grasp {row}, hard contacts):"
        assert later == now and status.sentence in now and "Checked again in float64: the proof holds." in now
    assert os.listdir() == []


def test_an_altered_file_is_found_out(capsys, written):
    def reverse(twist):
        return None if twist is None else [-x for x in twist]

    alterations = (
        (Status.OPTIMAL, "cost", lambda x: 0.999 * x),
        (Status.OPTIMAL, "lower", lambda x: 1.001 * x),
        (Status.OPTIMAL, "load_twist", reverse),
        (Status.INFEASIBLE, "escape_twist", reverse),
    )
    for status, name, change in alterations:
        place, kind = written.schema.get_field_index(name), written.schema.field(name)
        values = pa.array([change(x) for x in written[name].to_pylist()], kind.type)
        pq.write_table(written.set_column(place, kind, values), "altered.parquet")
        row = int(np.flatnonzero(written["status"].to_numpy() == status)[0])
        assert main(["explain", "altered.parquet", str(row)]) == 0
        assert "the stored evidence does NOT prove it." in capsys.readouterr().out


def test_a_limit_becomes_active_at_its_bound(capsys):
    """The ring needs W / (3 mu) a finger: just above it holds; 1 % below 99 % of the power is taken up."""
    jg.save_grasp(ring(), "ring.npz")
    words = ["forces", "ring.npz", "--wrench", "0,0,-3,0,0,0", "--max-normal"]
    assert main([*words, "2.0001"]) == 0
    assert "Cost: 2 N" in capsys.readouterr().out
    assert main([*words, "1.98", "-o", "less.parquet"]) == 0
    told = capsys.readouterr().out
    assert Status.INFEASIBLE.sentence in told and "the proof holds" in told
    assert "With at most 1.98 N each, the contacts take up at most 99.0 % of the power" in told
    assert main(["explain", "less.parquet", "0"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == told.splitlines()[1:-1]


def answer(**changes):
    """A grasp in the plane that a torque turns about its right finger, as a row of a file."""
    row = {
        "row": 0, "grasp_id": 0, "position": np.asarray([[-1.0, 0], [1, 0]]), "normal": np.asarray([[1.0, 0], [-1, 0]]),
        "friction": np.full(2, 0.5), "torsion": np.zeros(2), "active": np.ones(2, bool),
        "status": Status.INFEASIBLE.value, "cost": np.inf, "lower": np.inf, "force": None, "contact_force": None,
        "escape_twist": np.asarray([0.0, -1, 1]) / np.sqrt(2), "load_twist": None,
    }  # fmt: skip
    metadata = {
        "centre_of_mass": [0.0, 0.0],
        "model": {"kind": "hard"},
        "load": {"wrench": [0.0, -1.0, 1.5]},
        "criterion": {"name": "gentlest", "weight": None, "length": None, "unit": "N"},
        "max_normal": None,
        "tolerance": 1e-8,
    }
    metadata |= {name: changes.pop(name) for name in list(changes) if name in metadata}
    return ForceAnswer.from_row(row | changes, metadata)


def test_words_in_the_plane():
    lines = infeasible_words(answer(max_normal=2.0))
    assert lines[0] == (
        "The load drives the object into a rotation (anticlockwise) about the point (1, 0) m, 1e+03 mm from the "
        "centre of mass."
    )
    # power 2.5 / sqrt 2; finger 0 rubs upwards with mu * 2 N at speed 2 / sqrt 2, finger 1 stands at the pole
    assert lines[1].startswith("With at most 2 N each, the contacts take up at most 80.0 % of the power")
    assert lines[2:] == [
        "  contact 0: it takes up at most 80.0 %.",
        "  contact 1: the surface stands still or only turns on the finger.",
    ]
    assert (
        load_words({"wrench": [0, -1, 1.5]}) == "Load: (0, -1) N at the centre of mass and 1.5 N m about it."
    )
    heads, rows = contact_rows(
        answer(status=6, force=[-0.75, 1.5, 0.0, 0.0], contact_force=np.asarray([[1.5, 0.75], [0, 0]]))
    )
    assert heads[1:3] == ["f_t\n(N)", "f_n\n(N)"]
    assert rows == [
        ["0", "-0.750", "1.500", "100.0 %", "(1.500, 0.750)"],
        ["1", "0.000", "0.000", "-", "(0.000, 0.000)"],
    ]


def test_words_for_motions_that_nothing_opposes():
    away = answer(
        escape_twist=np.asarray([1.0, 0.0, 0.0]), load={"wrench": [1.0, 0.0, 0.0]}, active=[True, False]
    )
    assert infeasible_words(away) == [
        "The load drives the object into a slide along (1, 0).",
        "No force that friction allows the contacts opposes that motion:",
        "  contact 0: the surface draws straight away.",
    ]
    slant = np.asarray([1.0, 1.0, 0.0]) / np.sqrt(2)
    told = infeasible_words(
        answer(escape_twist=slant, load={"wrench": [1.0, 1.0, 0.0]}, active=[True, False])
    )
    assert (
        told[2]
        == "  contact 0: the surface draws away at 45.0 degrees to itself; friction holds up to 26.6 degrees."
    )
    down = answer(escape_twist=np.asarray([0.0, -1, 0]), load={"wrench": [0.0, -1, 0]}, friction=np.zeros(2))
    assert (
        infeasible_words(down)[3]
        == "  contact 1: the surface only slides along the finger, without friction."
    )


def test_costs_carry_their_weights_and_units():
    robust = {"name": "robust", "weight": 0.5, "length": None, "unit": "N"}
    assert cost_words(answer(criterion=robust, cost=3.0, lower=2.5)) == (
        "Cost: 3 N (robust, weight 0.5 N: the largest normal force less weight times log det P), at most 5.0e-01 N "
        "above the least there is."
    )
    assert "no bound is proven" in cost_words(answer(cost=3.0, lower=-np.inf))


# The request -----------------------------------------------------------------------------------------


def test_every_criterion_has_its_object():
    objects = {name: make_criterion(name) for name in CRITERIA}
    kinds = (jg.Gentlest, jg.Robust, jg.SmallestSum, jg.SumOfSquares, jg.LeastNorm)
    assert [type(found) for found in objects.values()] == list(kinds)
    assert float(make_criterion("robust", weight=0.25).weight) == 0.25
    assert float(make_criterion("least-norm", length=0.25).length) == 0.25


def test_gravity_is_a_direction_and_g_its_size(screened):
    def wrench(**options):
        return plan_forces(ForcesRequest(screened, mass=2.0, row=3, **options)).load.wrench

    assert wrench().tolist() == [0, 0, -2 * 9.81, 0, 0, 0]
    assert wrench(gravity=(3.0, 0.0, -4.0), g=10.0) == pytest.approx([12, 0, -16, 0, 0, 0], rel=1e-15)
    assert wrench(gravity=(0.0, -9.81, 0.0)) == pytest.approx([0, -19.62, 0, 0, 0, 0], rel=1e-15)
    jg.save_grasp(jg.Grasp([[-1.0, 0], [1, 0]], [[1.0, 0], [-1, 0]], jg.HardFinger(0.5)), "planar.npz")
    planar = plan_forces(ForcesRequest("planar.npz", mass=1.0))
    assert planar.load.wrench.tolist() == [0, -9.81, 0] and planar.load.assumed and planar.selection.row == 0


def a_mesh():
    with open("part.stl", "w") as file:
        file.write("solid nothing\nendsolid nothing\n")
    return ["forces", "part.stl", *LOAD]


def bare_contacts():
    pq.write_table(pa.table({"position": [[0.0] * 9], "normal": [[1.0] * 9]}), "bare.parquet")
    return ["forces", "bare.parquet", *LOAD]


def another_npz():
    np.savez("other.npz", a=np.zeros(3))
    return ["forces", "other.npz", *LOAD]


def planar_words(*words):
    def make():
        jg.save_grasp(jg.Grasp([[-1.0, 0], [1, 0]], [[1.0, 0], [-1, 0]], jg.HardFinger(0.5)), "p.npz")
        return ["forces", "p.npz", *words]

    return make


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["FILE"], "give one load: --mass KG"),
        (["FILE", *LOAD, "--wrench", "0,0,0,0,0,0"], "give one load"),
        (["FILE", "--mass", "0"], "--mass must be a number > 0"),
        (["FILE", "--mass", "nan"], "--mass must be a number > 0"),
        (["FILE", "--mass", "1", "--gravity", "0,0,0"], "--gravity must be a direction"),
        (["FILE", "--mass", "1", "--gravity", "0,-1"], "--gravity must be a direction x,y,z: 3 finite numbers"),
        (["FILE", "--mass", "1", "--gravity", "down"], "--gravity must be a direction x,y,z without spaces"),
        (["FILE", "--mass", "1", "--g", "-9.81"], "--g must be a number > 0"),
        (["FILE", "--wrench", "1,2"], "--wrench must be six numbers"),
        (["FILE", "--wrench", "1,2,3"], "--wrench must be 6 finite numbers fx,fy,fz,tx,ty,tz"),
        (["FILE", "--wrench", "1,2,3,4,5,inf"], "--wrench must be 6 finite numbers"),
        (["FILE", "--wrench", "0,0,1,0,0,0", "--gravity", "0,0,-1"], "--gravity belongs to --mass"),
        (["FILE", *LOAD, "--criterion", "kindest"], "unknown criterion 'kindest'; take one of gentlest, robust"),
        (["FILE", *LOAD, "--weight", "2"], "--weight belongs to --criterion robust"),
        (["FILE", *LOAD, "--criterion", "robust", "--weight", "0"], "--weight must be a number > 0"),
        (["FILE", *LOAD, "--length", "2"], "--length belongs to --criterion least-norm"),
        (["FILE", *LOAD, "--criterion", "least-norm", "--length", "1"], "hard contacts have none"),
        (["FILE", *LOAD, "--max-normal", "-3"], "--max-normal must be a number > 0"),
        (["FILE", *LOAD, "--tolerance", "0"], "--tolerance must be a number > 0"),
        (["FILE", *LOAD, "--threads", "0"], "--threads must be at least 1"),
        (["FILE", *LOAD, "--chunk", "0"], "--chunk must be at least 1"),
        (["FILE", *LOAD, "--row", "300"], "has rows 0 to 299, there is no row 300"),
        (["FILE", *LOAD, "--row", "3", "--status", "resistant"], "--row names one grasp"),
        (["FILE", *LOAD, "--status", "good"], "unknown status 'good'; take one of resistant"),
        (["FILE", *LOAD, "--status", "invalid"], "no grasp in "),
        (["FILE", *LOAD, "-o", "no/such/folder/a.parquet"], "cannot be written"),
        (["FILE", *LOAD, "-o", "."], "is a directory"),
        (["FILE", *LOAD, "-o", "FILE"], "is the source"),
        (["missing.parquet", *LOAD], "missing.parquet: no such file"),
        (["mug", *LOAD], "mug is no file of grasps: jaxgrasp screen OBJECT writes one"),
        (a_mesh, "screen a mesh first, with jaxgrasp screen part.stl"),
        (bare_contacts, "lacks friction, torsion, active, status, centre_of_mass, model: screen it first"),
        (another_npz, "is not a grasp written by jaxgrasp.save_grasp"),
        (planar_words("--mass", "1", "--gravity", "0,0,-1"), "--gravity must be a direction x,y: 2 finite numbers"),
        (planar_words("--wrench", "0,0,0,0,0,0"), "--wrench must be 3 finite numbers fx,fy,t"),
        (planar_words("--mass", "1", "--status", "resistant"), "holds no verdicts"),
        (planar_words("--mass", "1", "--row", "1"), "has rows 0 to 0, there is no row 1"),
    ],
)  # fmt: skip
def test_user_errors_are_one_line_and_exit_code_2(capsys, tmp_path, screened, arguments, message):
    words = arguments() if callable(arguments) else ["forces", *arguments]
    words = [screened if word == "FILE" else word for word in words]
    before = sorted(tmp_path.rglob("*"))
    assert main(words) == 2
    told = capsys.readouterr()
    (line,) = told.err.splitlines()
    assert line.startswith("jaxgrasp: ") and message in line
    assert told.out == ""
    assert sorted(tmp_path.rglob("*")) == before


def test_explain_knows_which_file_it_reads(capsys, folder):
    answers = str(folder / "forces.parquet")
    assert main(["explain", answers, "0", "--picture", "a.png"]) == 2
    assert "holds forces against a load" in capsys.readouterr().err
    assert main(["explain", answers, "300"]) == 2
    assert "has rows 0 to 299" in capsys.readouterr().err


def test_help_has_examples(capsys):
    assert main(["forces", "--help"]) == 0
    told = capsys.readouterr().out
    for words in ("jaxgrasp forces mug.grasps.parquet --mass 0.3", "--wrench", "--max-normal", "least-norm"):
        assert words in told
    assert main(["--help"]) == 0
    assert "forces" in capsys.readouterr().out


# What can go wrong -----------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_stopped_in_the_middle_nothing_is_left(capsys, monkeypatch, screened, error):
    solve, calls = loading._solve, []

    def failing(plan, contacts):
        calls.append(len(contacts))
        if len(calls) == 4:
            raise error
        return solve(plan, contacts)

    monkeypatch.setattr(loading, "_solve", failing)
    code = main(["forces", screened, *LOAD, "--chunk", "64", "-o", "stopped.parquet", "--threads", "1"])
    (line,) = capsys.readouterr().err.splitlines()
    assert os.listdir() == [] and calls[:4] == [0, 64, 64, 64]
    if isinstance(error, OSError):
        assert code == 2 and line == "jaxgrasp: cannot write stopped.parquet: No space left on device"
    else:
        assert code == 130 and line == "jaxgrasp: stopped; stopped.parquet was not written"


def test_no_thread_outlives_the_64_bits_it_needs(monkeypatch, screened):
    """Ctrl-C while a row group is written: the chunks being solved end before the precision is put back."""
    working = []

    @contextmanager
    def watched(dtype):
        with precision(dtype):
            try:
                yield
            finally:
                working.extend(t.name for t in threading.enumerate() if "ThreadPoolExecutor" in t.name)

    def interrupted(path, rows, kind):
        next(iter(rows))
        raise KeyboardInterrupt

    monkeypatch.setattr(loading, "precision", watched)
    monkeypatch.setattr(loading, "write", interrupted)
    assert main(["forces", screened, *LOAD, "--chunk", "64", "--threads", "2", "-o", "a.parquet"]) == 130
    assert working == [] and os.listdir() == []


def test_an_answer_that_is_not_proved_is_counted_as_such(capsys, monkeypatch, screened):
    monkeypatch.setattr(loading, "check", lambda grasp, found, **_: np.zeros(found.status.shape, bool))
    assert main(["forces", screened, *LOAD, "-o", "a.parquet"]) == 0
    assert "proved again in float64 without the solver: 0 of " in capsys.readouterr().out
    assert main(["forces", screened, *LOAD, "--row", "0"]) == 0
    assert "the stored evidence does NOT prove it." in capsys.readouterr().out


def test_a_damaged_file_of_forces(written):
    (row,) = written.slice(0, 1).to_pylist()
    metadata = json.loads(written.schema.metadata[b"jaxgrasp"])
    for name in ("load", "tolerance", "centre_of_mass"):
        with pytest.raises(UserError, match=f"damaged or incomplete .*{name}"):
            ForceAnswer.from_row(row, {key: value for key, value in metadata.items() if key != name})
    with pytest.raises(UserError, match=r"damaged or incomplete .*gecko"):
        ForceAnswer.from_row(row, {**metadata, "model": {"kind": "gecko"}})


def test_quantiles_of_costs_are_right_to_a_thousandth():
    rng = np.random.default_rng(3)
    cost = np.concatenate([np.exp(rng.normal(0, 3, 5000)), -np.exp(rng.normal(0, 2, 1000)), [np.inf, 0.0]])
    status = np.full(len(cost), Status.OPTIMAL.value)
    status[-2] = Status.INFEASIBLE.value
    none = np.zeros(len(cost), bool)
    total = ForceSummary(len(cost))
    for part in np.array_split(np.arange(len(cost)), 7):
        total.add(ForceSummary.of_costs(status[part], cost[part], ~none[part]))
    known = np.sort(cost[status == Status.OPTIMAL.value])
    for q in (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0):
        exact = known[max(int(np.ceil(q * len(known))), 1) - 1]
        assert total.quantile(q) == pytest.approx(exact, rel=6e-4, abs=1e-12)
    assert total.rows == total.proved == len(cost) and total.counts[Status.INFEASIBLE] == 1
    assert np.isnan(ForceSummary().quantile(0.5))


# Another process may be writing the compiled program that this one reads; it then compiles its own.
BUSY_STORE = "ignore:Error reading persistent compilation cache entry"


def test_the_whole_way_in_a_process_of_its_own(screened):
    """From a terminal: screened before, forces now, warnings as errors."""
    found = subprocess.run(
        [
            sys.executable,
            "-W",
            "error",
            "-W",
            BUSY_STORE,
            "-m",
            "jaxgrasp",
            "forces",
            screened,
            *LOAD,
            "--row",
            "0",
        ],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "COLUMNS": "80"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert found.returncode == 0 and found.stderr == "", found.stderr
    assert "the proof holds" in found.stdout
    assert jnp.zeros(1).dtype == jnp.result_type(float)  # and the session's precision is as it was
