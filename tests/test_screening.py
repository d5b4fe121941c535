import dataclasses
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from real_data import real_meshes

import jaxgrasp as jg
from jaxgrasp import objects
from jaxgrasp.certificates import prove_resistance
from jaxgrasp.core.errors import UserError
from jaxgrasp.core.status import Status
from jaxgrasp.formats.contact_file import ContactFile
from jaxgrasp.jobs import screen_request, shards
from jaxgrasp.jobs.screen import screen
from jaxgrasp.jobs.screen_request import ScreenRequest, plan_screen
from jaxgrasp.jobs.summary import Summary

screening = importlib.import_module("jaxgrasp.jobs.screen")  # the room has a function of the same name


def request(tmp_path, dtype, name="a", **options):
    given = {
        "source": "mug",
        "samples": 700,
        "fingers": 3,
        "chunk": 256,
        "seed": 5,
        "dtype": dtype,
        "threads": 1,
        **options,
    }
    return ScreenRequest(output=tmp_path / f"{name}.parquet", **given)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, dtype):
    """A finished run: its folder, summary and table."""
    folder = tmp_path_factory.mktemp("whole")
    summary = screen(plan_screen(request(folder, dtype)))
    return folder, summary, pq.read_table(folder / "a.parquet")


def matrix(table, name):
    column = table[name].combine_chunks()
    values = column
    while pa.types.is_nested(values.type):
        values = values.flatten()
    return values.to_numpy(zero_copy_only=False).reshape(len(table) - column.null_count, -1)


def as_grasp(table, com, dtype, kind=jg.HardFinger):
    n = len(table)
    position = (matrix(table, "position").astype(float).reshape(n, -1, 3) - com).astype(dtype)
    friction = jnp.asarray(matrix(table, "friction"), dtype)
    model = kind().with_coefficients(friction, jnp.asarray(matrix(table, "torsion"), dtype))
    active = matrix(table, "active").astype(bool)
    return jg.Grasp(position, matrix(table, "normal").reshape(n, -1, 3), model, active)


def padded(table, name, width):
    full = np.zeros((len(table), width))
    full[table[name].combine_chunks().is_valid().to_numpy(zero_copy_only=False)] = matrix(table, name)
    return full


def test_every_verdict_in_the_file_is_proved_by_the_file(whole, dtype):
    _, summary, table = whole
    metadata = json.loads(table.schema.metadata[b"jaxgrasp"])
    grasp = as_grasp(table, np.asarray(metadata["centre_of_mass"]), dtype)
    evidence = SimpleNamespace(
        status=table["status"].to_numpy(),
        internal_force=padded(table, "internal_force", 9),
        escape_twist=padded(table, "escape_twist", 6),
        bound_twist=padded(table, "bound_twist", 6),
        lower=table["margin"].to_numpy(),
        upper=table["upper"].to_numpy(),
        rank=table["rank"].to_numpy(),
    )
    proof = prove_resistance(grasp, evidence)
    assert np.isin(proof.status, (Status.PROVED_EXACTLY, Status.PROVED_TO_ROUNDING)).all()
    assert table["grasp_id"].to_pylist() == list(range(700))
    assert summary.rows == 700 and sum(summary.counts.values()) == 700
    assert summary.counts[Status.RESISTANT] == int((table["status"].to_numpy() == 1).sum()) > 30
    assert summary.counts[Status.NOT_RESISTANT] > 30


def test_metadata_tell_the_run(whole, dtype):
    metadata = json.loads(whole[2].schema.metadata[b"jaxgrasp"])
    assert metadata["object"]["name"] == "mug" and len(metadata["object"]["sha256"]) == 64
    assert (metadata["fingers"], metadata["seed"], metadata["unit"]) == (3, 5, "m")
    assert metadata["model"] == {"kind": "hard", "friction": 0.5, "torsion": 0.0}
    assert metadata["dtype"] == dtype and set(metadata["versions"]) == {"jaxgrasp", "jax", "numpy", "python"}
    assert metadata["command"].startswith(
        "jaxgrasp screen mug --model hard --fingers 3 --friction 0.5 --samples 700"
    )
    assert np.shape(metadata["centre_of_mass"]) == (3,)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_gives_the_same_bytes(whole, tmp_path, dtype, threads):
    screen(plan_screen(request(tmp_path, dtype, threads=threads)))
    assert (tmp_path / "a.parquet").read_bytes() == (whole[0] / "a.parquet").read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["a.parquet"]  # nothing left over


