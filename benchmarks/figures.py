"""What benchmarks share: options, the machine, and the file that ``--json`` writes: hardware, options, figures."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any


def parser_of_tables(description: str | None) -> argparse.ArgumentParser:
    """Options of a benchmark whose figures are a table."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    return parser


def write_table(options: argparse.Namespace, text: str, **figures: Any) -> None:
    """``text`` where ``--markdown`` asks for it, the figures where ``--json`` does."""
    import jax  # only now: benchmarks set its environment first

    if options.markdown:
        options.markdown.write_text(text + "\n")
    machine = {
        "jax": jax.__version__,
        "python": sys.version.split()[0],
        "device": jax.devices()[0].device_kind,
    }
    write_figures(argparse.Namespace(**vars(options) | {"markdown": None}), machine, **figures)


def write_figures(options: argparse.Namespace, machine: dict[str, str], **figures: Any) -> None:
    """Write beside ``options.json`` and rename; nothing where no file was asked for."""
    if options.json is None:
        return
    beside = options.json.with_suffix(".tmp")
    settings = vars(options) | {"json": None}
    beside.write_text(json.dumps({"hardware": machine, "options": settings, **figures}, indent=1))
    beside.replace(options.json)
    print(f"\nwritten to {options.json}")
