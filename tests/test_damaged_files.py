"""Damaged files: one line, exit code 2, at most 2 GB and 10 s; never a traceback.

As a script, with so many files and a seed: ``python tests/test_damaged_files.py 2000 0``.
"""

import contextlib
import faulthandler
import io
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SECONDS, BYTES = 120, 2 << 30  # of a hang; compiling for a new shape takes a while on a busy machine
LOAD = ("--mass", "0.3", "--gravity", "0,0,-1")


def said(arguments):
    """The exit code of a command, and what it said on stderr."""
    from jaxgrasp.cli import main

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(x) for x in arguments])
    return code, err.getvalue()


def good_files(folder):
    """A file of every kind that is read."""
    files = [folder / name for name in ("hard.parquet", "soft.parquet", "forces.parquet", "lane.npz")]
    small = ("--samples", "64", "--chunk", "64", "--threads", "1")
    assert said(["screen", "box", "-k", "3", *small, "-o", files[0]])[0] == 0
    assert said(["screen", "box", "-k", "3", "--model", "soft", *small, "-o", files[1]])[0] == 0
    assert said(["forces", files[0], *LOAD, "--chunk", "64", "--threads", "1", "-o", files[2]])[0] == 0
    import jaxgrasp as jg
    from jaxgrasp.backend import precision

    with precision("float64"):
        points = [[0.0, 0.1, 0.0], [0.1, 0.0, 0.0], [-0.1, 0.0, 0.1]]
        jg.save_grasp(jg.Grasp(points, [[-x for x in p] for p in points], jg.HardFinger(0.5)), files[3])
    return files


def contacts_read(path):
    from jaxgrasp.core import UserError
    from jaxgrasp.formats import ContactFile

    try:
        for _ in ContactFile(path).chunks(16):
            pass
    except UserError as error:
        return 2, f"jaxgrasp: {error}\n"
    return 0, ""


def readers(path):
    """All that reads a file of this kind."""
    yield "forces", lambda: said(["forces", path, "--row", "1" if path.suffix == ".parquet" else "0", *LOAD])
    if path.suffix == ".parquet":
        yield "explain", lambda: said(["explain", path, "3"])
        yield "contacts", lambda: contacts_read(path)


class TooLong(BaseException):
    """Not an Exception: nobody may take it for damage."""


def late(*_):
    raise TooLong


def fuzz(count, seed):
    """What became of so many damaged files, by kind of damage and reader; failures with their tracebacks."""
    import traceback

    import numpy as np

    sys.path.insert(0, str(ROOT / "tests" / "tables"))
    from damage import damaged

    signal.signal(signal.SIGALRM, late)
    rng, results, failures, longest = np.random.default_rng(seed), Counter(), [], 0.0
    with tempfile.TemporaryDirectory() as name:
        files = good_files(Path(name))
        for file in files:
            for reader, read in readers(file):
                if (reader, file.name) != ("explain", "lane.npz"):
                    assert read()[0] == 0, (reader, file)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (size + BYTES, -1))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for number in range(count):
            file = files[number % len(files)]
            kind, data = damaged(rng, file)
            path = Path(name) / f"damaged{file.suffix}"
            path.write_bytes(data)
            for reader, read in readers(path):
                faulthandler.dump_traceback_later(3 * SECONDS, exit=True)
                signal.alarm(SECONDS)
                started = time.perf_counter()
                try:
                    code, words = read()
                    lines = [x for x in words.splitlines() if not x.startswith("jaxgrasp: warning")]
                    if code not in (0, 2) or (code == 2 and len(lines) != 1):
                        failures.append(f"{number} {kind} {reader}: {code} {words}")
                    results[kind, reader, "refused" if code else "read"] += 1
                except BaseException:
                    failures.append(f"{number} {kind} {reader}:\n{traceback.format_exc()}")
                finally:
                    signal.alarm(0)
                    faulthandler.cancel_dump_traceback_later()
                longest = max(longest, time.perf_counter() - started)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10
    return {
        "files": count,
        "refused": sum(n for (*_, what), n in results.items() if what == "refused"),
        "read": sum(n for (*_, what), n in results.items() if what == "read"),
        "longest_seconds": round(longest, 2),
        "grown_megabytes": grown,
        "failures": failures,
        "table": {" ".join(key): n for key, n in sorted(results.items())},
    }


def run(*arguments, timeout):
    """A process of its own: limits on memory stay there."""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, *map(str, arguments)], env=environment, capture_output=True, text=True,
        timeout=timeout, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("count", [120, pytest.param(2000, marks=pytest.mark.slow)])
def test_damaged_files_get_one_line(count):
    done = run(__file__, count, 0, timeout=1800)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["failures"] == [], "\n".join(found["failures"][:3])
    assert found["refused"] > count / 2 and found["read"] > 0
    assert found["grown_megabytes"] < 2000


if __name__ == "__main__":
    print(json.dumps(fuzz(int(sys.argv[1]), int(sys.argv[2]))))