def test_rows_do_not_depend_on_the_chunk(whole, tmp_path, dtype):
    screen(plan_screen(request(tmp_path, dtype, chunk=190)))
    assert (
        pq.read_table(tmp_path / "a.parquet")
        .replace_schema_metadata()
        .equals(whole[2].replace_schema_metadata())
    )


def interrupted(tmp_path, dtype, monkeypatch, after=1, **options):
    """A run that stops as Ctrl-C would, after so many shards."""
    original, count = shards._write, [0]

    def write(path, rows):
        if count[0] == after:
            raise KeyboardInterrupt
        count[0] += 1
        original(path, rows)

    with monkeypatch.context() as patch:
        patch.setattr(shards, "_write", write)
        with pytest.raises(KeyboardInterrupt):
            screen(plan_screen(request(tmp_path, dtype, **options)))
    return tmp_path / "a.parquet.parts"


def test_resume_after_ctrl_c(whole, tmp_path, dtype, monkeypatch):
    parts = interrupted(tmp_path, dtype, monkeypatch)
    assert [path.name for path in parts.glob("*.arrow")] == ["00000000.arrow"]
    assert not (tmp_path / "a.parquet").exists()
    with pytest.raises(UserError, match="--resume"):
        screen(plan_screen(request(tmp_path, dtype)))
    with pytest.raises(UserError, match="another run: seed was 5, is now 6"):
        screen(plan_screen(request(tmp_path, dtype, seed=6)), resume=True)
    summary = screen(plan_screen(request(tmp_path, dtype)), resume=True)
    assert summary.resumed == 256 and summary.solved == 700 - 256
    assert summary.counts == whole[1].counts
    assert (tmp_path / "a.parquet").read_bytes() == (whole[0] / "a.parquet").read_bytes()
    assert not parts.exists()
    again = screen(plan_screen(request(tmp_path, dtype)), resume=True)  # nothing left to do
    assert again.solved == 0 and again.counts == summary.counts
    assert again.quantile(0.5) == summary.quantile(0.5)


@pytest.mark.parametrize("damage", ["truncated", "empty", "another run's"])
def test_resume_does_damaged_shards_again(whole, tmp_path, dtype, monkeypatch, damage):
    parts = interrupted(tmp_path, dtype, monkeypatch, after=2)
    first, second = sorted(parts.glob("*.arrow"))
    if damage == "truncated":
        first.write_bytes(first.read_bytes()[:-100])
    elif damage == "empty":
        first.write_bytes(b"")
    else:
        shutil.copy(second, first)
    (parts / ".00000002.arrow.1.tmp").write_bytes(b"left over")
    summary = screen(plan_screen(request(tmp_path, dtype)), resume=True)
    assert summary.resumed == 256
    assert (tmp_path / "a.parquet").read_bytes() == (whole[0] / "a.parquet").read_bytes()


