"""``jaxgrasp place`` as a user runs it."""

import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest

import jaxgrasp as jg
from jaxgrasp.cli.main import main
from jaxgrasp.formats import ContactFile, read_metadata, read_row
from jaxgrasp.placement import Search
from jaxgrasp.placement.requirements import SLACK

# The rooms have functions of the same names.
cli_place = importlib.import_module("jaxgrasp.cli.place")
placing = importlib.import_module("jaxgrasp.jobs.place")
place_request = importlib.import_module("jaxgrasp.jobs.place_request")

pytestmark = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="the command works in float64")
FEW = [
    "--starts",
    "24",
    "--candidates",
    "8",
    "--steps",
    "25",
    "--resolution",
    "32",
    "--best",
    "6",
    "--apart",
    "0.02",
]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    return tmp_path


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """The file and the picture of one run, and what it printed."""
    folder = tmp_path_factory.mktemp("placed")
    file, picture = folder / "bowl.parquet", folder / "best.png"
    with pytest.MonkeyPatch.context() as patch:
        printed = []
        original = cli_place._print_summary
        patch.setattr(cli_place, "_print_summary", lambda *a: (printed.append(a[-1]), original(*a)))
        assert main(["place", "box", *FEW, "-o", str(file), "--picture", str(picture)]) == 0
    return file, picture, printed[0]


def test_the_grasps_in_the_file_hold_when_solved_again(placed):
    file, _, told = placed
    contacts = next(ContactFile(file).chunks(100))
    about = read_metadata(file)
    assert contacts.position.shape == (6, 3, 3) == (told.rows, 3, 3) and told.proved == 6
    grasp = jg.Grasp(
        contacts.position - np.array(about["centre_of_mass"]),
        contacts.normal,
        jg.HardFinger(jnp.asarray(0.5)),
    )
    found = jg.wrench_resistance(grasp)
    assert (np.asarray(found.status) == jg.Status.RESISTANT).all()
    assert jg.check(grasp, found).all()
    table = pq.read_table(file)
    margin, objective = table["margin"].to_numpy(), table["objective"].to_numpy()
    np.testing.assert_allclose(margin, np.asarray(found.margin), atol=1e-8)
    np.testing.assert_allclose(objective, margin, atol=1e-8)
    assert (np.diff(objective) <= 0).all()
    before = np.array([-10 if x is None else x for x in table["margin_before"].to_pylist()])
    assert (objective > before).all()
    assert objective[0] > 0.6 > 0.3 > np.median(told.placement.before)
    assert np.median(told.placement.after) > np.median(told.placement.before)


