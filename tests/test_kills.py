"""Runs that are killed, and runs side by side: same bytes in the end, nothing left behind, one writer a file.

As a script, with so many kills of each command: ``python tests/test_kills.py 20``.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from jaxgrasp.core import UserError, claimed

ROOT = Path(__file__).resolve().parents[1]
SMALL = ("--chunk", "64")
COMMANDS = {
    "screen": ("screen", "box", "-k", "3", "--samples", "4096", *SMALL),
    "check": ("check", "grasps.parquet", "--mass", "0.3", "--most", "320", *SMALL),
    "forces": ("forces", "grasps.parquet", "--mass", "0.3", "--gravity", "0,0,-1", *SMALL),
    "place": ("place", "box", "--starts", "32", "--steps", "20", "--candidates", "8", "--resolution", "32"),
}
RESUMED = ("screen", "check")
SECONDS = 600


def started(folder, *arguments):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT), "COLUMNS": "120"}
    return subprocess.Popen(
        [sys.executable, "-m", "jaxgrasp", *arguments], cwd=folder, env=environment,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def finished(process, code=0):
    _, err = process.communicate(timeout=SECONDS)
    assert process.returncode == code, err
    return err


def killed(process, output, wait):
    """SIGKILL ``wait`` s after the run has claimed its output; whether it was still at work."""
    lock, until = output.with_name(f".{output.name}.lock"), time.monotonic() + SECONDS
    while process.poll() is None and not lock.exists():
        assert time.monotonic() < until
        time.sleep(0.01)
    time.sleep(wait)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=SECONDS)
    return process.returncode == -signal.SIGKILL


def kill_and_compare(command, kills, folder, longest=3.0, seed=0):
    """Runs of ``command`` killed so many times, then one that ends: the bytes of an undisturbed run, and no more."""
    if "grasps.parquet" in COMMANDS[command] and not (folder / "grasps.parquet").exists():
        finished(started(folder, "screen", "box", "-k", "3", "--samples", "2048", "-o", "grasps.parquet"))
    finished(started(folder, *COMMANDS[command], "-o", "whole.parquet"))
    output, rng, hit = folder / "out.parquet", random.Random(seed), 0
    arguments = (*COMMANDS[command], "-o", output.name, *(["--resume"] if command in RESUMED else []))
    for _ in range(3 * kills):
        if hit == kills:
            break
        hit += killed(started(folder, *arguments), output, rng.uniform(0, longest))
        if output.exists():  # it was faster
            output.unlink()
            longest *= 0.7
    finished(started(folder, *arguments))
    assert hit == kills
    assert output.read_bytes() == (folder / "whole.parquet").read_bytes()
    left = {path.name for path in folder.iterdir()} - {"grasps.parquet"}
    assert left == {"whole.parquet", "out.parquet"}


@pytest.mark.slow("test_one_writer_a_file_and_leftovers_go")
@pytest.mark.parametrize("command", COMMANDS)
def test_killed_runs_end_like_others_and_leave_nothing(command, tmp_path):
    kill_and_compare(command, 3, tmp_path)


@pytest.mark.slow("test_a_lock_whose_holder_was_killed_is_free")
def test_the_second_of_two_runs_is_told_of_the_first(tmp_path):
    first = started(tmp_path, *COMMANDS["screen"], "--samples", "100000", "-o", "a.parquet", "--resume")
    lock = tmp_path / ".a.parquet.lock"
    while not lock.exists():
        assert first.poll() is None
        time.sleep(0.01)
    second = started(tmp_path, *COMMANDS["screen"], "--samples", "100000", "-o", "a.parquet", "--resume")
    assert f"a.parquet is being written by another run (process {first.pid})" in finished(second, code=2)
    first.kill()
    first.communicate()


def test_one_writer_a_file_and_leftovers_go(tmp_path):
    output = tmp_path / "a.parquet"
    (tmp_path / ".a.parquet.77.tmp").touch()
    (tmp_path / ".b.parquet.77.tmp").touch()
    (tmp_path / ".a.parquet.lock").touch()  # of a killed run: the file is there, the lock is not
    with claimed(output):
        assert sorted(p.name for p in tmp_path.iterdir()) == [".a.parquet.lock", ".b.parquet.77.tmp"]
        with (
            pytest.raises(UserError, match=rf"another run \(process {os.getpid()}\): wait for it"),
            claimed(output),
        ):
            pass
        with claimed(tmp_path / "b.parquet"):
            pass
    assert list(tmp_path.iterdir()) == []
    with claimed(output):
        pass


def test_outputs_that_are_no_files_are_left_alone(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to("/dev/null")
    for name, message in (
        ("pipe", "is a pipe or a device"),
        ("null", "is a pipe or a device"),
        ("", "is a directory"),
    ):
        with pytest.raises(UserError, match=message), claimed(tmp_path / name):
            pass
    with pytest.raises(UserError, match="cannot be written: No such file"), claimed(tmp_path / "no" / "a"):
        pass


def test_a_lock_whose_holder_was_killed_is_free(tmp_path):
    code = (
        "import os, signal, pathlib; from jaxgrasp.core import claimed\n"
        "with claimed(pathlib.Path('a')): os.kill(os.getpid(), signal.SIGKILL)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=False)
    assert done.returncode == -signal.SIGKILL
    assert [p.name for p in tmp_path.iterdir()] == [".a.lock"]
    with claimed(tmp_path / "a"):
        pass
    assert list(tmp_path.iterdir()) == []


if __name__ == "__main__":
    for name in sys.argv[2:] or COMMANDS:
        with tempfile.TemporaryDirectory() as place:
            begun = time.monotonic()
            kill_and_compare(name, int(sys.argv[1]), Path(place))
            print(f"{name}: {sys.argv[1]} kills, same bytes, {time.monotonic() - begun:.0f} s", flush=True)
