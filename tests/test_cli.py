import os
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from jaxgrasp import __version__, objects
from jaxgrasp.cli.main import main
from jaxgrasp.core.status import Status
from jaxgrasp.objects import builtin

SMALL = ["--samples", "300", "--fingers", "3", "--chunk", "256"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


def run(command, *arguments, **environment):
    return subprocess.run(
        [sys.executable, *command, *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_version_and_help(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"jaxgrasp {__version__}\n"
    for arguments, expected in (
        (["--help"], ["screen", "explain", "objects"]),
        (
            ["screen", "--help"],
            ["jaxgrasp screen mug", "--unit mm", "--resume", "--com", "--verdict-only", "--filter"],
        ),
        (["explain", "--help"], ["--picture grasp.png", "ROW counts from 0"]),
    ):
        assert main(arguments) == 0
        told = capsys.readouterr().out
        assert all(word in told for word in expected)


def test_objects_are_listed(capsys):
    assert main(["objects"]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in objects.OBJECTS)
    assert "12.0 x 8.0 x 6.0" in told and "576" in told


def test_screen_then_explain(capsys, tmp_path, dtype):
    assert main(["screen", "mug", *SMALL, "--dtype", dtype]) == 0
    told = capsys.readouterr()
    assert "written to mug.grasps.parquet" in told.out and "grasps/s" in told.out and "median" in told.out
    assert told.err == ""
    table = pq.read_table("mug.grasps.parquet")
    status = table["status"].to_numpy()
    assert len(table) == 300
    assert f"{np.count_nonzero(status == 1):,}" in told.out

    held = int(np.flatnonzero(status == Status.RESISTANT)[0])
    assert main(["explain", "mug.grasps.parquet", str(held), "--picture", "held.png"]) == 0
    told = capsys.readouterr().out
    assert Status.RESISTANT.sentence in told and "contact 2: normal" in told and "the proof holds" in told
    assert (tmp_path / "held.png").stat().st_size > 10_000

    lost = int(np.flatnonzero(status == Status.NOT_RESISTANT)[0])
    assert main(["explain", "mug.grasps.parquet", str(lost)]) == 0
    told = capsys.readouterr().out
    assert "The object escapes by a" in told and "the proof holds" in told


def test_a_warning_is_one_line_and_the_work_goes_on(capsys, dtype):
    vertices, faces = builtin.bowl()
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [
        f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces[1:]
    ]
    with open("open.obj", "w") as file:
        file.write("\n".join(lines))
    assert main(["screen", "open.obj", *SMALL, "--dtype", dtype, "--filter"]) == 0
    told = capsys.readouterr()
    (warning,) = told.err.splitlines()
    assert warning.startswith(
        "jaxgrasp: warning: the mesh is not watertight: the centre of mass is the surface's"
    )
    assert "left out by --filter" in told.out and "written to open.grasps.parquet" in told.out


def contacts_without_normals():
    pq.write_table(pa.table({"position": [[0.0] * 6]}), "half.parquet")
    return ["screen", "half.parquet", "--com", "0,0,0"]


def no_faces():
    with open("points.obj", "w") as file:
        file.write("v 0 0 0\n")
    return ["screen", "points.obj"]


def another_run():
    os.mkdir("mug.grasps.parquet.parts")
    with open("mug.grasps.parquet.parts/run.json", "w") as file:
        file.write("{}")
    return ["screen", "mug"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["screen", "missing.stl"], "missing.stl: no such file"),
        (["screen", "teacup"], "built-in objects:"),
        (no_faces, "no faces"),
        (contacts_without_normals, "lacks the column normal"),
        (another_run, "--resume"),
        (["screen", "mug", "--samples", "0"], "--samples must be at least 1"),
        (["screen", "mug", "--fingers", "0"], "--fingers must be at least 1"),
        (["screen", "mug", "--threads", "0"], "--threads must be at least 1"),
        (["screen", "mug", "--friction", "-1"], "--friction must be a number >= 0"),
        (["screen", "mug", "--model", "soft", "--torsion", "-1"], "--torsion must be a number >= 0"),
        (["screen", "mug", "--model", "rubber"], "unknown model 'rubber'"),
        (["screen", "mug", "--dtype", "int8"], "unknown dtype 'int8'"),
        (["screen", "mug", "--unit", "yd"], "unknown unit 'yd'"),
        (["screen", "mug", "--com", "1,2"], "--com must be three numbers"),
        (["screen", "mug", "--com", "a,b,c"], "--com must be three numbers"),
        (["screen", "mug", "--com", "nan,0,0"], "three finite numbers"),
        (["screen", "mug", "-o", "no/such/folder/a.parquet"], "cannot be written"),
        (["screen", "mug", "--samples", "many"], "--samples' / '-n'"),
        (["screen", "mug", "--sample", "5"], "--sample"),
        (["screen"], "OBJECT"),
        (["explain", "missing.parquet", "0"], "no such file"),
    ],
)
def test_user_errors_are_one_line_and_exit_code_2(capsys, tmp_path, arguments, message):
    words = arguments() if callable(arguments) else arguments
    before = sorted(tmp_path.rglob("*"))
    assert main(words) == 2
    told = capsys.readouterr()
    (line,) = told.err.splitlines()
    assert line.startswith("jaxgrasp: ") and message in line
    assert told.out == ""
    assert sorted(tmp_path.rglob("*")) == before


def test_ctrl_c_says_how_to_go_on(capsys, monkeypatch, dtype):
    from jaxgrasp.jobs import shards

    def interrupt(path, rows):
        raise KeyboardInterrupt

    monkeypatch.setattr(shards, "_write", interrupt)
    assert main(["screen", "mug", *SMALL, "--dtype", dtype]) == 130
    (line,) = capsys.readouterr().err.splitlines()
    assert "stopped" in line and "--resume" in line


def test_the_whole_way_in_a_process_of_its_own(tmp_path):
    """Two soft fingers on a ball: a line inside both cones is resistant (Nguyen)."""
    words = ["screen", "sphere", "--model", "soft", "-k", "2", "--friction", "0.3", "--torsion", "0.004"]
    found = run(["-m", "jaxgrasp"], *words, "--samples", "200", JAX_PLATFORMS="cuda")
    assert found.returncode == 0, found.stderr
    (line,) = found.stderr.splitlines()  # no such accelerator here: the CPU, and one line
    assert line.startswith("jaxgrasp: no usable accelerator (cuda: ") and line.endswith("running on the CPU")
    assert "written to sphere.grasps.parquet" in found.stdout
    table = pq.read_table("sphere.grasps.parquet")
    position, normal = (np.asarray(table[name].to_pylist()) for name in ("position", "normal"))
    line = position[:, 1] - position[:, 0]
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    cosine = np.stack([np.sum(line * normal[:, 0], 1), -np.sum(line * normal[:, 1], 1)])
    inside = (cosine > np.cos(np.arctan(0.3)) + 1e-9).all(axis=0)
    assert 150 < inside.sum() <= 200
    assert (table["status"].to_numpy()[inside] == Status.RESISTANT).all()
    assert len(table["internal_force"].drop_null()[0]) == 8


def test_importing_the_library_is_light():
    heavy = ("mujoco", "trimesh", "pyarrow", "typer", "matplotlib", "rich", "scipy.spatial")
    code = f"import sys, jaxgrasp; print([m for m in {heavy!r} if m in sys.modules])"
    assert run(["-c", code], JAX_PLATFORMS="cpu").stdout.strip() == "[]"
