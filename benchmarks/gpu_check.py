"""The first eight minutes on a GPU: is jaxgrasp right there, and how fast? One command, one JSON, one small table.

    python benchmarks/gpu_check.py                              # 8 minutes on JAX's default device
    python benchmarks/gpu_check.py --budget 240 --json out/gpu.json
    JAX_PLATFORMS=cpu python benchmarks/gpu_check.py --small    # a trial on the CPU
    python benchmarks/gpu_check.py --only margin-k4 verdict-k4  # some items: parts of their names
    JAX_PLATFORMS=cpu python benchmarks/gpu_check.py --make-reference benchmarks/data/gpu_reference.npz

Items come in order of importance, in rounds. The programs of a round compile beside each other; then each is checked
against answers that the CPU stored, by the independent checker, and for the same bits at another place in the batch
and in another batch; then it is timed, alone. Speeds of answers that are not right are not reported. The JSON is
written after every item, beside itself and renamed. An item that fails is recorded and the rest goes on; one that does
not fit into the time left or into the memory is skipped with a word. Exit code 1 where something is wrong or failed.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
import traceback
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

START = time.perf_counter()
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # so that the peak is what was needed

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

jax.config.update("jax_enable_x64", True)

from gpu_cases import BLOCK, CRITERIA, WORDS, Task, batch_data, program_of, to_host  # noqa: E402
from gpu_profile import ceilings, hardware, memory_of, program_figures, seconds_of, traced  # noqa: E402
from gpu_reference import CONTACTS, Reference, make_reference  # noqa: E402

from jaxgrasp.backend import remember_compilations, tile_width  # noqa: E402

REFERENCE = Path(__file__).parent / "data" / "gpu_reference.npz"
CLOSING = 5.0  # seconds kept for the end
# Guesses of the seconds to trace and to compile one program, corrected by what earlier rounds took.
TRACING, COMPILING, MEASURING = 3.0, 25.0, 3.0
F32, F64 = "float32", "float64"


def rounds_of(small: bool) -> list[list[Task]]:
    """Items in order of importance; programs of one round compile beside each other."""
    few, many = (256, 1024) if small else (10_000, 1_000_000)
    first = [Task("margin", 4, F64, few), Task("gentlest", 4, F64, few), Task("verdict", 4, F32, few)]
    right = [Task("margin", 4, F32, few), Task("verdict", 4, F64, few), Task("gentlest", 4, F32, few)]
    right += [Task("margin-gradient", 4, F64, few), Task("gentlest-gradient", 4, F64, few)]
    fast = [Task("margin", 4, F64, many), Task("verdict", 4, F32, many), Task("gentlest", 4, F64, many)]
    if small:
        return [first, [*right, Task("margin", 3, F64, few)], fast[:1]]
    more = [Task("margin", 4, F32, many), Task("verdict", 4, F64, many), Task("gentlest", 4, F32, many)]
    more += [Task("margin-gradient", 4, F64, many), Task("gentlest-gradient", 4, F64, many)]
    others = [k for k in CONTACTS if k != 4]
    wide = [Task("margin", k, F64, few) for k in others] + [Task("gentlest", k, F64, few) for k in others]
    wide_fast = [Task("margin", k, F64, many) for k in others] + [
        Task("verdict", k, F32, many) for k in others
    ]
    sizes = [Task("margin", 4, F64, 10 * many), Task("verdict", 4, F32, 10 * many)]
    sizes += [Task("margin", 4, F64, 10 * few), Task("gentlest", 4, F64, 10 * few)]
    rest = [c for c in CRITERIA if c != "gentlest"]
    criteria = [Task(c, 4, F64, few) for c in rest] + [Task("least-norm-force-gradient", 4, F64, few)]
    single = [Task(q, k, F32, few) for q in ("margin", "gentlest") for k in others]
    gradients = [Task(f"{q}-gradient", k, F64, few) for q in ("margin", "gentlest") for k in others]
    late = [Task(c, 4, F64, many) for c in rest] + [Task("least-norm-force-gradient", 4, F64, many)]
    late += [Task("gentlest", k, F64, many) for k in others]
    return [first, fast, right, wide, more, wide_fast, sizes, criteria, single, gradients, late]


class Results:
    """The JSON: written whole after every change, beside itself and renamed."""

    def __init__(self, path: Path, options: dict[str, Any]):
        self.path = path
        self.content: dict[str, Any] = {"options": options, "machine": {}, "items": [], "profiles": {}}
        self.content |= {"skipped": [], "errors": []}
        path.parent.mkdir(parents=True, exist_ok=True)

    def save(self) -> None:
        self.content["seconds"] = round(time.perf_counter() - START, 2)
        beside = self.path.with_name(self.path.name + ".tmp")
        beside.write_text(json.dumps(self.content, indent=1))
        beside.replace(self.path)

    def skip(self, name: str, why: str) -> None:
        self.content["skipped"].append({"item": name, "why": why})
        self.save()
        print(f"{name:40s} skipped: {why}", flush=True)

    def failed(self, name: str, error: BaseException) -> None:
        words = f"{type(error).__name__}: {str(error)[:600]}"
        self.content["errors"].append({"item": name, "error": words})
        self.save()
        print(f"{name:40s} FAILED: {words[:200]}", flush=True)
        traceback.print_exception(error, limit=4, file=sys.stderr)

    def add(self, entry: dict[str, Any]) -> None:
        self.content["items"].append(entry)
        self.save()
        print(row_of(entry), flush=True)

    @property
    def wrong(self) -> bool:
        return bool(self.content["errors"]) or any(item["failures"] for item in self.content["items"])


class Compiled(NamedTuple):
    """A program ready to run, and what it took to make it."""

    run: Any
    tracing: float
    compiling: float


def compiled(task: Task) -> Compiled:
    """Trace and compile for the shapes of ``task``; nothing runs."""
    shapes = [(task.batch, task.contacts, 3)] * 2 + [(task.batch, task.contacts)]
    shapes += [(task.batch, 6)] if task.of_forces else []
    start = time.perf_counter()
    lowered = jax.jit(program_of(task)).lower(
        *(jax.ShapeDtypeStruct(s, jnp.dtype(task.dtype)) for s in shapes)
    )
    traced_at = time.perf_counter()
    program = lowered.compile()
    return Compiled(program, traced_at - start, time.perf_counter() - traced_at)


class Check:
    """Works through the rounds until the budget is spent."""

    def __init__(self, options: argparse.Namespace, reference: Reference, results: Results):
        self.options, self.reference, self.results = options, reference, results
        self.threads = max(1, min(8, os.cpu_count() or 1))
        self.pool = ThreadPoolExecutor(self.threads)
        self.slowness = 1.0  # seconds a round took for each second guessed
        self.bits: dict[tuple[str, int, str], tuple[int, list[bytes]]] = {}
        self.unfinished = False

    def left(self) -> float:
        return self.options.budget - CLOSING - (time.perf_counter() - START)

    def work(self) -> None:
        for tasks in rounds_of(self.options.small):
            wanted = [
                t for t in tasks if not self.options.only or any(o in t.label for o in self.options.only)
            ]
            while wanted and self._guess(wanted) > self.left():
                self.results.skip(
                    wanted[-1].label, f"needs about {self._guess(wanted):.0f} s, {self.left():.0f} s left"
                )
                wanted.pop()
            if wanted:
                self._round(wanted)

    def _guess(self, tasks: list[Task]) -> float:
        together = -(-len(tasks) // self.threads)
        making = TRACING * len(tasks) + COMPILING * together
        return self.slowness * making + MEASURING * len(tasks)

    def _round(self, tasks: list[Task]) -> None:
        """Compile all, wait, then check and time one after another: nothing is timed beside a compilation."""
        start, guess = time.perf_counter(), self._guess(tasks) - MEASURING * len(tasks)
        futures: dict[Task, Future[Compiled]] = {t: self.pool.submit(compiled, t) for t in tasks}
        done, late = wait(futures.values(), timeout=max(1.0, self.left()))
        if not late:
            self.slowness *= min(4.0, max(0.25, (time.perf_counter() - start) / guess))
        for task, future in futures.items():
            if future not in done:
                future.cancel()
                self.unfinished = True
                self.results.skip(task.label, "still compiling when the time was up")
                continue
            if self.left() < 0:
                self.results.skip(task.label, "compiled, but the time was up")
                continue
            try:
                self._item(task, future.result())
            except Exception as error:
                self.results.failed(task.label, error)

    def _item(self, task: Task, program: Compiled) -> None:
        figures = program_figures(program.run)
        limit = memory_of(jax.devices()[0]).get("bytes_limit")
        needed = figures["temp_bytes"] + 2 * (figures["argument_bytes"] + figures["output_bytes"])
        if limit and needed > 0.9 * limit:
            self.results.skip(task.label, f"needs {needed / 1e9:.1f} GB of {limit / 1e9:.1f} GB")
            return
        entry: dict[str, Any] = {**task._asdict(), "item": task.label, "program": figures}
        entry |= {"trace_seconds": program.tracing, "compile_seconds": program.compiling}
        data = batch_data(task)
        entry["first_run_seconds"] = seconds_of(lambda: program.run(*data))
        self._judge(task, program.run, data, entry)
        if entry["answers_right"]:
            self._time(program.run, data, entry)
        entry["memory"] = memory_of(jax.devices()[0])
        self.results.add(entry)
        if task in PROFILED and entry["answers_right"]:
            try:
                self.results.content["profiles"][task.label] = traced(lambda: program.run(*data))
            except Exception as error:
                self.results.failed(f"profile of {task.label}", error)
            self.results.save()

    def _judge(self, task: Task, run: Any, data: tuple[jax.Array, ...], entry: dict[str, Any]) -> None:
        """Right beside the reference and for the checker; the same bits elsewhere in the batch and in others."""
        lanes, shift = min(self.reference.lanes, task.batch), task.batch // 2 + 1
        answer, gradients = run(*data)
        ours = to_host((answer, gradients), 0, lanes)
        figures, failures = self.reference.judge(task, *ours)
        entry["answers_right"] = not failures
        status = np.bincount(np.asarray(answer.status), minlength=max(WORDS) + 1)
        entry["statuses"] = {word: int(status[value]) for value, word in WORDS.items() if status[value]}
        del answer, gradients
        bits = [np.ascontiguousarray(x).tobytes() for x in jax.tree.leaves(ours)]
        moved = tuple(jnp.roll(x, shift, axis=0) for x in data)
        elsewhere = _lanes_at(run(*moved), shift, lanes, task.batch)
        figures["bits_moved"] = _differing(bits, jax.tree.leaves(elsewhere))
        if figures["bits_moved"]:
            failures.append(f"other bits at another place in the batch in {figures['bits_moved']} arrays")
        key = (task.question, task.contacts, task.dtype)
        if key in self.bits and self.bits[key][0] <= lanes:
            count, before = self.bits[key]
            same = [np.asarray(x)[:count] for x in jax.tree.leaves(ours)]
            figures["bits_in_other_batch"] = _differing(before, same)
            if figures["bits_in_other_batch"]:
                failures.append(f"other bits in another batch in {figures['bits_in_other_batch']} arrays")
        self.bits.setdefault(key, (lanes, bits))
        entry["checks"], entry["failures"] = figures, failures

    def _time(self, run: Any, data: tuple[jax.Array, ...], entry: dict[str, Any]) -> None:
        """Median of repeats on two orders of the same grasps."""
        sets = (data, tuple(jnp.flip(x, axis=0) for x in data))
        seconds_of(lambda: run(*sets[1]))
        times: list[float] = []
        until = time.perf_counter() + min(2.0, max(0.0, self.left()))
        while len(times) < 3 or (len(times) < 30 and time.perf_counter() < until):
            times.append(seconds_of(lambda: run(*sets[len(times) % 2])))
        median = statistics.median(times)
        unproved = (entry["checks"]["silent"] + entry["checks"]["rejected"]) / entry["checks"]["lanes"]
        entry["timing"] = {
            "seconds": median,
            "fastest": min(times),
            "slowest": max(times),
            "repeats": len(times),
            "per_second": entry["batch"] / median,
            "proved_per_second": (1 - unproved) * entry["batch"] / median,
        }


PROFILED = {
    Task("margin", 4, F64, 256),
    Task("margin", 4, F64, 10_000),
    Task("margin", 4, F64, 1_000_000),
    Task("gentlest", 4, F64, 1_000_000),
}


def _lanes_at(tree: Any, start: int, lanes: int, batch: int) -> Any:
    """``lanes`` lanes from ``start``, around the end of the batch, on the host."""
    head = to_host(tree, start, min(lanes, batch - start))
    tail = to_host(tree, 0, max(0, lanes - (batch - start)))
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), head, tail)


def _differing(bits: list[bytes], arrays: list[Any]) -> int:
    return sum(b != np.ascontiguousarray(x).tobytes() for b, x in zip(bits, arrays, strict=True))


def row_of(entry: dict[str, Any]) -> str:
    """One item as a row of the table."""
    speed = entry.get("timing")
    cells = [
        entry["item"],
        "; ".join(entry["failures"]) or "right",
        f"{speed['seconds'] * 1e3:.2f}" if speed else "-",
        f"{speed['per_second'] / 1e6:.3f}" if speed else "-",
        f"{entry['trace_seconds'] + entry['compile_seconds']:.1f}",
        str(entry["program"]["kernels"]),
        f"{entry['program']['temp_bytes'] / 1e6:.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


def table_of(content: dict[str, Any]) -> str:
    machine = content["machine"]
    lines = [
        f"{machine.get('device')} ({machine.get('platform')}), jax {machine.get('jax')}, {content['seconds']:.0f} s",
        "",
        "| item | answers | ms | million a second | compile s | kernels | scratch MB |",
        "|---|---|---|---|---|---|---|",
        *map(row_of, content["items"]),
        "",
        f"{len(content['errors'])} failed, {len(content['skipped'])} skipped",
    ]
    return "\n".join(lines) + "\n"


def options_of(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--json", type=Path, default=Path("gpu_check.json"), help="results (default gpu_check.json)"
    )
    parser.add_argument("--markdown", type=Path, help="the table (default: beside the JSON)")
    parser.add_argument("--budget", type=float, default=480.0, help="seconds in all (default 480)")
    parser.add_argument("--reference", type=Path, default=REFERENCE, help="stored answers of the CPU")
    parser.add_argument("--small", action="store_true", help="a few small batches, for a CPU")
    parser.add_argument("--only", nargs="+", default=[], metavar="PART", help="items whose name holds a PART")
    parser.add_argument("--cache", type=Path, help="keep compiled programs here (default ~/.cache/jaxgrasp)")
    parser.add_argument(
        "--make-reference", type=Path, metavar="FILE", help="store this CPU's answers, and end"
    )
    parser.add_argument(
        "--lanes", type=int, default=BLOCK, help=f"grasps a k in the reference (at most {BLOCK})"
    )
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    options = options_of(arguments)
    if options.cache:
        jax.config.update("jax_compilation_cache_dir", str(options.cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    else:
        remember_compilations()
    if options.make_reference:
        make_reference(options.make_reference, min(options.lanes, BLOCK), lambda s: print(s, flush=True))
        return 0
    reference = Reference.read(options.reference)
    asked = {k: v.name if isinstance(v, Path) else str(v) for k, v in vars(options).items()}
    results = Results(options.json, asked)
    content = results.content
    for name, ask in (
        ("hardware", hardware),
        ("ceilings", lambda: ceilings(1 << (20 if options.small else 28))),
    ):
        try:
            content["machine"] |= ask()
        except Exception as error:
            results.failed(name, error)
    content["machine"]["tile"] = tile_width(72)
    results.save()
    print(json.dumps(content["machine"]), flush=True)
    check = Check(options, reference, results)
    check.work()
    results.save()
    table = table_of(content)
    (options.markdown or options.json.with_suffix(".md")).write_text(table)
    print("\n" + table, flush=True)
    if check.unfinished:  # do not wait for compilations that no longer matter
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(1 if results.wrong else 0)
    return 1 if results.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