def test_sigkill_and_resume(whole, tmp_path, dtype):
    """Killed with SIGKILL once a shard is there, gone on with --resume: an uninterrupted run's rows."""
    words = ["screen", "mug", "--samples", "700", "--fingers", "3", "--chunk", "256", "--seed", "5"]
    words += ["--threads", "1", "--resume", "-o", "a.parquet", "--dtype"]
    command = [sys.executable, "-c", SLOW_SCREEN, *words, dtype]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "JAX_PLATFORMS": "cpu"}
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL)
    parts, deadline = tmp_path / "a.parquet.parts", time.monotonic() + 120
    while not list(parts.glob("*.arrow")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert list(parts.glob("*.arrow")) and not (tmp_path / "a.parquet").exists()
    summary = screen(plan_screen(request(tmp_path, dtype)), resume=True)
    assert 256 <= summary.resumed < 700
    assert pq.read_table(tmp_path / "a.parquet").equals(whole[2])


SLOW_SCREEN = """
import sys, time
from jaxgrasp import objects
from jaxgrasp.jobs import shards
from jaxgrasp.cli.main import main
write = shards._write
def slowly(path, rows):
    write(path, rows)
    time.sleep(0.5)
shards._write = slowly
sys.exit(main(sys.argv[1:]))
"""


def test_contacts_in_verdicts_out(whole, tmp_path, dtype):
    """The finished file is itself a file of contacts, with its centre of mass: the same verdicts come out."""
    folder, _, table = whole
    summary = screen(
        plan_screen(ScreenRequest(str(folder / "a.parquet"), tmp_path / "b.parquet", chunk=256, dtype=dtype))
    )
    again = pq.read_table(tmp_path / "b.parquet")
    assert again.replace_schema_metadata().equals(table.replace_schema_metadata())
    assert summary.counts == whole[1].counts
    metadata = json.loads(again.schema.metadata[b"jaxgrasp"])
    assert metadata["object"]["name"] == "mug" and metadata["contacts"]["name"].endswith("a.parquet")


def test_one_bad_lane_harms_no_other(whole, tmp_path, dtype):
    folder, _, table = whole
    (contacts,) = ContactFile(folder / "a.parquet").chunks(700)
    position, normal, friction = contacts.position.copy(), contacts.normal.copy(), contacts.friction.copy()
    position[3, 1, 2], normal[100, 0], friction[400, 2] = np.nan, 0, -1
    names = ("position", "normal", "friction")
    columns = {
        name: pa.array(a.tolist()) for name, a in zip(names, (position, normal, friction), strict=True)
    }
    pq.write_table(pa.table(columns), tmp_path / "bad.parquet")
    com = tuple(json.loads(table.schema.metadata[b"jaxgrasp"])["centre_of_mass"])
    run = plan_screen(
        ScreenRequest(str(tmp_path / "bad.parquet"), tmp_path / "b.parquet", com=com, chunk=256, dtype=dtype)
    )
    summary = screen(run)
    assert summary.counts[Status.INVALID] == 3
    again = pq.read_table(tmp_path / "b.parquet")
    assert again["status"].to_numpy()[[3, 100, 400]].tolist() == [5, 5, 5]
    for name in ("rank", "internal_force", "escape_twist"):
        assert again[name].take([3, 100, 400]).null_count == 3
    good = np.setdiff1d(np.arange(700), [3, 100, 400])
    compared = ["status", "margin", "upper", "internal_force", "escape_twist", "iterations"]
    assert again.select(compared).take(good).equals(table.select(compared).take(good))


def test_the_filter_leaves_out_only_what_is_not_resistant(whole, tmp_path, dtype):
    summary = screen(plan_screen(request(tmp_path, dtype, filter=True)))
    table = pq.read_table(tmp_path / "a.parquet")
    slide, close = summary.removed.values()
    assert slide > 20 and len(table) == summary.rows == 700 - slide - close
    assert summary.done == 700
    kept = table["grasp_id"].to_numpy()
    assert table.replace_schema_metadata().equals(whole[2].take(kept).replace_schema_metadata())
    gone = whole[2].take(np.setdiff1d(np.arange(700), kept))
    assert np.count_nonzero(gone["status"].to_numpy() != 2) <= close
    assert json.loads(table.schema.metadata[b"jaxgrasp"])["removed"] == summary.removed


def test_two_soft_fingers_get_antipodal_pairs(tmp_path, dtype):
    assert plan_screen(request(tmp_path, dtype, model="soft", fingers=2)).metadata["sampler"] == "antipodal"
    for options in ({"model": "hard", "fingers": 2}, {"model": "soft", "fingers": 3}):
        assert plan_screen(request(tmp_path, dtype, **options)).metadata["sampler"] == "surface"
    asked = plan_screen(request(tmp_path, dtype, model="hard", fingers=2, sampler="antipodal"))
    assert asked.candidates.source.friction == 0.5 and asked.metadata["sampler"] == "antipodal"


def test_the_file_s_friction_is_used_unless_told_otherwise(whole):
    source = str(whole[0] / "a.parquet")
    (contacts,) = ContactFile(whole[0] / "a.parquet").chunks(700)
    contacts = dataclasses.replace(contacts, friction=np.full((700, 3), 0.125))
    assert (plan_screen(ScreenRequest(source)).contact.coefficients(contacts)[0] == 0.125).all()
    assert (plan_screen(ScreenRequest(source, friction=0.7)).contact.coefficients(contacts)[0] == 0.7).all()
    friction, torsion = plan_screen(ScreenRequest(source, model="soft", torsion=0.02)).contact.coefficients(
        contacts
    )
    assert (friction == 0.125).all() and (torsion == 0.02).all()
    assert (
        plan_screen(ScreenRequest(source, model="frictionless")).contact.coefficients(contacts)[0] == 0
    ).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 0}, "--samples must be at least 1"),
        ({"fingers": 0}, "--fingers must be at least 1"),
        ({"chunk": 0}, "--chunk must be at least 1"),
        ({"friction": -0.1}, "--friction must be a number >= 0"),
        ({"friction": float("nan")}, "--friction must be a number >= 0"),
        ({"model": "soft", "torsion": -1.0}, "--torsion must be a number >= 0"),
        ({"torsion": 0.01}, "take --model soft"),
        ({"model": "frictionless", "friction": 0.5}, "has no friction"),
        ({"model": "sticky"}, "unknown model 'sticky'; take one of hard, soft, frictionless"),
        ({"dtype": "float16"}, "unknown dtype"),
        ({"unit": "ft"}, "unknown unit 'ft'; take one of m, cm, mm, in"),
        ({"sampler": "random"}, "unknown sampler"),
        ({"sampler": "antipodal"}, "take --fingers 2"),
        ({"com": (0.0, 1.0)}, "three finite numbers"),
        ({"seed": -1}, "--seed"),
        ({"tolerance": 0.0}, "--tolerance"),
    ],
)
def test_bad_requests_get_one_clear_line(tmp_path, dtype, options, message):
    with pytest.raises(UserError, match=message) as error:
        plan_screen(
            request(tmp_path, dtype, **options) if "dtype" not in options else request(tmp_path, **options)
        )
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_contacts_without_a_centre_of_mass(tmp_path):
    column = pa.array([[0.0, 0, 0, 1, 1, 1]])
    path = tmp_path / "c.parquet"
    pq.write_table(pa.table({"position": column, "normal": column}), path)
    with pytest.raises(UserError, match="give --com"):
        plan_screen(ScreenRequest(str(path)))
    for option in ({"samples": 5}, {"fingers": 2}, {"sampler": "surface"}, {"unit": "mm"}):
        with pytest.raises(UserError, match=next(iter(option))):
            plan_screen(ScreenRequest(str(path), com=(0.0, 0.0, 0.0), **option))


