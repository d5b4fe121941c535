"""Does the swing stop? A regulator for two fingers that pinch a body above its centre of mass, and at its height."""

import jax
import numpy as np

import jaxgrasp as jg

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32

position = np.array([[[-0.03, 0, z], [0.03, 0, z]] for z in (0.02, 0.0)])
grasps = jg.Grasp(position, np.array([[1.0, 0, 0], [-1.0, 0, 0]]), jg.HardFinger(0.5))
body = jg.RigidBody(0.2, 1e-4 * np.diag([1.0, 1.2, 1.5]))  # kg, kg m^2

keep = jg.regulator(grasps, body, timestep=0.002, effort=3.0)
start = jg.BodyState.at_rest(3, (2,)).displaced(
    jax.numpy.array([0, 0, 0, 0.1, 0, 0])
)  # 0.1 rad about the fingers
loop = jg.close_loop(
    grasps, body, controller=keep, state=start, simulation=jg.motion.Simulation(1500, timestep=0.002)
)
for lane, name in enumerate(("above", "through")):
    word = jg.Status(int(loop.status[-1, lane])).name
    tilt = loop.orientation_error[-1, lane]
    print(f"fingers {name} the centre of mass: tilt {tilt:.3f} rad after 3 s, last step {word}")
print("all forces inside their cones:", bool(loop.cone_use.max() <= 1 + 1e-9))

# prints:
# fingers above the centre of mass: tilt 0.000 rad after 3 s, last step COMMANDED
# fingers through the centre of mass: tilt 0.100 rad after 3 s, last step UNREGULATED
# all forces inside their cones: True
