"""How good is the grasp? Ferrari and Canny's epsilon: the largest wrench that unit effort resists all around."""

import jax
import numpy as np

import jaxgrasp as jg

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32

turn = np.radians([90.0, 210.0, 330.0])
normal = -np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=-1)  # into the can
grasp = jg.Grasp(-0.04 * normal, normal, jg.HardFinger(friction=0.5))  # m, about the centre of mass

# Effort is the sum of the normal forces (L1). Torques are divided by the largest distance of a contact, 4 cm.
quality = jg.epsilon_quality(grasp, tolerance=1e-3, certificate=True)
print(quality)
print("both bounds proved again:", jg.check(grasp, quality))
print(f"ten newtons of squeeze resist every wrench up to {10 * quality.lower:.2f} N")

# prints:
# Wrench resistant (force closure): the internal force proves it. Epsilon (L1) between 0.287025 and 0.288386.
# both bounds proved again: True
# ten newtons of squeeze resist every wrench up to 2.87 N
