"""Can two fingers steer what they hold? Not alone; but an object that hangs below them swings back by its weight."""

import jax
import numpy as np

import jaxgrasp as jg

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32

# Two hard fingers pinch a body of 200 g: 2 cm above its centre of mass, and at its height.
position = np.array([[[-0.03, 0, z], [0.03, 0, z]] for z in (0.02, 0.0)])
grasps = jg.Grasp(position, np.array([[1.0, 0, 0], [-1.0, 0, 0]]), jg.HardFinger(0.5))
body = jg.RigidBody(0.2, 1e-4 * np.diag([1.0, 1.2, 1.5]))  # kg, kg m^2

answer = jg.controllability(grasps, body, gravity=(0, 0, -9.81))
for lane, name in enumerate(("above", "through")):
    print(f"Fingers {name} the centre of mass:")
    print(jg.Status(int(answer.status[lane])).name, "rank", int(answer.rank[lane]), "of 12")
    if not np.isfinite(answer.effort[lane]):
        print(jg.report.explain_controllability(answer, lane).splitlines()[-1])

# prints:
# Fingers above the centre of mass:
# CONTROLLABLE rank 12 of 12
# Fingers through the centre of mass:
# NOT_CONTROLLABLE rank 10 of 12
# Out of reach: a rotation about the axis along (1, 0, 0) through the centre of mass.
