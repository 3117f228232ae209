"""Any tree of turning joints in space, in CasADi: inverse dynamics, momentum, CoM and points of links.

The base has the coordinates x, y, z of its origin and the angles yaw, roll, pitch, turned in this order about its own
axes z, x, y: yaw and pitch may pass any number of full turns, roll stays within a quarter. The joints follow in
Pinocchio's order. Every body is re-framed so that its joint turns about a coordinate axis: what such a rotation leaves
alone costs nothing. Pinocchio says the same of every quantity (tests).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot.reduction import EXACT_M, mirror
from jumplab.task import GRAVITY

CHART = ("x", "y", "z", "yaw", "roll", "pitch")  # coordinates of the base
ATTITUDE_AXES = (2, 0, 1)  # that yaw, roll and pitch turn about
ROUNDING = 1e-12  # entries of rotations and inertias below it are none
ALONG = 1 - 1e-12  # cosine from which an axis is a coordinate axis


@dataclass(frozen=True)
class Body:
    """One link with its joint, in a frame whose coordinate axis ``axis`` is the joint's."""

    name: str
    parent: int  # index of the body that carries it; 0 is the base
    axis: int
    turn: np.ndarray  # (3, 3) of the frame at angle zero, in the parent's
    place: np.ndarray  # (3,) its origin there [m]
    own: np.ndarray  # (3, 3) the frame's axes in Pinocchio's frame of this joint
    mass: float  # [kg]
    first: np.ndarray  # (3,) mass times CoM [kg m]
    second: np.ndarray  # (3, 3) inertia about the origin [kg m^2]


def _clean(x: np.ndarray) -> np.ndarray:
    return np.where(np.abs(x) < ROUNDING, 0.0, x)


def _frame_along(axis: np.ndarray) -> tuple[int, np.ndarray]:
    """(k, Q): the coordinate axis k of the frame with axes Q points along ``axis`` (3,)."""
    k = int(np.argmax(np.abs(axis)))
    if axis[k] > ALONG:
        return k, np.eye(3)
    if axis[k] < -ALONG:
        return k, np.diag(np.where(np.arange(3) == (k + 1) % 3, 1.0, -1.0))
    return 2, pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).toRotationMatrix()


