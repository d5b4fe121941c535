"""The machine, a compiled program in numbers (kernels, bytes), and a trace of one run."""

from __future__ import annotations

import collections
import importlib.metadata
import os
import platform
import re
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

PACKAGES = ("jax", "jaxlib", "jax-cuda13-plugin", "jax-cuda12-plugin", "numpy", "equinox", "jaxtyping")
SMI = "name,driver_version,memory.total,clocks.sm,clocks.mem,power.limit,temperature.gpu"
# Operations of an optimised program that start a kernel or a copy.
LAUNCHED = {
    "copy", "copy-start", "custom-call", "dynamic-slice", "dynamic-update-slice", "fusion", "gather", "iota",
    "reduce", "scatter", "sort", "transpose", "broadcast",
}  # fmt: skip


def hardware() -> dict[str, Any]:
    """Device, driver and versions; reads only."""
    device = jax.devices()[0]
    found: dict[str, Any] = {
        "device": str(device.device_kind),
        "platform": device.platform,
        "cpu_cores": os.cpu_count(),
        "python": platform.python_version(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "bytes_limit": memory_of(device).get("bytes_limit"),
    }
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    if device.platform != "cpu":
        command = ["nvidia-smi", f"--query-gpu={SMI}", "--format=csv,noheader"]
        try:
            answer = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
            found["nvidia_smi"] = dict(zip(SMI.split(","), answer.stdout.strip().split(", "), strict=False))
        except (OSError, subprocess.TimeoutExpired) as error:
            found["nvidia_smi"] = f"{type(error).__name__}: {error}"
    return found


def ceilings(numbers: int) -> dict[str, float]:
    """Bytes a second of reading and writing ``numbers`` floats, and the cost of one small call."""
    add = jax.jit(lambda x: x + 1)
    large, small = jnp.arange(numbers, dtype=jnp.float32), jnp.zeros((), jnp.int32)
    copies, calls = [], []
    for _ in range(10):
        copies.append(seconds_of(lambda: add(large)))
        calls.append(seconds_of(lambda: add(small)))
    return {
        "copy_GB_per_second": 8 * numbers / float(np.median(copies[1:])) / 1e9,
        "small_call_microseconds": float(np.median(calls[1:])) * 1e6,
    }


def seconds_of(call: Callable[[], Any]) -> float:
    """Wall time until the results are there."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def memory_of(device: Any) -> dict[str, int]:
    """What the allocator says, where it says anything."""
    try:
        stats = device.memory_stats() or {}
    except (RuntimeError, NotImplementedError):
        stats = {}
    return {
        name: int(stats[name])
        for name in ("bytes_in_use", "peak_bytes_in_use", "bytes_limit")
        if name in stats
    }


def program_figures(compiled: Any) -> dict[str, Any]:
    """Kernels and loops of the optimised program, and the compiler's own estimate of bytes and operations.

    The compiler counts a loop's body once where it does not know the number of its rounds.
    """
    plan = compiled.memory_analysis()
    sizes = {
        f"{name}_bytes": int(getattr(plan, f"{name}_size_in_bytes", 0))
        for name in ("argument", "output", "temp")
    }
    cost = compiled.cost_analysis() or {}
    cost = cost[0] if isinstance(cost, list) else cost
    kept = {word.replace(" ", "_"): float(cost[word]) for word in ("flops", "bytes accessed") if word in cost}
    return {**sizes, **kept, **_launches(compiled.as_text())}


def _launches(text: str) -> dict[str, Any]:
    """What the text of an optimised program starts: by kind, and for each loop by its depth."""
    bodies: dict[str, list[str]] = {}
    entry, current = "", None
    for line in re.sub(r"/\*index=\d+\*/", "", text).splitlines():
        opening = re.match(r"^(ENTRY )?%?([\w.\-]+) .*\{$", line)
        if opening and "->" in line:
            current = opening.group(2)
            entry = current if opening.group(1) else entry
            bodies[current] = []
        elif line.startswith("}"):
            current = None
        elif current is not None:
            bodies[current].append(line)
    kinds: collections.Counter[str] = collections.Counter()
    loops: list[dict[str, Any]] = []

    def walk(name: str, depth: int) -> int:
        started = 0
        for line in bodies.get(name, ()):
            operation = re.search(r"= (?:\(.*?\)|\S+) ([\w\-]+)\(", line)
            if operation and operation.group(1) in LAUNCHED:
                kinds[operation.group(1)] += 1
                started += 1
            for kind, callee in re.findall(
                r"(body|to_apply|branch_computations=\{|calls)=?%?([\w.\-]+)", line
            ):
                if kind == "body":
                    trips = re.search(r'known_trip_count":\{"n":"(\d+)"', line)
                    at = len(loops)
                    loops.append({"depth": depth, "rounds": int(trips.group(1)) if trips else None})
                    loops[at]["kernels"] = walk(callee, depth + 1)
                elif operation and operation.group(1) in ("call", "async-start", "conditional"):
                    started += walk(callee, depth)
        return started

    own = walk(entry, 0)
    return {
        "kernels": own + sum(x["kernels"] for x in loops),
        "kinds": dict(kinds),
        "entry_kernels": own,
        "loops": loops,
    }


def traced(call: Callable[[], Any], most: int = 12) -> dict[str, Any]:
    """One run under JAX's profiler: kernels that ran on the device, its busy time, and the longest by name."""
    wall = seconds_of(call)
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            under_trace = seconds_of(call)
        files = sorted(Path(folder).rglob("*.xplane.pb"))
        if not files:
            return {"seconds": wall, "word": "the profiler wrote nothing"}
        data = jax.profiler.ProfileData.from_file(str(files[-1]))
    totals: dict[str, list[float]] = {}
    for plane in data.planes:
        if not plane.name.startswith("/device:"):
            continue
        for line in plane.lines:
            if not line.name.startswith("Stream"):
                continue
            for event in line.events:
                entry = totals.setdefault(event.name[:80], [0, 0.0])
                entry[0] += 1
                entry[1] += event.duration_ns * 1e-9
    found: dict[str, Any] = {"seconds": wall, "seconds_under_trace": under_trace}
    if not totals:
        return found | {"word": "no device in the trace"}
    longest = sorted(totals.items(), key=lambda item: -item[1][1])[:most]
    busy = sum(seconds for _, seconds in totals.values())
    return found | {
        "kernels_run": int(sum(count for count, _ in totals.values())),
        "busy_seconds": busy,
        "busy_share": busy / wall,
        "longest": [{"name": n, "runs": int(c), "seconds": s} for n, (c, s) in longest],
    }
