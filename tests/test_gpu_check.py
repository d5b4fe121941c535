"""The GPU check on the CPU: right answers pass, and a changed reference is reported."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
REFERENCE = ROOT / "benchmarks" / "data" / "gpu_reference.npz"
ITEMS = ["margin-k4-float64-256", "margin-gradient-k4-float64-256"]


def check(tmp_path, *arguments):
    """Exit code and JSON of a small run."""
    written = tmp_path / "check.json"
    command = [sys.executable, str(ROOT / "benchmarks" / "gpu_check.py"), "--small", "--json", str(written)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(
        [*command, *arguments], env=environment, capture_output=True, text=True, check=False
    )
    assert written.exists(), done.stderr
    return done.returncode, json.loads(written.read_text()), done


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gpu_check")
    return *check(folder, "--only", *ITEMS), folder


def test_answers_of_the_cpu_are_right_and_timed(small_run):
    code, content, done, folder = small_run
    assert code == 0, done.stdout + done.stderr
    items = {item["item"]: item for item in content["items"]}
    assert set(items) == set(ITEMS)
    for item in items.values():
        assert item["failures"] == [] and item["checks"]["rejected"] == 0
        assert item["checks"]["contradictions"] == item["checks"]["brackets_apart"] == 0
        assert item["checks"]["bits_moved"] == 0
        assert item["timing"]["per_second"] > 0 and item["program"]["kernels"] > 0
    assert items[ITEMS[1]]["checks"]["gradients_compared"] > 100
    assert content["errors"] == content["skipped"] == []
    assert not list(folder.glob("*.tmp"))
    table = (folder / "check.md").read_text()
    assert all(name in table for name in ITEMS)


def test_a_changed_reference_is_reported_and_its_speed_is_not(tmp_path):
    with np.load(REFERENCE) as file:
        stored = {name: file[name] for name in file.files}
    status, planes = stored["4.margin.status"].copy(), stored["4.margin.end"].copy()
    status[3] = 3 - status[3]  # RESISTANT and NOT_RESISTANT change places
    planes[7, 5] ^= 0x40  # an exponent's bit: another margin
    changed = tmp_path / "changed.npz"
    np.savez(changed, **stored | {"4.margin.status": status, "4.margin.end": planes})
    code, content, _ = check(tmp_path, "--reference", str(changed), "--only", ITEMS[0])
    (item,) = content["items"]
    assert code == 1 and "timing" not in item
    assert item["checks"]["contradictions"] == 1 and item["checks"]["brackets_apart"] == 1


def test_what_does_not_fit_into_the_budget_is_skipped_with_a_word(tmp_path):
    code, content, _ = check(tmp_path, "--budget", "8", "--only", ITEMS[0])
    assert code == 0 and content["items"] == []
    (skipped,) = content["skipped"]
    assert skipped["item"] == ITEMS[0] and "left" in skipped["why"]
