"""How much friction does the grasp need? Three fingers around a can, one of them 1 cm too high."""

import jax
import numpy as np

import jaxgrasp as jg

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32

turn = np.radians([90.0, 210.0, 330.0])
normal = -np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=-1)
position = -0.04 * normal + np.array([[0, 0, 0.01], [0, 0, 0], [0, 0, 0]])
grasp = jg.Grasp(position, normal, jg.HardFinger(friction=0.5))

answer = jg.critical_friction(grasp)
print(answer)
print(f"it needs mu = {0.5 * answer.factor:.4f}, it has 0.5")
for factor in (0.99 * answer.lower, 1.01 * answer.upper):
    verdict = jg.wrench_resistance(jg.quality.with_friction_factor(grasp, factor))
    print(f"at mu = {0.5 * factor:.3f}: {jg.Status(int(verdict.status)).name}")

# prints:
# Holds as it is: less friction would do. It holds from 0.333333 times its friction on.
# it needs mu = 0.1667, it has 0.5
# at mu = 0.165: NOT_RESISTANT
# at mu = 0.168: RESISTANT
