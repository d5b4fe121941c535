"""Test session set-up: CPU, dtype, strict promotion."""

import os
import tempfile

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# The command line keeps compiled programs; the tests keep theirs out of the user's home.
os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="jaxgrasp-cache-")

import jax
import pytest

DTYPE = os.environ.get("JAXGRASP_TEST_DTYPE", "float64")
if DTYPE not in ("float32", "float64"):
    raise pytest.UsageError(f"JAXGRASP_TEST_DTYPE must be float32 or float64, not {DTYPE!r}")
jax.config.update("jax_enable_x64", DTYPE == "float64")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(scope="session")
def dtype():
    return DTYPE
