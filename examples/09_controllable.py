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
    print(jg.report.explain_controllability(answer, lane))
