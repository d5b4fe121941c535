"""Is the motor strong enough? A jaw gripper with one motor lifts a body that is turned in the world."""

import jax
import numpy as np

import jaxgrasp as jg

jax.config.update("jax_enable_x64", True)  # 64-bit; without it JAX computes in float32

# Contacts in body axes; the body is turned by 90 degrees about z, so that the jaws close along the world's x axis.
position = np.array([[0, 0.03, 0], [0, -0.03, 0]])
grasp = jg.Grasp(position, -position, jg.HardFinger(friction=0.5))
orientation = np.array([1, 0, 0, 1]) / np.sqrt(2)  # unit quaternion (w, x, y, z)
weight = np.array([0, 0, -3.0, 0, 0, 0])  # N

# One joint moves finger 0 along +x and finger 1 along -x of the world: velocities (3 rows a finger) per joint rate.
jacobian = np.array([[1.0, 0, 0, -1.0, 0, 0]]).T

for motor in (8.0, 6.5, 5.0):  # N, of both jaws together
    limits = jg.TorqueLimits(jacobian, np.array([motor]), axes="world", orientation=orientation)
    answer = jg.optimize_forces(grasp, weight, torque_limits=limits)
    proved = jg.check(grasp, answer, wrench=weight, criterion=jg.Gentlest(), torque_limits=limits)
    print(f"motor of {motor} N: {jg.Status(int(answer.status)).name}, proved again: {proved}")

# prints:
# motor of 8.0 N: OPTIMAL, proved again: True
# motor of 6.5 N: OPTIMAL, proved again: True
# motor of 5.0 N: INFEASIBLE, proved again: True
