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
LOCAL = pin.ReferenceFrame.LOCAL


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
        self._motors = []
        self._joints = {}  # of links
        self.lent = {}
        links = [frame for frame in model.frames if frame.type == pin.FrameType.BODY]
        first = {frame.parentJoint: frame.name for frame in links[::-1]}  # of each joint's body
        for name, armature in zip(robot.joint_names, self._armature, strict=True):
            if armature:
                here = model.getJointId(name)
                column = model.idx_vs[here]
                slope = pin.computeJointJacobian(model, self._data, pin.neutral(model), here)
                bodies = {first[body]: body for body in (here, model.parents[here])}
                self._joints |= bodies
                for link in bodies:
                    self.lent[link] = self.lent.get(link, 0.0) + armature
                self._motors.append((*bodies, armature * slope[3:, column], column))
        # views of Pinocchio's own numbers, which are new after each of its passes
        self._turns = {link: self._data.oMi[joint].rotation for link, joint in self._joints.items()}
        self._twists = [twist.angular for twist in self._data.v]

    def returned(self, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
        """Torque (3,) for each link, world axes, in the step that begins at ``q`` (nq,) and ``v``
        (nv,) [N m]; to be called once for each step."""
        now = self._spins(q, v), v
        change, rate = ((x - y) / STEP_S for x, y in zip(now, self._last or now, strict=True))
        self._last = now
        turns = self._turns
        out = {
            link: turns[link] @ (self.lent[link] * change[k]) for link, k in self._joints.items()
        }
        for child, parent, along, column in self._motors:
            torque = turns[child] @ along * rate[column]
            out[child] -= torque
            out[parent] += torque
        return out

    def _spins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Angular velocities (joints, 3) of all bodies in their joints' axes."""
        pin.forwardKinematics(self._model, self._data, q, v)
        return np.array(self._twists)

    def late(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Generalised forces (N - 1, nv) that acted because of the delay, from a log (N, nq), (N,
        nv) of all steps.

        The torque given back in a step, less the one due in it: summed over any time, this is the
        difference of those due at its two ends.
        """
        spins = np.array([self._spins(*row) for row in zip(q, v, strict=True)])
        changes = (np.diff(x, axis=0) / STEP_S for x in (spins, v[:, 6:]))
        late, rate = (-np.diff(x, axis=0, prepend=np.zeros_like(x[:1])) for x in changes)
        out = np.zeros((len(late), self._model.nv))
        out[:, 6:] = -self._armature * rate
        for k, row in enumerate(late):
            pin.computeJointJacobians(self._model, self._data, q[k])
            for link, joint in self._joints.items():
                slope = pin.getJointJacobian(self._model, self._data, joint, LOCAL)[3:]
                out[k] += self.lent[link] * slope.T @ row[joint]
        return out


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
