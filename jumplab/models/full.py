"""Stage 2's model: nine links, 20 degrees of freedom, from Pinocchio (Sec. II-B and IV of the paper).

The configuration is Pinocchio's free-flyer one; rates and accelerations are its tangent (base twist in the base frame,
then joints), theta^js of the paper. Wrenches act at the two tiptoes, the middles of the soles' front edges, in world
axes: F_ext^js = [f_left, n_left, f_right, n_right] (12,).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot import Robot

PARALLEL_TOLERANCE = 1e-6  # how far an axis may be off before a robot counts as crooked
CROSS = np.zeros((3, 9))  # x @ CROSS is the matrix of "x cross", row by row
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    CROSS[_k, 3 * _j + _i], CROSS[_k, 3 * _i + _j] = 1.0, -1.0
# D (4 x 4, row by row) times this is half the slope of D_xx + D_zz along a twist (linear, angular) about the origin
SLOPE = np.zeros((16, 6))
SLOPE[3, 0] = SLOPE[11, 2] = SLOPE[9, 3] = 1.0
SLOPE[1, 5] = -1.0


def skew(x: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) with skew(x) @ y = x cross y, for vectors (..., 3)."""
    return (x @ CROSS).reshape(*x.shape, 3)


@dataclass(frozen=True)
class FullMotion:
    """What feedback needs to know of the robot at one (q, v); feet are ordered left, right, vectors in world axes."""

    q: np.ndarray  # (nq,) configuration
    v: np.ndarray  # (nv,) rates
    base_rotation: np.ndarray  # (3, 3) of the base link
    com: np.ndarray  # c (3,) [m]
    com_velocity: np.ndarray  # (3,) [m/s]
    momentum: np.ndarray  # (6,) linear [kg m/s], then centroidal angular [kg m^2/s]; ``momentum[4]`` is L
    rho: float  # pitch inertia about the CoM, rho_total [kg m^2]
    rho_rate: float  # [kg m^2/s]
    toe: np.ndarray  # (2, 3) middles of the soles' front edges [m]
    heel: np.ndarray  # (2, 3) of their rear edges [m]
    sole: np.ndarray  # (2, 3) of the soles themselves [m]
    toe_velocity: np.ndarray  # (2, 3) [m/s], as the next two
    heel_velocity: np.ndarray
    sole_velocity: np.ndarray
    foot_rotation: np.ndarray  # (2, 3, 3)
    foot_spin: np.ndarray  # (2, 3) angular velocity of the feet [rad/s]

    @property
    def foot_com(self) -> np.ndarray:
        """p_rd (2, 3): sole minus CoM [m]."""
        return self.sole - self.com

    @property
    def foot_com_rate(self) -> np.ndarray:
        """Rate of p_rd (2, 3) [m/s]."""
        return self.sole_velocity - self.com_velocity

    @property
    def foot_pitch(self) -> np.ndarray:
        """Pitch of the feet (2,) [rad]; positive is heel up."""
        return np.arctan2(-self.foot_rotation[:, 2, 0], self.foot_rotation[:, 0, 0])


@dataclass(frozen=True)
class FullTerms(FullMotion):
    """Every quantity of the nine-link robot that the QPs need, at one (q, v).

    A "drift" is the acceleration of theta'' = 0, so ``x'' = J_x theta'' + drift``.
    """

    M: np.ndarray  # inertia matrix M^js (nv, nv)
    H: np.ndarray  # bias force H^js (nv,), gravity and the motors' friction included
    A_c: np.ndarray  # Jacobian (3, nv) of the CoM
    B_c: np.ndarray  # its drift (3,)
    A_h: np.ndarray  # centroidal momentum matrix (6, nv)
    B_h: np.ndarray  # its drift (6,)
    J_rho: np.ndarray  # Jacobian (nv,) of rho
    drift_rho: float  # [kg m^2/s^2]
    J_toe: np.ndarray  # Jacobian (2, 6, nv) of the tiptoes, linear then angular; J^js of the paper
    drift_toe: np.ndarray  # (2, 6)
    J_heel: np.ndarray  # linear Jacobian (2, 3, nv) of the heels
    drift_heel: np.ndarray  # (2, 3)
    J_rd: np.ndarray  # Jacobian (2, 3, nv) of p_rd
    drift_rd: np.ndarray  # (2, 3)

    @property
    def J(self) -> np.ndarray:
        """J^js (12, nv): both tiptoes, so that the ground acts on the robot as J^T F."""
        return self.J_toe.reshape(12, -1)

    @property
    def A_f(self) -> np.ndarray:
        """A_f (6, 12): A_f F is the rate of linear momentum without gravity, then of centroidal angular momentum."""
        left, right = skew(self.toe - self.com)
        out = np.concatenate([np.eye(6), np.eye(6)], 1)
        out[3:, :3], out[3:, 6:9] = left, right
        return out


