"""Test session set-up: CPU, dtype, strict promotion, quick compilation and one store of compiled programs.

Programs compile without optimisation: five times faster than what users get, with the same verdicts;
``test_users_level.py`` checks the kernels at the users' level. ``JAXGRASP_TEST_OPTIMIZATION=3`` runs everything there.
All workers, and the processes that tests start, share one store of compiled programs:
``JAX_COMPILATION_CACHE_DIR``, or ``.jax_test_cache`` in the checkout, which keeps the next run warm.
"""

import contextlib
import ctypes
import gc
import os
import shutil
import tempfile
from pathlib import Path

import pytest
from compiling import LEVEL_FLAG, quick_flags

ROOT = Path(__file__).resolve().parents[1]
STORE = ROOT / ".jax_test_cache"
STORE_BYTES = 500_000_000  # a cold run leaves about 60 MB; what was longest unread goes first

os.environ.setdefault("JAX_PLATFORMS", "cpu")
if LEVEL_FLAG not in os.environ.get("XLA_FLAGS", ""):
    level = os.environ.get("JAXGRASP_TEST_OPTIMIZATION", "0")
    if level not in ("0", "1", "2", "3"):
        raise pytest.UsageError(f"JAXGRASP_TEST_OPTIMIZATION must be 0, 1, 2 or 3, not {level!r}")
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *quick_flags(level)]).strip()
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(STORE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

import jax  # noqa: E402 - it reads the environment
from interfaces import INTERFACES  # noqa: E402

DTYPE = os.environ.get("JAXGRASP_TEST_DTYPE", "float64")
if DTYPE not in ("float32", "float64"):
    raise pytest.UsageError(f"JAXGRASP_TEST_DTYPE must be float32 or float64, not {DTYPE!r}")
jax.config.update("jax_enable_x64", DTYPE == "float64")
jax.config.update("jax_numpy_dtype_promotion", "strict")

IS_WORKER = "PYTEST_XDIST_WORKER" in os.environ
if not IS_WORKER:  # the command line keeps compiled programs; the tests keep theirs out of the user's home
    os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="jaxgrasp-cache-")


def trim(folder: Path, limit: int) -> None:
    """Delete the files read longest ago until those left take at most ``limit`` bytes."""
    found = []
    for path in folder.glob("*"):
        try:
            found.append((path.stat().st_atime, path.stat().st_size, path))
        except OSError:
            continue  # another run trims at the same time
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= limit:
            break
        path.unlink(missing_ok=True)
        total -= size


def pytest_unconfigure(config):
    if IS_WORKER:
        return
    shutil.rmtree(os.environ["XDG_CACHE_HOME"], ignore_errors=True)
    if Path(os.environ["JAX_COMPILATION_CACHE_DIR"]) == STORE:
        trim(STORE, STORE_BYTES)


COLLECTED = pytest.StashKey[list[pytest.Item]]()  # before anything is deselected; for test_suite.py


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    config.stash[COLLECTED] = list(items)
    for item in items:
        if item.path.stem in INTERFACES:
            item.add_marker(pytest.mark.interface)


# Tracing makes so many objects that a third of its time is a search for garbage; files are searched between instead.
gc.disable()
RESIDENT_SHARE = 1 / 6  # of the machine's memory, for each worker


def is_large() -> bool:
    """Whether this process holds more than its share of the memory; True where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages > RESIDENT_SHARE * os.sysconf("SC_PHYS_PAGES")
    except (OSError, ValueError):
        return True


@pytest.fixture(autouse=True, scope="module")
def bounded_memory():
    """A compiled program keeps about 100 MB: after a file, all are dropped if there are many; the store has them."""
    yield
    if not is_large():
        return
    jax.clear_caches()
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="session")
def collected(request):
    """Every test that was found, those that this run leaves out included."""
    return request.config.stash[COLLECTED]


@pytest.fixture(scope="session")
def dtype():
    return DTYPE
