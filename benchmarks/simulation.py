"""Grasped objects per second: open loop in MJX, closed loop with force optimisation in every step.

    python benchmarks/simulation.py [--json FILE] [--grasps 64 512 4096] [--steps 500] [--contacts 4] [--repeats 3]

On the CPU one process pinned to one core; with JAX_PLATFORMS=cuda on a GPU. Random wrench resistant grasps (hard
fingers on a sphere of 4 cm radius with tilted normals, mu in [0.5, 0.8]) of bodies of 50 to 500 g, disturbed by a push
of 50 ms. A grasp-step of the closed loop is: error, commanded wrench, optimal contact forces, cone use, motion.
Float64. Compile times stand apart; rates are medians over repeats. No test asserts a time.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"
os.environ.setdefault("JAX_PLATFORMS", "cpu")
if os.environ["JAX_PLATFORMS"] == "cpu" and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import importlib.metadata  # noqa: E402
from typing import Any  # noqa: E402

import equinox as eqx  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from figures import write_figures  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402

H, RATE = 0.002, 30.0  # s; 1/s


def scene(count: int, k: int, seed: int) -> tuple[jg.Grasp, jg.RigidBody]:
    """Resistant grasps and bodies, repeated up to ``count``."""
    rng = np.random.default_rng(seed)
    tried = 2048
    position = rng.normal(size=(tried, k, 3))
    position /= np.linalg.norm(position, axis=-1, keepdims=True)
    normal = -position + 0.15 * rng.normal(size=position.shape)
    friction = rng.uniform(0.5, 0.8, size=(tried, 1)) * np.ones((tried, k))
    grasp = jg.Grasp(0.04 * position, normal, jg.HardFinger(friction))
    good = np.flatnonzero(jg.wrench_resistance(grasp, verdict_only=True).status == jg.Status.RESISTANT.value)
    chosen = np.resize(good, count)
    spread = rng.uniform(0.05, 1.0, (count, 3))
    mass = rng.uniform(0.05, 0.5, count)
    moments = (spread.sum(1, keepdims=True) - spread) * (mass * 0.02**2)[:, None]
    body = jg.RigidBody(mass, moments[:, :, None] * np.eye(3))
    return jax.tree.map(lambda x: x[chosen], grasp), body


def clocked(run, repeats: int) -> tuple[float, list[float], Any]:
    """Seconds of the first call, seconds of the others, the last result."""
    start = time.perf_counter()
    jax.block_until_ready(run())
    first, times, result = time.perf_counter() - start, [], None
    for _ in range(repeats):
        start = time.perf_counter()
        result = jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return first, times, result


def open_loop(body: jg.RigidBody, steps: int, repeats: int) -> dict[str, float]:
    """MJX alone under a constant wrench."""
    plant, n = jg.motion.mujoco_plant(body, timestep=H), len(body.mass)
    start = jg.BodyState.at_rest(3, (n,)).displaced(jnp.zeros((n, 6)), 1.0)
    wrench = -jg.motion.gravity_term(body)

    @eqx.filter_jit
    def run(plant, state):
        def step(state, _):
            return plant.advance(state, wrench), None

        return jax.lax.scan(step, state, None, length=steps)[0]

    first, times, _ = clocked(lambda: run(plant, start), repeats)
    return entry(first, times, n, steps)


def closed_loop(
    grasp: jg.Grasp, body: jg.RigidBody, criterion, steps: int, repeats: int, mujoco: bool
) -> dict[str, float]:
    """``close_loop`` around the analytic step or MJX, with its figures of merit."""
    n = len(body.mass)
    push = np.zeros((steps, n, 6))
    push[10:35, :, :3] = 0.5 * np.asarray(body.mass)[:, None] * 9.81 * np.array([0.6, 0.8, 0.0])
    start = jg.BodyState.at_rest(3, (n,))
    controller = jg.ComputedTorque(jg.Gains.of_rate(RATE), criterion=criterion)
    plant = jg.motion.mujoco_plant(body, timestep=H) if mujoco else None

    def run():
        return jg.close_loop(
            grasp,
            body,
            controller=controller,
            state=start,
            simulation=jg.motion.Simulation(steps, timestep=H, plant=plant),
            disturbance=jnp.asarray(push),
        )

    first, times, out = clocked(run, repeats)
    status = np.asarray(out.status)
    return entry(first, times, n, steps) | {
        "commanded": float((status == jg.Status.COMMANDED.value).mean()),
        "largest_cone_use_less_1": float(np.asarray(out.cone_use).max() - 1),
        "largest_final_position_error": float(np.asarray(out.position_error)[-1].max()),
    }


def entry(first: float, times: list[float], n: int, steps: int) -> dict[str, float]:
    """Rates and times."""
    middle = float(np.median(times))
    return {
        "grasp_steps_per_second": n * steps / middle,
        "microseconds": middle / n / steps * 1e6,
        "compile_seconds": max(first - middle, 0.0),
    }


def hardware() -> dict[str, str]:
    """What the figures were measured on."""
    cpu, info = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if info.exists():
        names = [x.split(":")[1].strip() for x in info.read_text().splitlines() if x.startswith("model name")]
        cpu = names[0] if names else cpu
    versions = {p: importlib.metadata.version(p) for p in ("jax", "mujoco", "mujoco-mjx", "numpy")}
    return {"device": str(jax.devices()[0]), "cpu": cpu, "python": platform.python_version(), **versions}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--grasps", type=int, nargs="+", default=[64, 512, 4096])
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--contacts", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    machine = hardware()
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    print(
        f"\n{'':44s} {'grasps':>7s} {'steps/s':>12s} {'us':>8s} {'compile s':>9s}  commanded   cone use - 1"
    )
    results = []
    for n in options.grasps:
        grasp, body = scene(n, options.contacts, options.seed)
        rows = {
            "open loop, MJX": lambda body=body: open_loop(body, options.steps, options.repeats),
            "closed loop, sum of squares, analytic": lambda g=grasp, b=body: closed_loop(
                g, b, jg.SumOfSquares(), options.steps, options.repeats, False
            ),
            "closed loop, sum of squares, MJX": lambda g=grasp, b=body: closed_loop(
                g, b, jg.SumOfSquares(), options.steps, options.repeats, True
            ),
        }
        for name, measure in rows.items():
            row = {"name": name, "grasps": n, **measure()}
            results.append(row)
            line = f"{name:44s} {n:7d} {row['grasp_steps_per_second']:12,.0f} {row['microseconds']:8.2f}"
            line += f" {row['compile_seconds']:9.1f}"
            if "commanded" in row:
                line += f"  {row['commanded']:9.4%}  {row['largest_cone_use_less_1']:12.1e}"
            print(line, flush=True)
    write_figures(options, machine, rows=results)


if __name__ == "__main__":
    main()
