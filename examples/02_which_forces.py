"""With which forces do three fingers lift a can of 3 N, so that the largest normal force is least?"""

import jax
import numpy as np

import jaxgrasp as jg

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32

turn = np.radians([90.0, 210.0, 330.0])
normal = -np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=-1)  # into the can
grasp = jg.Grasp(-0.04 * normal, normal, jg.HardFinger(friction=0.5))  # m, about the centre of mass

load = np.array([0, 0, -3.0, 0, 0, 0])  # N, N m: the weight, about the centre of mass
criterion = jg.Gentlest()

answer = jg.optimize_forces(grasp, load, criterion=criterion)
print(answer)
print("proved again:", jg.check(grasp, answer, wrench=load, criterion=criterion))
print("forces as vectors (x, y, z) in body axes, N:")
print(np.asarray(jg.force_vectors(grasp, answer.force)).round(3) + 0.0)
print("one newton more of weight costs", -answer.load_twist[2].round(3), "N more")

# prints:
# Optimal: the forces balance the load inside every cone, and the bound proves the cost. Cost between 2 and 2.
# proved again: True
# forces as vectors (x, y, z) in body axes, N:
# [[ 0.    -2.     1.   ]
#  [ 1.732  1.     1.   ]
#  [-1.732  1.     1.   ]]
# one newton more of weight costs 0.667 N more
