"""One jump for any robot, by inverse kinematics alone: crouch, stretch, tuck, land. Good enough to begin with."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.stages.spatial.settings import SpatialLimits
from jumplab.stages.spatial.tape import forces
from jumplab.stages.spatial.terms import SpatialTerms
from jumplab.task import JumpTask

# heights of the base against the stance, as shares of the leg's length from hip to ankle; angles [rad]
CROUCH, STRETCH, LANDED, TUCK = -0.20, 0.03, -0.12, 0.15
BOW, PITCH, HEEL_UP = 0.35, 0.12, 0.4
CROUCH_S, TOE_S = 0.35, 0.08
STEP_S = 0.01
IK_STEPS, DAMPING = 8, 1e-4


def generic(b: SpatialTerms, task: JumpTask) -> Tape:
    """A tape at 100 Hz of a jump straight ahead with the task's rise; ``b`` are terms of a phase on the ground."""
    from scipy.interpolate import BPoly  # slow to import

    gravity, chart0, leg = task.gravity, b.stance, _leg(b)
    z, speed = chart0[2] + leg * np.array([0.0, CROUCH, STRETCH, LANDED]), task.takeoff_speed
    push_s = 2 * (z[2] - z[1]) / speed
    drop = max(speed**2 - 2 * gravity * (z[3] + task.platform_m - z[2]), (0.3 * speed) ** 2)
    flight_s = (speed + np.sqrt(drop)) / gravity
    ahead = task.distance_m / flight_s
    launch_s, lean = CROUCH_S + push_s, 0.4 * push_s * ahead
    times = np.array([0.0, CROUCH_S, launch_s])
    ways = [
        BPoly.from_derivatives(times, [[chart0[0], 0, 0], [chart0[0], 0], [chart0[0] + lean, ahead, 0]]),
        BPoly.from_derivatives(times, [[z[0], 0, 0], [z[1], 0], [z[2], speed, -gravity]]),
        BPoly.from_derivatives(times, [[chart0[5], 0, 0], [BOW, 0], [PITCH, 0, 0]]),
    ]
    t = np.linspace(0, launch_s, int(launch_s / STEP_S) + 2)
    air = np.linspace(0, flight_s, int(flight_s / STEP_S) + 2)
    s = air / flight_s
    base = np.stack([w(t) for w in ways], -1)
    fly = [chart0[0] + lean + ahead * air, z[2] + speed * air - gravity * air**2 / 2, PITCH + task.rotation_rad * s]
    base = np.concatenate([base, np.stack(fly, -1)])
    heel = np.concatenate([HEEL_UP * np.clip((t - launch_s + TOE_S) / TOE_S, 0, 1) ** 2, HEEL_UP * (1 - s) ** 2])
    smooth, lift = s**3 * (10 - 15 * s + 6 * s**2), 4 * s * (1 - s)
    foot = np.zeros((len(base), 2))
    foot[len(t) :, 0] = task.distance_m * smooth
    foot[len(t) :, 1] = task.platform_m * smooth + lift * (leg * TUCK + fly[1] - np.interp(s, [0, 1], z[2:]))
    legs = _Legs(b)
    q = np.array([legs.reach(*row) for row in zip(base, foot, heel, strict=True)])
    parts = [_derived(x, q[k]) for x, k in ((t, slice(None, len(t))), (air, slice(len(t), None)))]
    motion = [np.concatenate(x) for x in zip(*(b.model.to_pinocchio(*part) for part in parts), strict=True)]
    f, tau, *_ = forces(b.robot.under_gravity(gravity), *motion, np.zeros((len(q), 2, 6)), len(t))
    phase = np.repeat(["launch", "flight"], [len(t), len(air)])
    names, extra = (np.array(b.robot.foot.frames), np.array(b.joint_names)), {"toe_phase_start": launch_s - TOE_S}
    return Tape(np.concatenate([t, launch_s + air]), *motion, tau, phase, names[0], f, names[1], extra)


def _leg(b: SpatialTerms) -> float:
    """Length of the leg from hip to ankle as the robot stands [m]."""
    model, data = b.model.model, b.model.model.createData()
    pin.forwardKinematics(model, data, b.model.to_pinocchio(b.stance[None], *np.zeros((2, 1, model.nv)))[0][0])
    hip, ankle = (data.oMi[model.getJointId(b.robot.joints[k][0])].translation for k in ("hip_pitch", "ankle_pitch"))
    return float(np.linalg.norm(hip - ankle))


def _derived(t: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    v = np.gradient(q, t, axis=0, edge_order=2)
    return q, v, np.gradient(v, t, axis=0, edge_order=2)


class _Legs:
    """Charts in which the legs bring both soles to where they are asked for, as near as they reach."""

    def __init__(self, b: SpatialTerms):
        self.b, self.model, self.data = b, b.model.model, b.model.model.createData()
        self.frames = [self.model.getFrameId(name) for name in b.robot.foot.frames]
        self.columns = [np.array([5 + j for j in b.chain(k)]) for k in b.feet]
        self.low, self.high = (x[7:] + s * SpatialLimits().range_margin_rad for x, s in self._ranges())
        for k, sign, angle in b.knees:  # never bent the other way
            end = sign * (0.1 - angle)
            self.low[k], self.high[k] = (
                (max(self.low[k], end), self.high[k]) if sign > 0 else (self.low[k], min(self.high[k], end))
            )
        self.joints = b.stance[6:].copy()

    def _ranges(self):
        return (self.model.lowerPositionLimit, 1.0), (self.model.upperPositionLimit, -1.0)

    def reach(self, base: np.ndarray, foot: np.ndarray, heel: float) -> np.ndarray:
        """The chart for x, z and pitch of the base, the soles' shift (x, z) from their first places, heels up."""
        b = self.b
        chart = np.concatenate([[base[0], b.stance[1], base[1], 0.0, 0.0, base[2]], self.joints])
        turn, sole = pin.rpy.rpyToMatrix(0.0, heel, 0.0), b.robot.foot
        to_ankle = np.array([sole.toe, 0.0, sole.sole_z])
        half = np.array([(sole.toe - sole.heel) / 2, 0.0, 0.0])
        for _ in range(IK_STEPS):
            q = b.model.to_pinocchio(chart[None], *np.zeros((2, 1, len(chart))))[0][0]
            pin.computeJointJacobians(self.model, self.data, q)
            pin.updateFramePlacements(self.model, self.data)
            for frame, columns, place in zip(self.frames, self.columns, b.places, strict=True):
                at = self.data.oMf[frame]
                goal = place + half + [foot[0], 0.0, foot[1]] - turn @ to_ankle
                off = np.concatenate([goal - at.translation, pin.log3(turn @ at.rotation.T)])
                slope = pin.getFrameJacobian(self.model, self.data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
                slope = slope[:, columns]
                step = slope.T @ np.linalg.solve(slope @ slope.T + DAMPING * np.eye(6), off)
                chart[columns] += np.clip(step, -0.3, 0.3)
            chart[6:] = np.clip(chart[6:], self.low, self.high)
        self.joints = chart[6:].copy()
        return chart
