"""The file every benchmark's ``--json`` writes: hardware, options, figures."""

from __future__ import annotations

import argparse
import json
from typing import Any


def write_figures(options: argparse.Namespace, machine: dict[str, str], **figures: Any) -> None:
    """Write beside ``options.json`` and rename; nothing where no file was asked for."""
    if options.json is None:
        return
    beside = options.json.with_suffix(".tmp")
    settings = vars(options) | {"json": None}
    beside.write_text(json.dumps({"hardware": machine, "options": settings, **figures}, indent=1))
    beside.replace(options.json)
    print(f"\nwritten to {options.json}")
