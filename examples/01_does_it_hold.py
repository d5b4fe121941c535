"""Does this grasp hold? Three hard fingers around a can of 4 cm radius, at the height of its centre of mass."""

import jax
import numpy as np

import jaxgrasp as jg

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32

turn = np.radians([90.0, 210.0, 330.0])
normal = -np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=-1)  # into the can
grasp = jg.Grasp(-0.04 * normal, normal, jg.HardFinger(friction=0.5))  # m, about the centre of mass

answer = jg.wrench_resistance(grasp)
print(answer)
print("proved again with NumPy alone:", jg.check(grasp, answer))
print("the squeeze that proves it, a row (f_x, f_y, f_n) a finger:")
print(np.asarray(answer.internal_force).reshape(3, 3).round(4) + 0.0)

# prints:
# Wrench resistant (force closure): the internal force proves it. Margin between 1 and 1, rank 6.
# proved again with NumPy alone: True
# the squeeze that proves it, a row (f_x, f_y, f_n) a finger:
# [[0. 0. 1.]
#  [0. 0. 1.]
#  [0. 0. 1.]]
