"""Independent derivations of both planar models, by Lagrange's equation: tests and notebook 01 compare with them."""

from __future__ import annotations

import casadi as ca
import numpy as np

from jumplab.robot.sagittal import SagittalModel
from jumplab.task import GRAVITY


def pendulum(mass: float, gravity: float = GRAVITY) -> ca.Function:
    """(q, v, a), 4 each as in :mod:`jumplab.models.srmp`, -> (tau_l, F_phi, tau_pl, F_varphi) (4,) (Eq. 2)."""
    q, v, a = (ca.SX.sym(n, 4) for n in "qva")
    centre = q[1] * ca.vertcat(ca.sin(q[0]), ca.cos(q[0]))
    offset = q[3] * ca.vertcat(ca.sin(q[0] + q[2]), ca.cos(q[0] + q[2]))
    kinetic, potential = 0, 0
    for end in (centre + offset, centre - offset):
        speed = ca.jacobian(end, q) @ v
        kinetic += mass / 2 * ca.dot(speed, speed) / 2
        potential += mass / 2 * gravity * end[1]
    return ca.Function("pendulum", [q, v, a], [_force(kinetic, potential, q, v, a)])


def five_links(model: SagittalModel, gravity: float = GRAVITY) -> ca.Function:
    """(theta, rate, accel), 7 each: x, z of the hip, pitch, joints (Sec. II-C) -> M theta'' + H (7,)."""
    theta, rate, accel = (ca.SX.sym(n, 7) for n in ("theta", "rate", "accel"))
    pitch, q = theta[2], theta[3:]
    thigh = pitch + q[0]
    shank = thigh + q[1]
    angles = ca.vertcat(shank + q[2], shank, thigh, pitch, pitch + q[3])
    cos, sin = ca.cos(angles), ca.sin(angles)
    to_hip = model.point_arms(3, np.zeros(2))
    kinetic, potential = 0, 0
    for i, arms in enumerate(model.com_arms() - to_hip):
        x, z = arms.T
        place = theta[:2] + ca.vertcat(ca.dot(x, cos) + ca.dot(z, sin), ca.dot(z, cos) - ca.dot(x, sin))
        speed, spin = ca.jacobian(place, theta) @ rate, ca.jacobian(angles[i], theta) @ rate
        kinetic += model.mass[i] * ca.dot(speed, speed) / 2 + model.inertia[i] * spin**2 / 2
        potential += model.mass[i] * gravity * place[1]
    force = _force(kinetic, potential, theta, rate, accel)
    return ca.Function("five_links", [theta, rate, accel], [force], ["theta", "rate", "accel"], ["force"])


def _force(kinetic: ca.SX, potential: ca.SX, q: ca.SX, v: ca.SX, a: ca.SX) -> ca.SX:
    momentum = ca.gradient(kinetic, v)
    return ca.jacobian(momentum, v) @ a + ca.jacobian(momentum, q) @ v + ca.gradient(potential - kinetic, q)
