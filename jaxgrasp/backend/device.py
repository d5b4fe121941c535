"""Start-up on whatever machine this is: without a working accelerator, the CPU and one line."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import jax.numpy as jnp
from jax.extend.backend import clear_backends

__all__ = ["precision", "remember_compilations", "usable_backend"]


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


def remember_compilations() -> Path | None:
    """Keep compiled programs between runs, so that only the first one waits for the compiler; where they are kept.

    They go to ``$XDG_CACHE_HOME/jaxgrasp`` (default ``~/.cache``), apart by processor: a home directory may be shared
    by machines that do not run each other's code. ``JAX_COMPILATION_CACHE_DIR``
    overrides this; set it empty to keep none.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or jax.config.jax_compilation_cache_dir:  # pyright: ignore
        return None
    cpuinfo = Path("/proc/cpuinfo")
    flags = (
        [line for line in cpuinfo.read_text().splitlines() if line.startswith(("flags", "Features"))][:1]
        if (cpuinfo.exists())
        else []
    )
    machine = "\n".join([platform.platform(), platform.processor(), jax.__version__, *flags])
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    directory = root / "jaxgrasp" / hashlib.sha256(machine.encode()).hexdigest()[:16]
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None  # a read-only home: compile every time
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    return directory
