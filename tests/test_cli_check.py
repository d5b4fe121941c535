"""``jaxgrasp check`` as a user runs it."""

import importlib
import os
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest
from quick_check import quick

from jaxgrasp import Status
from jaxgrasp.cli.main import main
from jaxgrasp.jobs import shards

checking = importlib.import_module("jaxgrasp.jobs.check")  # the room has a function of the same name
V = Status
pytestmark = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="the command works in float64")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    return tmp_path


def stop_before(monkeypatch, number):
    """Ctrl-C instead of the shard of chunk ``number``."""
    original = shards._write

    def write(path, rows):
        if path.name == f"{number:08d}.arrow":
            raise KeyboardInterrupt
        original(path, rows)

    monkeypatch.setattr(shards, "_write", write)


@pytest.mark.slow(
    "test_a_stopped_check_goes_on_where_it_was",
    "test_control.py::test_errors_decay_at_the_designed_rate_with_forces_in_their_cones",
    "test_controllability.py::test_fixed_cases",
)
def test_grasps_of_the_mug_are_checked(capsys, tmp_path, monkeypatch):
    """60 grasps in chunks of 25, stopped after two of them and gone on with: the bytes of an uninterrupted run."""
    words = ["check", "mug", "--mass", "0.3", "--fingers", "3", "--most", "60", "--chunk", "25", "--row", "5"]
    assert main([*words, "-o", "whole.parquet"]) == 0
    with monkeypatch.context() as patch:
        stop_before(patch, 2)
        assert main(words) == 130
    assert "go on with the same command and --resume" in capsys.readouterr().err
    assert main([*words, "--resume"]) == 0
    printed = capsys.readouterr().out
    assert "written to mug.check.parquet" in printed and "Row 5: " in printed and "recovered" in printed
    assert "50 grasps were already done" in printed
    assert (tmp_path / "mug.check.parquet").read_bytes() == (tmp_path / "whole.parquet").read_bytes()
    table = pq.read_table(tmp_path / "mug.check.parquet")
    verdict, status = table["verdict"].to_numpy(), table["status"].to_numpy()
    assert table["row"].to_pylist() == list(range(60))
    assert ((verdict == V.RESISTANT.value) == (status == Status.RESISTANT.value)).all()
    steerable = np.isin(verdict, (V.RESISTANT.value, V.CONTROLLABLE.value))
    assert {V.RESISTANT.value, V.CONTROLLABLE.value, V.NO_EQUILIBRIUM.value} <= set(verdict.tolist())
    assert (np.asarray(table["rank"].to_pylist(), float)[steerable] == 12).all()
    back = np.array([bool(x) for x in table["recovered"].to_pylist()])
    assert [x is None for x in table["recovered"].to_pylist()] == (~steerable).tolist()
    assert back[steerable].mean() > 0.8
    time = np.array([np.nan if x is None else x for x in table["settling_time"].to_pylist()])
    assert (np.isfinite(time) == back).all() and (time[back] < 1.6).all() and (time[back] > 0.05).all()
    use = np.array([np.nan if x is None else x for x in table["cone_use"].to_pylist()])
    assert (use[steerable] <= 1 + 1e-9).all()


# Chunks and shards, with something quick in place of the controllers ---------------------------------------


QUICK = ["check", "mug", "--mass", "0.3", "--most", "10", "--chunk", "4"]


def test_a_stopped_check_goes_on_where_it_was(capsys, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(
        checking, "_checked", lambda run, contacts: calls.append(len(contacts)) or quick(run, contacts)
    )
    assert main([*QUICK, "-o", "whole.parquet"]) == 0 and calls == [4, 4, 2]
    whole = pq.read_table(tmp_path / "whole.parquet")
    assert whole["row"].to_pylist() == whole["grasp_id"].to_pylist() == list(range(10))
    with monkeypatch.context() as patch:
        stop_before(patch, 1)
        assert main(QUICK) == 130
    parts = tmp_path / "mug.check.parquet.parts"
    assert [x.name for x in parts.glob("*.arrow")] == ["00000000.arrow"]
    assert not (tmp_path / "mug.check.parquet").exists()
    assert main(QUICK) == 2 and main([*QUICK, "--resume", "--mass", "0.4"]) == 2
    said = capsys.readouterr().err
    assert "go on with --resume" in said and "belongs to another run: mass was 0.3, is now 0.4" in said
    calls.clear()
    assert main([*QUICK, "--resume"]) == 0 and calls == [4, 2]
    assert "4 grasps were already done" in capsys.readouterr().out and not parts.exists()
    assert (tmp_path / "mug.check.parquet").read_bytes() == (tmp_path / "whole.parquet").read_bytes()
    calls.clear()
    assert main([*QUICK, "--resume"]) == 0 and calls == []  # nothing left to do
    assert "10 grasps were already done" in capsys.readouterr().out


KILLED = """
import importlib, sys, time
from quick_check import quick
checking = importlib.import_module("jaxgrasp.jobs.check")
from jaxgrasp.cli.main import main
def slow(run, contacts):
    time.sleep(0.3)
    return quick(run, contacts)
checking._checked = slow
sys.exit(main(sys.argv[1:]))
"""


def test_a_killed_check_goes_on_where_it_was(tmp_path, monkeypatch):
    """Killed with SIGKILL once a shard is there."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "JAX_PLATFORMS": "cpu"}
    environment["JAX_ENABLE_X64"] = "1"
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, *QUICK], cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL
    )
    parts, deadline = tmp_path / "mug.check.parquet.parts", time.monotonic() + 120
    while not list(parts.glob("*.arrow")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert list(parts.glob("*.arrow")) and not (tmp_path / "mug.check.parquet").exists()
    monkeypatch.setattr(checking, "_checked", quick)
    assert main([*QUICK, "--resume"]) == 0
    assert main([*QUICK, "-o", "whole.parquet"]) == 0
    assert (tmp_path / "mug.check.parquet").read_bytes() == (tmp_path / "whole.parquet").read_bytes()


# Mistakes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["mug", "--mass", "-1"], "--mass must be a number of kg > 0"),
        (["mug", "--mass", "0.3", "--gravity", "0,0,0"], "not all 0"),
        (["mug", "--mass", "0.3", "--gravity", "down"], "--gravity must be three numbers"),
        (["mug", "--mass", "0.3", "--most", "0"], "--most must be at least 1"),
        (["mug", "--mass", "0.3", "--chunk", "0"], "--chunk must be at least 1"),
        (["mug", "--mass", "0.3", "--row", "300"], "there is no row 300"),
        (["nothing.stl", "--mass", "0.3"], "no such file"),
        (["mug", "--mass", "0.3", "--torsion", "0.1"], "no torsion"),
    ],
)
def test_mistakes_are_told_in_one_line(words, complaint, capsys):
    assert main(["check", *words]) == 2
    said = capsys.readouterr().err.strip()
    assert complaint in said and len(said.splitlines()) == 1
