"""What a file says about its making: the command to type for it, the backend, the versions."""

from __future__ import annotations

import hashlib
import platform
import shlex
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..core import __version__

__all__ = ["command_line", "digest", "provenance"]


def command_line(command: str, source: str, options: dict[str, Any]) -> str:
    """What to type: ``jaxgrasp COMMAND SOURCE`` and the options in order, which may be written as field names.

    None and False are left out, True is a flag without a value, a tuple is numbers apart by commas.
    """
    words = ["jaxgrasp", command, source]
    for name, value in options.items():
        if value is None or value is False:
            continue
        words.append(f"--{name.replace('_', '-')}")
        if isinstance(value, tuple):
            words.append(",".join(map(repr, map(float, value))))
        elif value is not True:
            words.append(str(value))
    return shlex.join(words)


def provenance(command: str, source: str, options: dict[str, Any]) -> dict[str, Any]:
    """Metadata that say how a file was made; the arguments are those of ``command_line``."""
    return {
        "command": command_line(command, source, options),
        "backend": jax.default_backend(),
        "versions": {
            "jaxgrasp": __version__,
            "jax": jax.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def digest(source: str) -> str:
    """SHA-256 of the file."""
    with Path(source).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
