"""Start-up on whatever machine this is: without a working accelerator, the CPU and one line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
from jax.extend.backend import clear_backends

__all__ = ["precision", "usable_backend"]


def usable_backend(say: Callable[[str], None]) -> str:
    """Name of the backend that works ("cpu", "gpu"): JAX's choice, or the CPU after one line to ``say``."""
    try:
        jax.devices()
        jnp.zeros(8).block_until_ready()  # a driver may list a device that cannot compute
    except (RuntimeError, AssertionError) as error:  # JAX asserts where no backend of that name is installed
        wanted = jax.config.jax_platforms or "the default backend"  # pyright: ignore
        reason = str(error).splitlines()[0] if str(error) else "not installed"
        clear_backends()
        jax.config.update("jax_platforms", "cpu")
        jax.devices()
        say(f"no usable accelerator ({wanted}: {reason}); running on the CPU")
    return jax.default_backend()


@contextmanager
def precision(dtype: str) -> Iterator[None]:
    """Allow arrays of ``dtype``: 64-bit arrays must be enabled before the first one is made."""
    before = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    if dtype == "float64":
        jax.config.update("jax_enable_x64", True)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)
