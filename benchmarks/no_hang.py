"""Does everything come back? What once called LAPACK, ten times each on many grasps, then in two threads at once.

    python benchmarks/no_hang.py [GRASPS] [TIMES]

Prints seconds of the first call (it compiles), the median and the longest of the others, and those of two threads. A
call that takes longer than five minutes ends the process with the tracebacks of all threads.
"""

import faulthandler
import statistics
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg

SECONDS = 300.0


def cases(count: int) -> dict:
    rng = np.random.default_rng(0)
    position = rng.normal(size=(count, 4, 3))
    position /= 20 * np.linalg.norm(position, axis=-1, keepdims=True)
    normal = -20 * position + 0.3 * rng.normal(size=position.shape)
    grasp = jg.Grasp(position, normal, jg.HardFinger(0.5))
    body = jg.RigidBody(0.3, np.diag([2e-4, 2e-4, 1e-4]))
    state = jg.BodyState(
        jnp.asarray(0.001 * rng.normal(size=(count, 3))),
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (count, 1)),
        jnp.zeros((count, 6)),
    )
    load = np.array([0, 0, -3.0, 0, 0, 0])

    def closed(controller):
        return jg.close_loop(
            grasp, body, controller=controller, state=state, simulation=jg.motion.Simulation(5)
        )

    regulator = jg.regulator(grasp, body)
    return {
        "guaranteed_radius": lambda: jg.guaranteed_radius(grasp),
        "controllability": lambda: jg.controllability(grasp, body),
        "regulator": lambda: jg.regulator(grasp, body),
        "closed loop, regulated": lambda: closed(regulator),
        "closed loop, computed torque": lambda: closed(jg.ComputedTorque(jg.Gains.of_rate(25.0))),
        "isotropy": lambda: jg.quality.grasp_isotropy(grasp),
        "volume": lambda: jg.quality.grasp_volume(grasp),
        "grasp_rank": lambda: jg.grasp_rank(grasp),
        "null_space": lambda: jg.null_space(grasp),
        "squeeze": lambda: jg.squeeze(grasp, load),
        "lmi_margin, 64 grasps": lambda: jg.lmi.lmi_margin(grasp[:64]),
        "epsilon_quality, 256 grasps": lambda: jg.epsilon_quality(grasp[:256]),
    }


def timed(function) -> float:
    faulthandler.dump_traceback_later(SECONDS, exit=True)
    started = time.perf_counter()
    jax.block_until_ready(function())
    faulthandler.cancel_dump_traceback_later()
    return time.perf_counter() - started


def together(function, times: int) -> float:
    faulthandler.dump_traceback_later(times * SECONDS, exit=True)
    threads = [
        threading.Thread(target=lambda: [jax.block_until_ready(function()) for _ in range(times)])
        for _ in "12"
    ]
    started = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    faulthandler.cancel_dump_traceback_later()
    return time.perf_counter() - started


def main(count: int = 10_000, times: int = 10) -> None:
    jax.config.update("jax_enable_x64", True)
    print(f"{count} grasps; {times} times, then {times} times in each of two threads; seconds")
    print(f"{'':30} {'first':>7} {'median':>7} {'longest':>7} {'threads':>7}")
    for name, function in cases(count).items():
        first = timed(function)
        others = [timed(function) for _ in range(times)]
        row = (first, statistics.median(others), max(others), together(function, times))
        print(f"{name:30} " + " ".join(f"{x:7.2f}" for x in row), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
