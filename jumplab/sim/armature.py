"""Armature and friction of the motors for an engine that has none: from outside, as torques.

A rotor turns with its joint, at the joint's rate s about its axis a. Its torque on the child is -J
a s', on the parent the opposite. Torques that follow measured accelerations are unstable where J is
larger than the link's own inertia. So both links are lent the inertia J, about all axes alike, by
which they feel J w' of their own spin w at once; and in each step they are given back what was too
much of it in the step before: on the child J (w_c' - a s'), on the parent J (w_p' + a s'). That
converges for every J: the inertia with what is lent is at least half of the inertia with armature.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.sim import STEP_S

# share of its rate that friction may take from a joint within a step: it must not turn it back
STOPPING = 0.5


class Armature:
    """The armature of a robot's motors; ``lent`` is how much inertia each link is lent, about every
    axis [kg m^2].
    """

    def __init__(self, robot: Robot):
        model = robot.model
        self._model = model
        self._data = model.createData()
        self._armature = robot.limits.armature
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        links = [frame for frame in model.frames if frame.type == pin.FrameType.BODY]
        first = {frame.parentJoint: frame.name for frame in links[::-1]}  # of each joint's body
        self.lent: dict[str, float] = {}
        self._lent = np.zeros((model.njoints, 1))  # by body
        # which bodies move with each entry of v
        self._carries = np.ones((model.nv, model.njoints))
        for k, armature in enumerate(self._armature):
            here = model.getJointId(robot.joint_names[k])
            self._carries[6 + k] = np.isin(range(model.njoints), list(model.subtrees[here]))
            for body in (here, model.parents[here]) if armature else ():
                self._lent[body] += armature
                self.lent[first[body]] = float(self._lent[body, 0])

    def returned(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Generalised forces (nv,) in the step that begins at ``q`` (nq,) and ``v`` (nv,): moments
        in the base's axes and torques [N m]; to be called once for each step.
        """
        axes = self._axes(q)
        now = self._spins(axes, v), v[6:]
        changes = ((x - y) / STEP_S for x, y in zip(now, self._last or now, strict=True))
        self._last = now
        return self._forces(axes, *changes)

    def _axes(self, q: np.ndarray) -> np.ndarray:
        """Axes (nv, 3) about which each entry of the velocity turns bodies, in the world's."""
        return pin.computeJointJacobians(self._model, self._data, q)[3:].T

    def _spins(self, axes: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Angular velocities (bodies, 3) in the world's axes."""
        return self._carries.T @ (axes * v[:, None])

    def _forces(self, axes: np.ndarray, change: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Generalised forces (nv,) of the links' lent inertia where their spins ``change``
        (bodies, 3), less those of the rotors at the ``rate`` (nv - 6,) of the joints' speeds.
        """
        out = (axes * (self._carries @ (self._lent * change))).sum(axis=1)
        out[6:] -= self._armature * rate
        return out

    def late(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Generalised forces (N - 1, nv) that acted because of the delay, from a log (N, nq), (N,
        nv) of all steps.

        The torque given back in a step, which is that of the one before, less what the lent
        inertia takes in it. That is of the motion for which the engine solved: an impact can turn
        a foot by some hundredths of a radian within its step.
        """
        rows = [self._turning(*row) for row in zip(q, v, strict=True)]
        spins = np.array([self._spins(axes, row) for (axes, _), row in zip(rows, v, strict=True)])
        rates = np.diff(v, axis=0) / STEP_S
        felt = [
            self._spins(axes, gained) + drift
            for (axes, drift), gained in zip(rows, rates, strict=False)
        ]
        given = np.diff(spins[:-1], axis=0, prepend=spins[:1]) / STEP_S
        late = -np.diff(rates[:, 6:], axis=0, prepend=np.zeros_like(rates[:1, 6:]))
        changes = zip(rows, given - felt, late, strict=False)
        return np.array([self._forces(axes, *change) for (axes, _), *change in changes])

    def _turning(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Axes (nv, 3) as :meth:`_axes` has them, and the change (bodies, 3) of the bodies' angular
        velocities because they turn.
        """
        drift = pin.computeJointJacobiansTimeVariation(self._model, self._data, q, v)[3:].T
        return self._data.J[3:].T.copy(), self._spins(drift, v)


class Friction:
    """Torques that dry and viscous friction of a robot's motors take."""

    def __init__(self, robot: Robot, q: np.ndarray):
        model = robot.model
        motors = robot.limits
        self._dry = motors.friction
        # of a joint with all others free: with a contact it is more
        alone = 1 / np.diag(np.linalg.inv(pin.crba(model, model.createData(), q)))[6:]
        self._stop = STOPPING * alone / STEP_S
        self._viscous = motors.damping / (1 + motors.damping / self._stop)

    def torque(self, rates: np.ndarray) -> np.ndarray:
        """Torque (nv - 6,) that is lost at joint rates (nv - 6,) [N m]; dry friction at most stops
        a joint.
        """
        return np.clip(self._stop * rates, -self._dry, self._dry) + self._viscous * rates