class SpatialModel:
    """Numbers of a robot's tree, from its Pinocchio model with a free-flyer base.

    Attributes
    ----------
    bodies : the base first, then one per joint.  names : of the coordinates, (6 + joints,).
    mass : [kg].  carried : (bodies,) mass that each joint carries [kg].
    joints : number of joints.  armature : (joints,) of the motors, at the joints [kg m^2].
    """

    def __init__(self, model: pin.Model):
        self.model, data = model, model.createData()
        if model.joints[1].shortname() != "JointModelFreeFlyer" or model.nv - 6 != model.njoints - 2:
            raise RobotError(f"robot {model.name}: the spatial model takes a free base and joints of one axis each")
        neutral, frames, self.bodies = pin.neutral(model), {}, []
        for j in range(1, model.njoints):
            parent = max(0, model.parents[j] - 1)
            axis, own = 1, np.eye(3)
            if j > 1:
                way = pin.computeJointJacobian(model, data, neutral, j)[:, model.idx_vs[j]]
                if model.nqs[j] != 1 or abs(np.linalg.norm(way[3:]) - 1) > 1e-9 or np.abs(way[:3]).max() > 1e-9:
                    raise RobotError(f"robot {model.name}: joint {model.names[j]!r} is no joint that turns in a range")
                axis, own = _frame_along(way[3:])
            frames[j] = own
            above, placement = frames.get(model.parents[j], np.eye(3)), model.jointPlacements[j]
            inertia = model.inertias[j]
            c = own.T @ inertia.lever
            about = own.T @ inertia.inertia @ own + inertia.mass * (c @ c * np.eye(3) - np.outer(c, c))
            turn, place = _clean(above.T @ placement.rotation @ own), _clean(above.T @ placement.translation)
            numbers = inertia.mass, _clean(inertia.mass * c), _clean(about)
            self.bodies.append(Body(model.names[j], parent, axis, turn, place, own, *numbers))
        self.mass = float(sum(b.mass for b in self.bodies))
        self.carried = [b.mass for b in self.bodies]
        for k in range(len(self.bodies) - 1, 0, -1):
            self.carried[self.bodies[k].parent] += self.carried[k]
        self.joints, self.armature = len(self.bodies) - 1, np.array(model.armature[6:])
        self.names = (*CHART, *(b.name for b in self.bodies[1:]))

    @cached_property
    def across(self) -> tuple[int | None, ...]:
        """Axis of each body's frame that lies across the x-z plane, of bodies in the middle; None of those beside it.

        A body in the middle is its own mirror image: its joint turns about that axis, or is held at zero.
        """
        counterpart = {i: k for i, k, _ in self.pairs}
        out = [1]
        for j, b in enumerate(self.bodies[1:]):
            lateral = b.turn[out[b.parent]] if out[b.parent] is not None else np.zeros(3)
            along = np.flatnonzero(np.abs(lateral) > ALONG)
            out.append(int(along[0]) if counterpart.get(j) == j and len(along) else None)
        return tuple(out)

    @cached_property
    def pairs(self) -> list[tuple[int, int, float]]:
        """Joints that are mirror images of each other, exactly; see :func:`jumplab.robot.reduction.mirror`."""
        return mirror(self.model, EXACT_M)

    @cached_property
    def left_half(self) -> tuple[int, ...]:
        """Bodies in the middle and to the left of it."""
        return tuple(k for k in range(len(self.bodies)) if self.across[k] is not None or k in self._left)

    @cached_property
    def _left(self) -> frozenset[int]:
        """Bodies to the left; those that begin in the middle go with what they carry."""
        data, out = self.model.createData(), set()
        pin.forwardKinematics(self.model, data, pin.neutral(self.model))
        far = [data.oMi[k + 1].translation[1] for k in range(len(self.bodies))]
        for k in range(len(self.bodies) - 1, 0, -1):
            parent = self.bodies[k].parent
            if self.across[parent] is None and abs(far[k]) > abs(far[parent]):
                far[parent] = far[k]
        for k in range(1, len(self.bodies)):
            if self.across[k] is None:
                parent = self.bodies[k].parent
                beside = self.across[parent] is None
                if parent in out if beside else far[k] > 0:
                    out.add(k)
        return frozenset(out)

    def local(self, joint: int, point: np.ndarray) -> np.ndarray:
        """A ``point`` (3,) in Pinocchio's frame of a ``joint`` (its index there), in the frame of its body here."""
        return _clean(self.bodies[joint - 1].own.T @ np.asarray(point, float))

    def rotations(self, q: np.ndarray) -> np.ndarray:
        """Attitudes of the base (n, 3, 3) from charts (n, >= 6)."""
        (cy, cr, cp), (sy, sr, sp) = np.cos(q[:, 3:6]).T, np.sin(q[:, 3:6]).T
        rows = cy * cp - sy * sr * sp, -sy * cr, cy * sp + sy * sr * cp, sy * cp + cy * sr * sp, cy * cr
        rows += sy * sp - cy * sr * cp, -cr * sp, sr, cr * cp
        return np.stack(rows, -1).reshape(-1, 3, 3)

    def to_pinocchio(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Configurations (n, nq), twists and their time derivatives from charts, rates, accelerations, all (n, nv)."""
        turn, n = self.rotations(q), len(q)
        slope, drift = spin_slope(q[:, 4], q[:, 5]), _spin_drift(q[:, 4], q[:, 5], v[:, 3:6])
        spin = np.einsum("nij,nj->ni", slope, v[:, 3:6])
        out_q, out_v, out_a = np.empty((n, self.model.nq)), v.copy(), a.copy()
        out_q[:, :3], out_q[:, 7:] = q[:, :3], q[:, 6:]
        half = q[:, 3:6] / 2
        (cy, cr, cp), (sy, sr, sp) = np.cos(half).T, np.sin(half).T  # quaternions that follow whole turns
        out_q[:, 3:7] = np.stack(
            [
                cy * sr * cp - sy * cr * sp,
                sy * sr * cp + cy * cr * sp,
                sy * cr * cp + cy * sr * sp,
                cy * cr * cp - sy * sr * sp,
            ],
            -1,
        )
        out_v[:, :3], out_v[:, 3:6] = np.einsum("nji,nj->ni", turn, v[:, :3]), spin
        out_a[:, :3] = np.einsum("nji,nj->ni", turn, a[:, :3]) - np.cross(spin, out_v[:, :3])
        out_a[:, 3:6] = np.einsum("nij,nj->ni", slope, a[:, 3:6]) + drift
        return out_q, out_v, out_a

    def charts(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, near: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Charts, rates and accelerations (n, 6 + joints) of a motion in Pinocchio's words: the inverse of
        :meth:`to_pinocchio`. The first attitude is within half a turn of the angles ``near`` (3,)."""
        chart = self.of_pinocchio(q, near)
        turn, slope = self.rotations(chart), spin_slope(chart[:, 4], chart[:, 5])
        rates = np.linalg.solve(slope, v[:, 3:6, None])[..., 0]
        drift = _spin_drift(chart[:, 4], chart[:, 5], rates)
        speeds = np.linalg.solve(slope, (a[:, 3:6] - drift)[..., None])[..., 0]
        linear = np.einsum("nij,nj->ni", turn, v[:, :3])
        gain = np.einsum("nij,nj->ni", turn, a[:, :3] + np.cross(v[:, 3:6], v[:, :3]))
        return chart, np.hstack([linear, rates, v[:, 6:]]), np.hstack([gain, speeds, a[:, 6:]])

    def of_pinocchio(self, q: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Charts (n, 6 + joints) of configurations (n, nq), their angles continuous.

        The first attitude is within half a turn of the angles ``near`` (3,), by default zero.
        """
        x, y, z, w = q[:, 3:7].T
        roll = np.arcsin(np.clip(2 * (y * z + w * x), -1, 1))
        yaw = np.arctan2(-2 * (x * y - w * z), 1 - 2 * (x * x + z * z))
        pitch = np.arctan2(-2 * (x * z - w * y), 1 - 2 * (x * x + y * y))
        angles = np.stack([yaw, roll, pitch], -1)
        first = np.zeros(3) if near is None else near
        angles = np.unwrap(np.vstack([first, angles]), axis=0)[1:]
        return np.concatenate([q[:, :3], angles, q[:, 7:]], axis=1)


def spin_slope(roll: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """(n, 3, 3): angular velocity in base axes = slope @ rates of yaw, roll, pitch."""
    cr, sr, cp, sp, one = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.ones_like(roll)
    return np.stack([-cr * sp, cp, 0 * one, sr, 0 * one, one, cr * cp, sp, 0 * one], -1).reshape(-1, 3, 3)


def _spin_drift(roll: np.ndarray, pitch: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """(n, 3): rate of that slope times the rates."""
    (yaw_v, roll_v, pitch_v), cr, sr, cp, sp = rates.T, np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    x = (sr * sp * roll_v - cr * cp * pitch_v) * yaw_v - sp * pitch_v * roll_v
    z = (-sr * cp * roll_v - cr * sp * pitch_v) * yaw_v + cp * pitch_v * roll_v
    return np.stack([x, cr * roll_v * yaw_v, z], -1)


class Turn:
    """A rotation about a coordinate axis by an angle, after a fixed one."""

    def __init__(self, axis: int, angle: ca.SX, fixed: np.ndarray | None = None):
        self.c, self.s, self.i, self.j = ca.cos(angle), ca.sin(angle), (axis + 1) % 3, (axis + 2) % 3
        self.axis, self.fixed = axis, None if fixed is None or np.array_equal(fixed, np.eye(3)) else ca.DM(fixed)

    def out(self, x: ca.SX) -> ca.SX:
        """A vector (3,) of the turned frame in the outer one; or the columns of a matrix."""
        y = ca.SX(x)
        y[self.i, :], y[self.j, :] = (
            self.c * x[self.i, :] - self.s * x[self.j, :],
            self.s * x[self.i, :] + self.c * x[self.j, :],
        )
        return y if self.fixed is None else self.fixed @ y

    def into(self, x: ca.SX) -> ca.SX:
        """A vector (3,) of the outer frame in the turned one."""
        x = ca.SX(x) if self.fixed is None else self.fixed.T @ x
        y = ca.SX(x)
        y[self.i], y[self.j] = self.c * x[self.i] + self.s * x[self.j], self.c * x[self.j] - self.s * x[self.i]
        return y


def cross(x: ca.SX, y: ca.SX) -> ca.SX:
    """Vector product (3,)."""
    return ca.vertcat(x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])


class SpatialState:
    """All quantities of a tree at one instant, as CasADi expressions; made when first asked for.

    ``q``, ``v``, ``a`` (6 + joints,) are chart, rates and accelerations; vectors are in world axes if not said
    otherwise. ``gravity`` is positive [m/s^2].

    In a motion that is ``even``, whose right half is the mirror image of the left one in the x-z plane, sums over the
    tree run over the left half and count it twice.
    """

    def __init__(
        self, model: SpatialModel, q: ca.SX, v: ca.SX, a: ca.SX, gravity: float | ca.SX = GRAVITY, even: bool = False
    ):
        self.model, self.q, self.v, self.a, self.gravity = model, q, v, a, gravity
        self._base = [Turn(axis, q[3 + k]) for k, axis in enumerate(ATTITUDE_AXES)]
        joints = enumerate(model.bodies[1:], start=6)
        self._turns = [None, *(Turn(b.axis, q[k], b.turn) for k, b in joints)]
        self._even, self._counted = even, model.left_half if even else tuple(range(len(model.bodies)))
        self._spins, self._accelerations, self._velocities, self._frames = {}, {}, {}, {}

    def _spin(self, k: int) -> ca.SX:
        """Angular velocity of a body, in its own axes."""
        if k not in self._spins:
            b = self.model.bodies[k]
            if k:
                spin = self._turns[k].into(self._spin(b.parent))
                spin[b.axis] += self.v[5 + k]
            else:
                spin = ca.SX.zeros(3)
                for i, turn in enumerate(self._base):
                    spin = turn.into(spin)
                    spin[turn.axis] += self.v[3 + i]
            self._spins[k] = spin
        return self._spins[k]

    def _acceleration(self, k: int) -> tuple[ca.SX, ca.SX]:
        """(linear less gravity, angular) acceleration of a body's origin, in its own axes."""
        if k not in self._accelerations:
            self._accelerations[k] = self._accelerated(k) if k else self._base_accelerated()
        return self._accelerations[k]

    def _base_accelerated(self) -> tuple[ca.SX, ca.SX]:
        linear, angular, spin = self.a[:3] + ca.vertcat(0, 0, self.gravity), ca.SX.zeros(3), ca.SX.zeros(3)
        for i, turn in enumerate(self._base):
            linear, angular, spin = turn.into(linear), turn.into(angular), turn.into(spin)
            angular += cross(spin, _unit(turn.axis, self.v[3 + i])) + _unit(turn.axis, self.a[3 + i])
            spin[turn.axis] += self.v[3 + i]
        return linear, angular

    def _accelerated(self, k: int) -> tuple[ca.SX, ca.SX]:
        b, turn = self.model.bodies[k], self._turns[k]
        (linear, angular), spin = self._acceleration(b.parent), self._spin(b.parent)
        if np.any(b.place):
            linear = linear + cross(angular, b.place) + cross(spin, cross(spin, b.place))
        linear, angular, spin = turn.into(linear), turn.into(angular), turn.into(spin)
        angular += cross(spin, _unit(b.axis, self.v[5 + k])) + _unit(b.axis, self.a[5 + k])
        return linear, angular

    def _doubled(self, k: int) -> int | None:
        """The axis of a body's parent that lies across the plane, where both sides of the robot meet there."""
        b = self.model.bodies[k]
        return self.model.across[b.parent] if self._even and self.model.across[k] is None else None

    def _gathered(self, parts: Mapping[int, tuple[ca.SX, ca.SX]]) -> tuple[ca.SX, ca.SX, dict[int, ca.SX]]:
        """Sums over the tree of (force-like, moment-like) vectors at the bodies' origins: at the base's origin in world
        axes, and per body the component of the moment about its joint's axis."""
        parts, along = dict(parts), {}
        for k in self._counted[:0:-1]:
            b, turn, (force, moment) = self.model.bodies[k], self._turns[k], parts[k]
            along[k] = moment[b.axis]
            force, moment = turn.out(force), turn.out(moment)
            if np.any(b.place):
                moment = moment + cross(b.place, force)
            if (across := self._doubled(k)) is not None:
                force, moment = 2 * _without(force, across), 2 * _unit(across, moment[across])
            parts[b.parent] = parts[b.parent][0] + force, parts[b.parent][1] + moment
        force, moment = parts[0]
        for turn in self._base[::-1]:
            force, moment = turn.out(force), turn.out(moment)
        return force, moment, along

    def dynamics(self, wrenches: Mapping[int, tuple[ca.SX, ca.SX]] = {}) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Inverse dynamics: (force, moment about the base's origin, joint torques) that the motion needs besides.

        ``wrenches`` act from outside: body -> (force, moment about the body's origin), in the body's axes. In an even
        motion those on the left half stand for those on the right one too, and torques of the right half mean nothing.
        """
        parts = {}
        for k in self._counted:
            b, spin, (linear, angular) = self.model.bodies[k], self._spin(k), self._acceleration(k)
            first, second = ca.DM(b.first), ca.DM(b.second)
            force = b.mass * linear + cross(angular, first) + cross(spin, cross(spin, first))
            moment = second @ angular + cross(spin, second @ spin) + cross(first, linear)
            if k in wrenches:
                force, moment = force - wrenches[k][0], moment - wrenches[k][1]
            parts[k] = force, moment
        force, moment, along = self._gathered(parts)
        torques = [along.get(k, ca.SX(0)) for k in range(1, len(self.model.bodies))]
        return force, moment, ca.vertcat(ca.SX(0, 1), *torques) + self.model.armature * self.a[6:]

    @cached_property
    def _momenta(self) -> tuple[ca.SX, ca.SX]:
        """Linear momentum, and angular momentum about the base's origin, of a base whose origin rests."""
        linear, parts = {0: ca.SX.zeros(3)}, {}
        for k in self._counted:
            b, spin = self.model.bodies[k], self._spin(k)
            if k:
                at = linear[b.parent]
                if np.any(b.place):
                    at = at + cross(self._spin(b.parent), b.place)
                linear[k] = self._turns[k].into(at)
            first, second = ca.DM(b.first), ca.DM(b.second)
            parts[k] = b.mass * linear[k] + cross(spin, first), second @ spin + cross(first, linear[k])
        return self._gathered(parts)[:2]

    @cached_property
    def com_from_base(self) -> ca.SX:
        """CoM seen from the base's origin (3,) [m]."""
        parts = {k: ca.SX(ca.DM(self.model.bodies[k].first)) for k in self._counted}
        for k in self._counted[:0:-1]:
            b = self.model.bodies[k]
            more = self._turns[k].out(parts[k]) + self.model.carried[k] * ca.DM(b.place)
            if (across := self._doubled(k)) is not None:
                more = 2 * _without(more, across)
            parts[b.parent] += more
        first = parts[0]
        for turn in self._base[::-1]:
            first = turn.out(first)
        return first / self.model.mass

    @property
    def com(self) -> ca.SX:
        """Centre of mass (3,) [m]."""
        return self.q[:3] + self.com_from_base

    @property
    def com_velocity(self) -> ca.SX:
        """Its velocity (3,) [m/s]."""
        return self.v[:3] + self._momenta[0] / self.model.mass

    @property
    def angular_momentum(self) -> ca.SX:
        """About the CoM (3,) [kg m^2/s]; independent of the base's place and velocity."""
        linear, angular = self._momenta
        return angular - cross(self.com_from_base, linear)

    @property
    def inertia(self) -> ca.SX:
        """Inertia (3, 3) of all bodies as one, about the CoM, in world axes [kg m^2]."""
        total = -self.model.mass * _spread(self.com_from_base, self.com_from_base)
        for k, b in enumerate(self.model.bodies):
            turn, place = self._frame(k)
            first = turn @ ca.DM(b.first)
            total += turn @ ca.DM(b.second) @ turn.T + b.mass * _spread(place, place)
            total += _spread(place, first) + _spread(first, place)
        return total

    def spin(self, body: int) -> ca.SX:
        """Angular velocity (3,) of a body [rad/s]."""
        return self.rotation(body) @ self._spin(body)

    def rotation(self, body: int) -> ca.SX:
        """Attitude (3, 3) of a body."""
        return self._frame(body)[0]

    def origin(self, body: int) -> ca.SX:
        """Origin of a body (3,) [m], seen from the base's."""
        return self._frame(body)[1]

    def _frame(self, k: int) -> tuple[ca.SX, ca.SX]:
        if k not in self._frames:
            if k == 0:
                turn = ca.SX.eye(3)
                for one in self._base[::-1]:
                    turn = one.out(turn)
                self._frames[k] = turn, ca.SX.zeros(3)
            else:
                b, t = self.model.bodies[k], self._turns[k]
                above, place = self._frame(b.parent)
                fixed = above if t.fixed is None else above @ t.fixed
                turn = ca.SX(fixed)
                turn[:, t.i], turn[:, t.j] = (
                    fixed[:, t.i] * t.c + fixed[:, t.j] * t.s,
                    fixed[:, t.j] * t.c - fixed[:, t.i] * t.s,
                )
                self._frames[k] = turn, place + above @ ca.DM(b.place)
        return self._frames[k]

    def point(self, body: int, local: np.ndarray) -> ca.SX:
        """Place of a point of a body (3,) [m], in the world; see :meth:`SpatialModel.local`."""
        return self.q[:3] + self.origin(body) + self.rotation(body) @ ca.DM(local)

    def from_base(self, body: int, local: np.ndarray) -> ca.SX:
        """Place of a point of a body (3,) [m], seen from the base's origin in the base's axes."""
        place = ca.SX(ca.DM(local))
        while body:
            place = self._turns[body].out(place) + ca.DM(self.model.bodies[body].place)
            body = self.model.bodies[body].parent
        return place

    def _velocity(self, k: int) -> ca.SX:
        """Velocity of a body's origin, in its own axes."""
        if k not in self._velocities:
            b = self.model.bodies[k]
            linear = self._velocity(b.parent) if k else self.v[:3]
            if k and np.any(b.place):
                linear = linear + cross(self._spin(b.parent), b.place)
            for turn in [self._turns[k]] if k else self._base:
                linear = turn.into(linear)
            self._velocities[k] = linear
        return self._velocities[k]

    def own_rates(self, body: int, local: np.ndarray) -> tuple[ca.SX, ca.SX]:
        """Velocity of a point of a body, and angular velocity of the body (3,) each, in the body's axes."""
        spin = self._spin(body)
        return self._velocity(body) + cross(spin, ca.DM(local)), spin

    def own_accelerations(self, body: int, local: np.ndarray) -> tuple[ca.SX, ca.SX]:
        """Acceleration of a point of a body, and angular acceleration of the body (3,) each, in the body's axes."""
        spin, (linear, angular), arm = self._spin(body), self._acceleration(body), ca.DM(local)
        fall = self.gravity * self.rotation(body)[2, :].T
        return linear - fall + cross(angular, arm) + cross(spin, cross(spin, arm)), angular

    def point_velocity(self, body: int, local: np.ndarray) -> ca.SX:
        """Its velocity (3,) [m/s]."""
        return rates(lambda q: SpatialState(self.model, q, q, q).point(body, local), self.q, self.v)[0]


def rates(of: Callable[[ca.SX], ca.SX], q: ca.SX, v: ca.SX, a: ca.SX | None = None) -> tuple[ca.SX, ca.SX | None]:
    """First and second time derivative of a column that depends on the chart alone; without ``a`` only the first."""
    x, w, b = (ca.SX.sym(name, q.numel()) for name in "qva")
    first = ca.jtimes(of(x), x, w)
    second = None if a is None else ca.jtimes(first, ca.vertcat(x, w), ca.vertcat(w, b))
    made = ca.Function("rates", [x, w, b], [first] if a is None else [first, second])
    found = made(q, v, v if a is None else a)
    return (found, None) if a is None else found


def _spread(x: ca.SX, y: ca.SX) -> ca.SX:
    """(3, 3): x . y times the unit matrix, less the dyad y x'."""
    return ca.dot(x, y) * ca.SX.eye(3) - y @ x.T


def _unit(axis: int, size: ca.SX) -> ca.SX:
    x = ca.SX.zeros(3)
    x[axis] = size
    return x


def _without(x: ca.SX, axis: int) -> ca.SX:
    """The vector less its part along an axis."""
    y = ca.SX(x)
    y[axis] = 0
    return y
