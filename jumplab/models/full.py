"""Stage 2's model: nine links, 20 degrees of freedom, from Pinocchio (Sec. II-B and IV of the
paper).

The configuration is Pinocchio's free-flyer one; rates and accelerations are its tangent (base twist
in the base frame, then joints), theta^js of the paper. Wrenches act at the two tiptoes, the middles
of the soles' front edges, in world axes: F_ext^js = [f_left, n_left, f_right, n_right] (12,).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot import Robot
from jumplab.robot.contact import Anchor, PointMotion, moving, on_feet, point_motion, posed, shifted
from jumplab.robot.reduction import EXACT_M, mirror

PARALLEL_TOLERANCE = 1e-6  # how far the y axis of a foot may be off the base's
SIDES = ("left", "right")
STEP_S = 1e-5  # of the difference of the inertia's slope along the motion
PITCH = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class FullTerms:
    """Every quantity of the nine-link robot that the QPs need, at one (q, v); feet are ordered
    left, right, vectors are in world axes.

    A "drift" is the acceleration of theta'' = 0, so ``x'' = J_x theta'' + drift``.
    """

    q: np.ndarray  # (nq,) configuration
    v: np.ndarray  # (nv,) rates
    mass: float  # [kg]
    base_rotation: np.ndarray  # (3, 3) of the base link
    com: np.ndarray  # c (3,) [m]
    M: np.ndarray  # inertia matrix M^js (nv, nv)
    H: np.ndarray  # bias force H^js (nv,), gravity and the motors' friction included
    A_h: np.ndarray  # centroidal momentum matrix (6, nv), linear rows first
    B_h: np.ndarray  # its drift (6,)
    rho: float  # pitch inertia about the CoM, rho_total [kg m^2]
    J_rho: np.ndarray  # its Jacobian (nv,)
    drift_rho: float  # [kg m^2/s^2]
    tip: PointMotion  # of the middles of the soles' front edges, each entry (2, ...)
    heel: PointMotion  # of the middles of their rear edges
    sole: PointMotion  # of the soles themselves

    @property
    def momentum(self) -> np.ndarray:
        """(6,) linear [kg m/s], then centroidal angular [kg m^2/s]; ``momentum[4]`` is L."""
        return self.A_h @ self.v

    @property
    def com_velocity(self) -> np.ndarray:
        """(3,) [m/s]."""
        return self.A_c @ self.v

    @property
    def A_c(self) -> np.ndarray:
        """Jacobian (3, nv) of the CoM."""
        return self.A_h[:3] / self.mass

    @property
    def B_c(self) -> np.ndarray:
        """Its drift (3,)."""
        return self.B_h[:3] / self.mass

    @property
    def rho_rate(self) -> float:
        """[kg m^2/s]."""
        return float(self.J_rho @ self.v)

    @property
    def foot_pitch(self) -> np.ndarray:
        """Pitch of the feet (2,) [rad]; positive is heel up."""
        return np.arctan2(-self.tip.turn[:, 2, 0], self.tip.turn[:, 0, 0])

    @property
    def foot_com(self) -> np.ndarray:
        """p_rd (2, 3): sole minus CoM [m]."""
        return self.sole.place - self.com

    @property
    def J_rd(self) -> np.ndarray:
        """Jacobian (2, 3, nv) of p_rd."""
        return self.sole.jacobian[:, :3] - self.A_c

    @property
    def drift_rd(self) -> np.ndarray:
        """Its drift (2, 3)."""
        return self.sole.drift[:, :3] - self.B_c

    def vertical(self, name: str) -> np.ndarray:
        """Along z, "place", "velocity", "jacobian" or "drift" (4, ...) of left toe, left heel,
        right toe, right heel.
        """
        both = np.stack([getattr(x, name)[:, 2] for x in (self.tip, self.heel)], 1)
        return both.reshape(4, *both.shape[2:])

    @property
    def J(self) -> np.ndarray:
        """J^js (12, nv): both tiptoes, so that the ground acts on the robot as J^T F."""
        return self.tip.jacobian.reshape(12, -1)

    @property
    def A_f(self) -> np.ndarray:
        """A_f (6, 12): A_f F is the rate of linear momentum without gravity, then of centroidal
        angular momentum.
        """
        out = np.tile(np.eye(6), 2)
        for side, arm in enumerate(self.tip.place - self.com):
            out[3:, 6 * side : 6 * side + 3] = pin.skew(arm)
        return out


def force_target(
    mass: float, gravity: float, com_acceleration: np.ndarray, momentum_rate: np.ndarray
) -> np.ndarray:
    """B_f (6,): what A_f F must be for a CoM acceleration (3,) and a rate of centroidal angular
    momentum (3,).
    """
    lift = np.array([0.0, 0.0, gravity])
    return np.concatenate([mass * (np.asarray(com_acceleration) + lift), momentum_rate])


class FullBody:
    """The nine-link robot as a source of :class:`FullTerms`. One per user: it owns Pinocchio's
    scratch data.

    ``gravity`` is the robot's, positive [m/s^2]; ``mass`` is in kg; ``motors``
    are the joints'. ``anchors`` are all points by name. ``pairs`` are (left column, right column,
    sign) in the tangent of the joint pairs whose symmetry is demanded, by phase.
    """

    def __init__(self, robot: Robot):
        self.robot = robot
        self.model = robot.model
        self.data = posed(self.model)
        self.nq = self.model.nq
        self.nv = self.model.nv
        self.mass = robot.total_mass
        self.motors = robot.limits
        self.gravity = robot.gravity
        self._check_feet()
        self.anchors = self._all_anchors()
        self.pairs = self._mirrored_pairs()

    def _check_feet(self) -> None:
        for name in self.robot.foot.frames:
            turn = self.data.oMf[self.model.getFrameId(name, pin.FrameType.BODY)].rotation
            most = np.abs(turn[:, 1] - np.eye(3)[1]).max()
            if most > PARALLEL_TOLERANCE:
                raise RobotError(
                    f"robot {self.robot.name}: the axes of {name!r} are not parallel to the base's "
                    f"in the neutral pose, but for pitch (off by {most:.2g}); turn the link frame "
                    f"of the foot"
                )

    def _all_anchors(self) -> dict[str, Anchor]:
        """Frames of the URDF, and toe, heel, sole and hand of either side; the pose is neutral."""
        robot = self.robot
        foot = robot.foot
        anchors = {f.name: Anchor(f.parentJoint, f.placement) for f in self.model.frames[1:]}
        points = {"toe": foot.tip, "heel": [foot.heel, 0.0, foot.sole_z], "sole": foot.center}
        for place, local in points.items():
            names = (f"{side}_{place}" for side in SIDES)
            anchors |= zip(names, on_feet(robot, local), strict=True)
        for side, joint in zip(SIDES, robot.joints["shoulder_pitch"], strict=False):
            shoulder = self.model.getJointId(joint)
            x, z = robot.sagittal.points["hand"][1]
            way = self.data.oMi[shoulder].rotation.T @ [x, 0.0, z]
            anchors.setdefault(f"{side}_hand", Anchor(shoulder, shifted(way)))
        return anchors

    def _mirrored_pairs(self) -> dict[str, list[tuple[int, int, float]]]:
        model = self.model
        pairs = [(6 + i, 6 + k, sign) for i, k, sign in mirror(model, EXACT_M) if i < k]
        knees = (model.getJointId(name) for name in self.robot.joints["knee"])
        shanks = {6 + joint - 2 for knee in knees for joint in model.subtrees[knee]}
        # flat feet leave mirrored hips' knees and ankles no choice
        return {"launch": [x for x in pairs if x[0] not in shanks], "flight": pairs}

    def symmetry_rows(self, phase: str) -> np.ndarray:
        """Rows (k, nv) with row @ theta'' = 0 for mirrored motion: right - sign * left, one row per
        joint pair of a phase.

        The paper's "sum of both hip joints = 0" holds for the joints with sign -1 (yaw and roll
        with axes that are not mirrored); for pitch the sign is +1 and the row is a difference.
        """
        unit = np.eye(self.nv)
        rows = [unit[right] - sign * unit[left] for left, right, sign in self.pairs[phase]]
        return np.reshape(rows, (-1, self.nv))

    def terms(self, q: np.ndarray, v: np.ndarray) -> FullTerms:
        """All quantities at configuration ``q`` (nq,) and rates ``v`` (nv,)."""
        model = self.model
        data = self.data
        around = [pin.integrate(model, q, x * v) for x in (-STEP_S, STEP_S)]
        before, after = (pitch_inertia(model, data, x)[1] for x in around)
        rho, slope = pitch_inertia(model, data, q)
        H = pin.nonLinearEffects(model, data, q, v).copy()
        H[6:] += self.motors.lost(v[6:])
        M = pin.crba(model, data, q).copy()
        pin.dccrba(model, data, q, v)
        A_h = data.Ag.copy()
        B_h = data.dAg @ v
        com = data.com[0].copy()
        moving(model, data, q, v)
        points = [self._both(place) for place in ("toe", "heel", "sole")]
        drift = float((after - before) @ v) / (2 * STEP_S)
        turn = data.oMi[1].rotation.copy()
        return FullTerms(q, v, self.mass, turn, com, M, H, A_h, B_h, rho, slope, drift, *points)

    def _both(self, place: str) -> PointMotion:
        """Motion of a point of both feet, stacked."""
        anchors = (self.anchors[f"{side}_{place}"] for side in SIDES)
        motions = (vars(point_motion(self.model, self.data, x)).values() for x in anchors)
        return PointMotion(*map(np.stack, zip(*motions, strict=True)))


def pitch_inertia(model: pin.Model, data: pin.Data, q: np.ndarray) -> tuple[float, np.ndarray]:
    """rho about the CoM [kg m^2], and its slope (nv,) along the tangent, at configuration ``q``
    (nq,).

    rho is L_y of a robot that turns about y as one, at a rate of one: its slope along the joints is
    that of L_y in Pinocchio's words, along the base's turns d it is 2 d . (I e_y x e_y).
    """
    turn = pin.XYZQUATToSE3(q[:7]).rotation
    spinning = np.zeros(model.nv)
    spinning[3:6] = turn.T @ PITCH
    still = np.zeros(model.nv)
    slope = pin.computeCentroidalDynamicsDerivatives(model, data, q, spinning, still)[0][4].copy()
    momentum = data.hg.angular
    slope[:3] = 0.0
    slope[3:6] = 2 * turn.T @ [-momentum[2], 0.0, momentum[0]]  # L x e_y
    return float(momentum[1]), slope