def test_what_was_asked_is_kept_and_told(placed):
    file, picture, told = placed
    position = next(ContactFile(file).chunks(100)).position
    pairs = [np.linalg.norm(position[:, i] - position[:, j], axis=-1) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert np.min(pairs) >= 0.02 - SLACK * 0.2
    about = read_metadata(file)
    assert about["objective"] == "margin" and about["apart"] == 0.02 and about["starts"] == 24
    assert about["command"].startswith("jaxgrasp place box --unit m --fingers 3 --model hard --friction 0.5")
    row, _ = read_row(file, 0)
    assert row["grasp_id"] == told.placement.start[0]
    assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size > 10_000


def test_explain_reads_the_file(placed, capsys):
    assert main(["explain", str(placed[0]), "0"]) == 0
    said = capsys.readouterr().out
    assert "Wrench resistant (force closure)" in said and "the proof holds" in said


def test_the_summary_is_printed(placed, capsys):
    _, _, told = placed
    plan = place_request.plan_place(place_request.PlaceRequest("box", starts=24))
    cli_place._print_summary(plan, told)
    said = capsys.readouterr().out
    held = int(told.placement.resistant.sum())
    assert f"{held} of 24 starts ended wrench resistant ({100 * held / 24:.1f} %)" in said
    assert "proved again in float64 without the solver: 6 of 6" in said
    assert f"median margin {np.median(told.placement.before):.3f} before" in said
    assert f"│   0 │ {told.placement.value[0]:.4g} │" in said
    assert "written to box.placed.parquet" in said


def test_the_same_seed_gives_the_same_bytes(placed, tmp_path):
    assert main(["place", "box", *FEW, "-o", "again.parquet"]) == 0
    assert (tmp_path / "again.parquet").read_bytes() == placed[0].read_bytes()


@pytest.mark.slow("test_the_grasps_in_the_file_hold_when_solved_again")
@pytest.mark.parametrize(
    "objective",
    ["epsilon", "epsilon-linf"],
)
def test_every_objective_grows(objective, monkeypatch, tmp_path):
    """On the climb alone: settling, which comes after it, finds as much from a poorer start by luck."""
    monkeypatch.setattr(placing, "Search", functools.partial(Search, settling=0))
    words = ["place", "box", "--starts", "8", "--resolution", "32", "--best", "4", "--objective", objective]
    value = []
    for steps in ("1", "20"):
        assert main([*words, "--steps", steps, "-o", f"{steps}.parquet"]) == 0
        value.append(pq.read_table(tmp_path / f"{steps}.parquet")["objective"].to_numpy()[0])
    assert value[1] > 1.05 * value[0] > 0


# Without a placement ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_stopped_in_the_middle_nothing_is_left(error, monkeypatch, capsys, tmp_path):
    def stopped(*_, **__):
        raise error

    monkeypatch.setattr(placing, "place_contacts", stopped)
    words = ["place", "box", "--resolution", "16", "-o", "out.parquet", "--picture", "out.png"]
    if error is KeyboardInterrupt:
        assert main(words) == 130
        assert "stopped; out.parquet was not written" in capsys.readouterr().err
    else:
        with pytest.raises(RuntimeError):
            main(words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["box", "--fingers", "2"], "2 such contacts never hold an object; take --fingers 3 or more"),
        (["box", "--model", "frictionless"], "take --fingers 7 or more"),
        (["box", "--model", "soft", "--fingers", "1"], "take --fingers 2 or more"),
        (["box", "--model", "sticky"], "unknown model 'sticky'"),
        (["box", "--objective", "beauty"], "unknown objective 'beauty'; take one of margin, epsilon"),
        (["box", "--torsion", "0.01"], "no torsion"),
        (["box", "--friction", "-1"], "--friction must be a number >= 0"),
        (["box", "--apart", "-0.01"], "--apart must be a number of m > 0"),
        (["box", "--edge-clearance", "nan"], "--edge-clearance must be a number of m > 0"),
        (["box", "--jaw-width", "0"], "--jaw-width must be a number of m > 0"),
        (["box", "--starts", "0"], "--starts must be at least 1"),
        (["box", "--best", "0"], "--best must be at least 1"),
        (["box", "--seed", "-1"], "--seed must not be negative"),
        (["box", "--resolution", "8"], "--resolution must be at least 16"),
        (["box", "--picture", "best.gif"], "--picture must end in .png, .svg, .pdf"),
        (["box", "--picture", "nowhere/best.png"], "name another file with --picture"),
        (["box", "-o", "nowhere/out.parquet"], "cannot be written"),
        (["box", "--unit", "mm"], "is in metres"),
        (["nothing.stl"], "no such file"),
        (["box", "--starts", "many"], "jaxgrasp --help shows what there is"),
    ],
)
def test_mistakes_are_told_in_one_line(words, complaint, capsys, tmp_path):
    assert main(["place", *words]) == 2
    said = capsys.readouterr().err.strip()
    assert complaint in said and len(said.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_help_has_examples(capsys):
    assert main(["place", "--help"]) == 0
    said = capsys.readouterr().out
    assert "jaxgrasp place mug" in said and "--edge-clearance" in said