def test_unwritable_outputs_are_found_before_the_work(tmp_path, dtype, monkeypatch):
    monkeypatch.setattr(screening, "_solver", lambda plan: pytest.fail("work began"))
    (tmp_path / "a.parquet").mkdir()
    with pytest.raises(UserError, match="is a directory"):
        screen(plan_screen(request(tmp_path, dtype)))
    missing = dataclasses.replace(
        plan_screen(request(tmp_path, dtype)), output=tmp_path / "no" / "such" / "b.parquet"
    )
    with pytest.raises(
        UserError, match=r"cannot be written: No such file or directory; name another file with -o"
    ):
        screen(missing)
    (tmp_path / "file").write_text("")
    below = dataclasses.replace(missing, output=tmp_path / "file" / "b.parquet")
    with pytest.raises(UserError, match="cannot be written"):
        screen(below)


def test_a_full_disk_is_one_line_and_keeps_the_shards(tmp_path, dtype, monkeypatch):
    def full(path, rows):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shards, "_write", full)
    with pytest.raises(UserError, match="No space left on device"):
        screen(plan_screen(request(tmp_path, dtype)))
    assert list(tmp_path.iterdir()) == []


def test_quantiles_of_a_histogram():
    random = np.random.default_rng(0)
    margin = np.concatenate([1 - random.exponential(size=50_000), [1.0, np.nan]])
    status = np.full(margin.size, 2)
    total = Summary()
    for part in np.array_split(np.arange(margin.size), 7):
        total.add(Summary.of(status[part], margin[part]))
    known = margin[~np.isnan(margin)]
    for q in (0.001, 0.05, 0.25, 0.5, 0.9, 0.999):
        exact = np.quantile(known, q)
        assert total.quantile(q) == pytest.approx(exact, abs=2e-3 if q < 0.01 else 5e-4)
    assert total.quantile(1.0) == pytest.approx(1, abs=1e-4)
    assert total.quantile(0.0) == pytest.approx(known.min(), rel=1e-3)
    total.add(Summary.of(np.full(10_000, 2), np.full(10_000, -np.inf)))
    assert total.quantile(0.1) == -np.inf and np.isfinite(total.quantile(0.2))
    assert np.isnan(Summary().quantile(0.5))


@pytest.mark.realdata
def test_every_watertight_real_mesh_screens_to_the_end(tmp_path, dtype, monkeypatch):
    screened, bodies = 0, {}
    monkeypatch.setattr(screen_request, "load_mesh", lambda source, **_: bodies[source])  # once for both
    for file in sorted(real_meshes().glob("*/*")):
        if not file.is_file() or file.suffix in (".md", ".txt"):
            continue
        bodies[str(file)] = objects.load_mesh(file)
        if not bodies[str(file)].watertight:
            continue
        summary = screen(plan_screen(request(tmp_path, dtype, source=str(file), samples=256)))
        assert summary.rows == 256, file
        assert Status.INVALID not in summary.counts, file
        screened += 1
    assert screened >= 20