def force_target(mass: float, gravity: float, com_acceleration: np.ndarray, momentum_rate: np.ndarray) -> np.ndarray:
    """B_f (6,): what A_f F must be for a CoM acceleration (3,) and a rate of centroidal angular momentum (3,)."""
    lift = np.array([0.0, 0.0, gravity])
    return np.concatenate([mass * (np.asarray(com_acceleration) + lift), momentum_rate])


class FullBody:
    """The nine-link robot as a source of :class:`FullTerms`. One per user: it owns Pinocchio's scratch data.

    ``gravity`` is positive, the robot's own 9.8 by default [m/s^2]; ``mass`` is in kg; ``pairs`` are (left column,
    right column, sign) of every joint pair in the tangent, see :meth:`symmetry_rows`; ``foot_joints`` carry the feet,
    ``foot_points`` are tiptoe, heel and sole in their frames (2, 3, 3) [m].
    """

    def __init__(self, robot: Robot, gravity: float | None = None):
        self.robot, self.model = robot, robot.model
        if gravity is not None:
            self.model = robot.model.copy()
            self.model.gravity.linear = np.array([0.0, 0.0, -gravity])
        self.data = self.model.createData()
        self.nq, self.nv = self.model.nq, self.model.nv
        self.mass = robot.total_mass
        self.gravity = -float(self.model.gravity.linear[2])
        self._read_tree()
        self._read_feet()
        self.pairs, self.groups = self._pair_joints()

    def _read_tree(self):
        model, n = self.model, self.model.njoints - 1
        self._column_joint = np.concatenate([[j - 1] * model.joints[j].nv for j in range(1, n + 1)])  # (nv,)
        self._above = np.zeros((n, n))  # [i, j] = 1 if joint j carries body i
        self._pseudo = np.zeros((n, 4, 4))  # integral of [x; 1][x; 1]^T dm over each body, joint frame
        for i in range(n):
            self._above[i, [j - 1 for j in model.supports[i + 1] if j > 0]] = 1.0
            body = model.inertias[i + 1]
            about_com = np.trace(body.inertia) / 2 * np.eye(3) - body.inertia
            lever = np.append(body.lever, 1.0)
            self._pseudo[i] = body.mass * np.outer(lever, lever)
            self._pseudo[i, :3, :3] += about_com
        self._carries = self._above[:, self._column_joint]  # (n, nv): column moves body
        self._place = np.tile(np.eye(4), (n, 1, 1))
        # views of what Pinocchio computes: they follow its scratch data
        self._rotations = [self.data.oMi[j].rotation for j in range(1, n + 1)]
        self._translations = [self.data.oMi[j].translation for j in range(1, n + 1)]

    def _read_feet(self):
        model, foot, data = self.model, self.robot.foot, self.data
        frames = [model.frames[model.getFrameId(name)] for name in foot.frames]
        self.foot_joints = [f.parentJoint for f in frames]
        middles = [foot.toe, 0.0, foot.sole_z], [foot.heel, 0.0, foot.sole_z], foot.center  # tiptoe, heel, sole
        self.foot_points = np.array([[f.placement.act(np.array(x, float)) for x in middles] for f in frames])
        self._foot_turn = np.array([f.placement.rotation for f in frames])
        self._foot_bodies = [j - 1 for j in self.foot_joints]
        self._foot_carries = self._carries[self._foot_bodies]  # (2, nv)
        pin.framesForwardKinematics(model, data, pin.neutral(model))
        for name in foot.frames:
            turn = data.oMf[model.getFrameId(name)].rotation
            if np.abs(turn - np.eye(3)).max() > PARALLEL_TOLERANCE:
                raise RobotError(
                    f"robot {self.robot.name}: the axes of {name!r} are not parallel to the base's in the neutral pose "
                    f"(off by {np.abs(turn - np.eye(3)).max():.2g}); turn the link frame of the foot"
                )

    def _chain(self, joint: int) -> list[int]:
        return [j for j in self.model.supports[joint] if j > 1]

    def _pair_joints(self) -> tuple[list[tuple[int, int, float]], dict[str, list[int]]]:
        """Pairs of joints, left and right, with the sign of a mirrored motion, and the pairs of each role."""
        model, data, roles = self.model, self.data, self.robot.joints
        pin.computeJointJacobians(model, data, pin.neutral(model))
        shoulders = [self._chain(model.getJointId(n)) for n in roles["shoulder_pitch"]] or [[], []]  # or arms held
        legs = [self._chain(j) for j in self.foot_joints]
        hip = self._chain(model.getJointId(roles["hip_pitch"][0]))
        pairs, groups = [], {"hip": [], "knee": [], "ankle": [], "shoulder": []}
        for chains, arm in ((legs, False), (shoulders, True)):
            if len(chains[0]) != len(chains[1]):
                raise RobotError(f"robot {self.robot.name}: left and right limbs have different numbers of joints")
            for left, right in zip(*chains, strict=True):
                knee = model.names[left] == roles["knee"][0]
                group = "shoulder" if arm else "hip" if left in hip else "knee" if knee else "ankle"
                groups[group].append(len(pairs))
                pairs.append((model.idx_vs[left], model.idx_vs[right], self._mirror_sign(left, right)))
        return pairs, groups

    def _mirror_sign(self, left: int, right: int) -> float:
        """+1 if equal angles mirror each other, -1 if opposite ones do: found by motion in the neutral pose."""
        model, frame = self.model, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        axes = [pin.getJointJacobian(model, self.data, j, frame)[3:, model.idx_vs[j]] for j in (left, right)]
        mirrored = axes[0] * [-1.0, 1.0, -1.0]  # a rotation's mirror image in the x-z plane
        sign = float(np.sign(mirrored @ axes[1]))
        if np.abs(axes[1] - sign * mirrored).max() > PARALLEL_TOLERANCE:
            raise RobotError(
                f"robot {self.robot.name}: {model.names[left]!r} and {model.names[right]!r} are not mirror images of "
                f"each other; their axes in the neutral pose are {axes[0].round(3)} and {axes[1].round(3)}"
            )
        return sign

    def pair_names(self, groups: Sequence[str]) -> list[str]:
        """Left joints of the pairs of some groups, in the order of :meth:`symmetry_rows`."""
        return [self.robot.joint_names[self.pairs[i][0] - 6] for g in groups for i in self.groups[g]]

    def symmetry_rows(self, groups: Sequence[str] = ("hip", "knee", "ankle", "shoulder")) -> np.ndarray:
        """Rows (k, nv) with row @ theta'' = 0 for mirrored motion: right - sign * left, one row per joint pair.

        The paper's "sum of both hip joints = 0" holds for the joints with sign -1 (yaw and roll with axes that are not
        mirrored); for pitch the sign is +1 and the row is a difference.
        """
        rows = np.zeros((len(self.pairs), self.nv))
        for row, (left, right, sign) in zip(rows, self.pairs, strict=True):
            row[right], row[left] = 1.0, -sign
        return rows[[i for g in groups for i in self.groups[g]]]

    def terms(self, q: np.ndarray, v: np.ndarray) -> FullTerms:
        """All quantities at configuration ``q`` (nq,) and rates ``v`` (nv,)."""
        model, data, mass = self.model, self.data, self.mass
        pin.dccrba(model, data, q, v)
        J, dJ = data.J.copy(), data.dJ.copy()  # (6, nv) about the world origin
        A_h, B_h, com = data.Ag.copy(), data.dAg @ v, data.com[0].copy()
        A_c, B_c, momentum = A_h[:3] / mass, B_h[:3] / mass, A_h @ v
        velocity, place = momentum[:3] / mass, self._placements()
        H = pin.nonLinearEffects(model, data, q, v).copy()
        if self.robot.lossy:
            H[6:] += self.robot.lost_torque(v[6:])
        M = np.triu(pin.crba(model, data, q))  # Pinocchio leaves the lower triangle to chance
        M += np.triu(M, 1).T
        # linear and angular velocity, and both at theta'' = 0 differentiated, about the world origin, of each body
        twist = (self._carries @ np.concatenate([J * v, dJ * v]).T).reshape(-1, 4, 3)
        D, rho, slope = self._moments(place, com)
        J_rho = 2 * ((J * slope).sum(0) - mass * (com[::2] @ A_c[::2]))  # (nv,)
        centre = mass * (velocity[::2] @ velocity[::2] + com[::2] @ B_c[::2])
        drift_rho = 2 * (_half_second(D, twist) - centre)
        turn, points = self._soles(place)
        spin, drift, alpha = twist[self._foot_bodies, 1:].transpose(1, 0, 2)  # (2, 3) each
        own = J * self._foot_carries[:, None]  # (2, 6, nv)
        linear = own[:, None, :3] - skew(points) @ own[:, None, 3:]  # (2, 3 points, 3, nv)
        speed = linear @ v  # (2, 3 points, 3)
        turning, spinning = skew(alpha).transpose(0, 2, 1), skew(spin).transpose(0, 2, 1)  # (2, 3, 3)
        bias = drift[:, None] + points @ turning + speed @ spinning  # (2, 3 points, 3)
        J_toe, drift_toe = np.concatenate([linear[:, 0], own[:, 3:]], 1), np.concatenate([bias[:, 0], alpha], 1)
        J_rd, drift_rd = linear[:, 2] - A_c, bias[:, 2] - B_c
        motion = (q, v, place[0, :3, :3].copy(), com, velocity, momentum, rho, float(J_rho @ v))
        feet = (*points.transpose(1, 0, 2), *speed.transpose(1, 0, 2), turn, spin)
        slopes = (J_rho, drift_rho, J_toe, drift_toe, linear[:, 1], bias[:, 1], J_rd, drift_rd)
        return FullTerms(*motion, *feet, M, H, A_c, B_c, A_h, B_h, *slopes)

    def motion(self, q: np.ndarray, v: np.ndarray) -> FullMotion:
        """What feedback needs at configuration ``q`` (nq,) and rates ``v`` (nv,), at less than half the cost."""
        data, mass = self.data, self.mass
        pin.ccrba(self.model, data, q, v)
        moving, momentum, com = data.J * v, data.Ag @ v, data.com[0].copy()
        velocity, place = momentum[:3] / mass, self._placements()
        _, rho, slope = self._moments(place, com)
        rho_rate = float(2 * ((moving * slope).sum() - mass * (com[::2] @ velocity[::2])))
        turn, points = self._soles(place)
        foot = self._foot_carries @ moving.T  # (2, 6)
        speed = foot[:, None, :3] + points @ skew(foot[:, 3:]).transpose(0, 2, 1)  # (2, 3 points, 3)
        feet = (*points.transpose(1, 0, 2), *speed.transpose(1, 0, 2), turn, foot[:, 3:])
        return FullMotion(q, v, place[0, :3, :3].copy(), com, velocity, momentum, rho, rho_rate, *feet)

    def _placements(self) -> np.ndarray:
        """Placements of all bodies (n, 4, 4) as Pinocchio last left them; the next call overwrites the array."""
        place, n = self._place, len(self._place)
        place[:, :3, :3] = np.concatenate(self._rotations).reshape(n, 3, 3)
        place[:, :3, 3] = np.concatenate(self._translations).reshape(n, 3)
        return place

    def _moments(self, place: np.ndarray, com: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        """D (n, 4, 4), rho, and half the slope of D_xx + D_zz along every column's twist (6, nv).

        With D, the integral of [x; 1][x; 1]^T dm: rho = D_xx + D_zz - m (c_x^2 + c_z^2).
        """
        D = place @ self._pseudo @ place.transpose(0, 2, 1)
        carried = self._above.T @ D.reshape(len(D), 16)  # by each joint
        rho = carried[0, 0] + carried[0, 10] - self.mass * (com[::2] @ com[::2])
        return D, rho, (carried @ SLOPE)[self._column_joint].T

    def _soles(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations of the feet (2, 3, 3), and places of tiptoes, heels and soles (2, 3 points, 3)."""
        at = place[self._foot_bodies, :3]  # (2, 3, 4)
        turn = at[..., :3]
        return turn @ self._foot_turn, self.foot_points @ turn.transpose(0, 2, 1) + at[:, None, :, 3]


def _half_second(D, twist) -> float:
    """Half of the second derivative of D_xx + D_zz, summed over the bodies, at theta'' = 0."""
    x = np.empty((len(D), 2, 3, 4))  # x' = x[:, 0] [x; 1], and at theta'' = 0 x'' = x[:, 1] [x; 1]
    x[..., :3], x[..., 3] = skew(twist[:, 1::2]), twist[:, ::2]
    rate, second = x[:, 0], x[:, 1]
    second += rate[..., :3] @ rate
    rate, second = rate[:, ::2], second[:, ::2]  # of x and z
    return ((rate @ D) * rate + D[:, :3:2] * second).sum()
