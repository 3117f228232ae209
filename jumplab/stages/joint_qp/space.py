"""Both QPs out of the plane: the same rows without the mirror, all three momenta, two inertias, feet that turn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.models.full import FullMotion, FullTerms
from jumplab.stages.joint_qp.flight import FlightQp
from jumplab.stages.joint_qp.launch import WRENCH, LaunchQp, LaunchTarget
from jumplab.stages.joint_qp.own import SIDES
from jumplab.stages.joint_qp.problem import State, StepQp
from jumplab.stages.joint_qp.reference import Track
from jumplab.stages.srmp.planner import leg_between

YAW_SHARE = 0.1  # [1] square root of the weight of the inertia about the vertical over that of the other
HEELS = 0.1  # [cost] / [rad/s^2]^2, weight of heels that rise alike: else one rises alone, and its leg is spent
INERTIAS = ("rho", "rho about the vertical")


def headed(q: np.ndarray, yaw: float) -> np.ndarray:
    """Configuration (nq,) with its base's attitude turned about the vertical."""
    x, y, z, w = q[3:7]
    s, c = np.sin(yaw / 2), np.cos(yaw / 2)
    out = q.copy()
    out[3:7] = [c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z]
    return out


class SpatialLaunchQp(LaunchQp):
    """The launch: arms and legs of both sides are free to move in opposition."""

    pairs, inertias, more = (), INERTIAS, (("heels", ("left and right",)),)

    def __init__(self, *given: Any):
        super().__init__(*given)
        com, force = self.roots[0]
        com[1], force[1] = com[0], force[0]  # on flat feet sideways as strongly as ahead

    def matrices(self, terms: FullTerms, target: LaunchTarget, start: State) -> StepQp:
        """The QP of one step: heels alike, and the inertia about the vertical followed less closely, arms are for L."""
        qp, at, gain = super().matrices(terms, target, start), self.layout.at("heels"), self.options.gains.contact
        root, apart = np.sqrt(HEELS), np.array([1.0, -1.0])
        asked = -gain.stiffness * terms.foot_pitch - gain.damping * terms.foot_spin[:, 1] - terms.drift_toe[:, 4]
        if target.on_toes:
            qp.A[at, WRENCH:], qp.b[at] = root * (apart @ terms.J_toe[:, 4]), root * (apart @ asked)
        row = self.layout.at("inertia").start + 1
        qp.A[row] *= YAW_SHARE
        qp.b[row] *= YAW_SHARE
        return qp

    def _turning(self, k: int, terms: FullMotion) -> np.ndarray:
        """Rate of the angular momentum to ask for (3,) [N m]."""
        return self.reference.momentum.command(k, 0.0, terms.momentum[3:], self.options.gains.momentum)

    def _nominal(self, k: int) -> np.ndarray:
        """Posture (nq,) to lean towards, turned as stage 1's body."""
        return headed(self.nominal, self.reference.yaw[k])


class SpatialFlightQp(FlightQp):
    """The flight: soles and trunk turn about the vertical, from the first heading to the asked one."""

    pairs, inertias, foot_axes = (), INERTIAS, slice(3, 6)

    def _axes_of_feet(self) -> list[str]:
        return [f"{side} {axis}" for side in SIDES for axis in ("rx", "ry", "rz")]

    def _feet(self, start: FullMotion) -> Track:
        """Soles relative to the CoM (n, 2, 3): the middle as stage 1 has it, both about it by the feet's heading."""
        foot = self.reference.foot
        self.heading = heading, rate, _ = leg_between(0.0, self.reference.yaw[-1], self.t)  # from rest to rest
        apart = start.foot_com - start.foot_com.mean(axis=0)
        turn = np.array([pin.rpy.rpyToMatrix(0.0, 0.0, x) for x in heading])
        apart = np.einsum("nij,kj->nki", turn, apart)
        speed = np.cross([0.0, 0.0, 1.0], apart) * rate[:, None, None]
        return Track.of(self.t, foot.value[:, None] + apart, foot.rate[:, None] + speed)

    def _turning(self, k: int, terms: FullMotion) -> tuple[np.ndarray, ...]:
        """Of a target: ``foot_pitch`` (6,), ``floor``, ``joints`` and ``trunk``."""
        gain, (heading, rate, accel) = self.options.gains, (x[k] for x in self.heading)
        goal, up, feet = pin.rpy.rpyToMatrix(0.0, 0.0, heading), np.array([0.0, 0.0, 1.0]), []
        for turn, spin in zip(terms.foot_rotation, terms.foot_spin, strict=True):
            push = gain.foot_level.stiffness * pin.log3(goal @ turn.T) + gain.foot_level.damping * (rate * up - spin)
            feet.append(push + accel * up)
        yaw = self.reference.yaw
        joints, trunk = self._towards(terms, headed(self.nominal, yaw[k]))
        trunk += gain.trunk.damping * (yaw[k + 1] - yaw[k]) / self.step * terms.base_rotation[2]
        return np.concatenate(feet), self._floor(k, terms), joints, trunk
