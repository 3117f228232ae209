"""Armature and friction of the motors for an engine that has none: from outside, as torques.

A rotor turns with its joint, by the rate s_c - s_p of the spins of child and parent about the axis a. Its torque on
the child is -J a (s_c' - s_p'), on the parent the opposite. Torques that follow measured accelerations are unstable
where J is larger than the link's own inertia. So both links are lent the inertia J, about all axes alike, by which they
feel J w' of their own at once; and in each step they are given back what was too much of it in the step before: on the
child J (w_c' - a s_c' + a s_p'), on the parent J (w_p' - a s_p' + a s_c'). That converges for every J: the inertia with
what is lent is at least half of the inertia with armature.
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.sim import STEP_S

# share of its rate that friction may take from a joint within a step: it must not turn it back
STOPPING = 0.5


class Armature:
    """The armature of a robot's motors; ``lent`` is how much inertia each link is lent, about every axis [kg m^2]."""

    def __init__(self, robot: Robot):
        self._model, self._data = robot.model, robot.model.createData()
        self._rows, self.lent, self._last = [], {}, None
        for joint in ET.fromstring(robot.urdf).iter("joint"):
            name = joint.get("name")
            armature = robot.actuators[name]["armature"] if name in robot.actuators else 0.0
            if armature:
                links = [joint.find(key).get("link") for key in ("child", "parent")]
                for link in links:
                    self.lent[link] = self.lent.get(link, 0.0) + armature
                self._rows.append((*self._axes(name), *links, armature))

    def _axes(self, name: str) -> tuple[int, int, np.ndarray, np.ndarray]:
        """A joint and that of its parent, and its axis (3,) in the frames of both."""
        model, data = self._model, self._data
        here = model.getJointId(name)
        axis = pin.computeJointJacobian(model, data, pin.neutral(model), here)[3:, model.idx_vs[here]]
        return here, model.parents[here], axis, model.jointPlacements[here].rotation @ axis

    def returned(self, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
        """Torque (3,) for each link, world axes, in the step that begins at (q, v) [N m]; to be called once for each
        step."""
        spins = self._spins(q, v)
        change = np.zeros_like(spins) if self._last is None else (spins - self._last) / STEP_S
        self._last, out = spins, {link: np.zeros(3) for link in self.lent}
        owed = self._owed(change)
        for (here, above, _, _, child, parent, _), (of_child, of_parent) in zip(self._rows, owed, strict=True):
            out[child] += self._data.oMi[here].rotation @ of_child
            out[parent] += self._data.oMi[above].rotation @ of_parent
        return out

    def _spins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Angular velocities (joints, 3) of all bodies in their joints' axes."""
        pin.forwardKinematics(self._model, self._data, q, v)
        return np.array([twist.angular for twist in self._data.v])

    def _owed(self, change: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per joint, torques (3,) of child and parent in their joints' axes, for changes (joints, 3) of their spins."""
        out = []
        for here, above, axis, fixed, _, _, armature in self._rows:
            turn = axis @ change[here] - fixed @ change[above]
            out.append((armature * (change[here] - axis * turn), armature * (change[above] + fixed * turn)))
        return out

    def late(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Generalised forces (N - 1, nv) that acted because of the delay, from a log (N, nq), (N, nv) of all steps.

        What is given back in a step, less what is due in it: over any time that is what is due at its two ends.
        """
        spins = np.array([self._spins(*row) for row in zip(q, v, strict=True)])
        change = np.diff(spins, axis=0) / STEP_S
        late = np.concatenate([np.zeros_like(change[:1]), change[:-1]]) - change
        out = np.zeros((len(change), self._model.nv))
        for k, row in enumerate(late):
            pin.computeJointJacobians(self._model, self._data, q[k])
            seen = {
                joint: pin.getJointJacobian(self._model, self._data, joint, pin.ReferenceFrame.LOCAL)[3:]
                for joint in {at for here, above, *_ in self._rows for at in (here, above)}
            }
            for (here, above, *_), (of_child, of_parent) in zip(self._rows, self._owed(row), strict=True):
                out[k] += seen[here].T @ of_child + seen[above].T @ of_parent
        return out


class Friction:
    """Torques that dry and viscous friction of a robot's motors take."""

    def __init__(self, robot: Robot, q: np.ndarray):
        rows, model = [robot.actuators[name] for name in robot.joint_names], robot.model
        self._dry, viscous = (np.array([row[key] for row in rows]) for key in ("friction", "damping"))
        inertia = np.triu(pin.crba(model, model.createData(), q))
        # of a joint with all others free: with a contact it is more
        alone = 1 / np.diag(np.linalg.inv(inertia + np.triu(inertia, 1).T))[6:]
        self._stop = STOPPING * alone / STEP_S
        self._viscous = viscous / (1 + viscous / self._stop)

    def torque(self, rates: np.ndarray) -> np.ndarray:
        """Torque (nv - 6,) that is lost at joint rates (nv - 6,) [N m]; dry friction at most stops a joint."""
        return np.clip(self._stop * rates, -self._dry, self._dry) + self._viscous * rates
