"""Test session set-up: CPU, dtype, strict promotion."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

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
