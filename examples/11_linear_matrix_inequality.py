"""Is the friction cone a linear matrix inequality, and does that road give the same margin?"""

import jax
import numpy as np

import jaxgrasp as jg

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32

turn = np.radians([90.0, 210.0, 330.0])
normal = -np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=-1)  # into the can
grasp = jg.Grasp(-0.04 * normal, normal, jg.HardFinger(friction=0.5))  # m, about the centre of mass

P, matrices = jg.lmi.friction_lmi(grasp)  # P(f) = sum_i f_i S_i, one block a contact
print("S_1 .. S_9:", matrices.shape)
for sideways in (0.2, 0.5, 0.8):  # N, beside a normal force of 1 N, with mu = 0.5
    force = np.tile([0.0, 0.0, 1.0], 3)
    force[0] = sideways
    print(f"f_x = {sideways} N: least eigenvalue of P(f) {np.linalg.eigvalsh(P(force)).min():.3f}")

by_cones, by_lmi = jg.wrench_resistance(grasp).margin, jg.lmi.lmi_margin(grasp)
print(f"margin by cones {by_cones:.6f}, by the LMI {by_lmi:.6f}")

# No x makes [[x, 1], [1, -1]] positive semidefinite; the multiplier proves it.
constant, one = np.array([[0.0, 1.0], [1.0, -1.0]]), np.array([[[1.0, 0.0], [0.0, 0.0]]])
print(jg.lmi.lmi_feasibility(constant, one).sentence())

# prints:
# S_1 .. S_9: (9, 9, 9)
# f_x = 0.2 N: least eigenvalue of P(f) 0.300
# f_x = 0.5 N: least eigenvalue of P(f) 0.000
# f_x = 0.8 N: least eigenvalue of P(f) -0.300
# margin by cones 1.000000, by the LMI 1.000000
# Infeasible: the matrix is positive semidefinite nowhere in reach of the certificate.
