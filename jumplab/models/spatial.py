"""Any tree of turning joints in space, in CasADi: inverse dynamics, momentum, CoM and points of
links.

The base has the coordinates x, y, z of its origin and the angles yaw, roll, pitch, turned in this
order about its own axes z, x, y: yaw and pitch may pass any number of full turns, roll stays within
a quarter. The joints follow in Pinocchio's order. Every body is re-framed so that its joint turns
about a coordinate axis: what such a rotation leaves alone costs nothing. Pinocchio says the same of
every quantity (tests).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from jumplab.errors import RobotError
from jumplab.robot.contact import posed
from jumplab.robot.locked import LockedJoint
from jumplab.robot.reduction import EXACT_M, mirror
from jumplab.task import GRAVITY

CHART = ("x", "y", "z", "yaw", "roll", "pitch")  # coordinates of the base
ATTITUDE_AXES = (2, 0, 1)  # that yaw, roll and pitch turn about
cross = ca.cross  # vector product (3,)
ROUNDING = 1e-12  # entries of rotations and inertias below it are none
# factors of an inertia, with which it is that of a body and its mirror image in the x-z plane
WITH_MIRROR_IMAGE = np.array([[2, 0, 2], [0, 2, 0], [2, 0, 2]])
ALONG = 1 - 1e-12  # cosine from which an axis is a coordinate axis


@dataclass(frozen=True)
class Link:
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
        self.model = model
        free = model.joints[1].shortname() == "JointModelFreeFlyer"
        if not free or model.nv - 6 != model.njoints - 2:
            raise RobotError(
                f"robot {model.name}: the spatial model needs a free base and joints of one degree "
                f"of freedom each"
            )
        data = posed(model)
        frames = [np.eye(3)] * 2  # of the world and the base, then of each joint
        axes = [1]
        for j in range(2, model.njoints):
            axis, frame = self._joint(data, j)
            axes.append(axis)
            frames.append(frame)
        self.bodies = []
        for j, (axis, own) in enumerate(zip(axes, frames[1:], strict=True), start=1):
            above = frames[model.parents[j]].T
            placement = model.jointPlacements[j]
            inertia = pin.SE3(own.T, np.zeros(3)).act(model.inertias[j])
            lever = pin.skew(inertia.lever)
            link = Link(
                model.names[j],
                max(0, model.parents[j] - 1),
                axis,
                _clean(above @ placement.rotation @ own),
                _clean(above @ placement.translation),
                own,
                inertia.mass,
                _clean(inertia.mass * inertia.lever),
                _clean(inertia.inertia - inertia.mass * lever @ lever),
            )
            self.bodies.append(link)
        self.mass = float(sum(b.mass for b in self.bodies))
        self.carried = [*data.mass[1:]]
        middles = zip(data.oMi[1:], data.com[1:], strict=True)
        self._aside_m = [place.act(com)[1] for place, com in middles]  # of all that a joint carries
        self.joints = len(self.bodies) - 1
        self.armature = np.array(model.armature[6:])
        self.names = (*CHART, *(b.name for b in self.bodies[1:]))

    def _joint(self, data: pin.Data, j: int) -> tuple[int, np.ndarray]:
        """The axis of a joint, and its frame, see :func:`_frame_along`."""
        model = self.model
        way = pin.getJointJacobian(model, data, j, pin.ReferenceFrame.LOCAL)[:, model.idx_vs[j]]
        turns = np.abs(way[:3]).max() <= 1e-9 and abs(np.linalg.norm(way[3:]) - 1) <= 1e-9
        if model.nqs[j] != 1 or not turns:
            raise RobotError(
                f"robot {model.name}: joint {model.names[j]!r} must be revolute and have a range"
            )
        return _frame_along(way[3:])

    @cached_property
    def across(self) -> tuple[int | None, ...]:
        """Axis of each body's frame that lies across the x-z plane, of bodies in the middle; None
        of those beside it.

        A body in the middle is its own mirror image: its joint turns about that axis, or is held at
        zero.
        """
        middle = {1 + i for i, k, _ in self.pairs if i == k}
        out = [1]
        for j, b in enumerate(self.bodies[1:], start=1):
            above = out[b.parent]
            lateral = b.turn[above] if above is not None else np.zeros(3)
            along = np.flatnonzero(np.abs(lateral) > ALONG)
            out.append(int(along[0]) if j in middle and len(along) else None)
        return tuple(out)

    @cached_property
    def pairs(self) -> list[tuple[int, int, float]]:
        """Joints that are mirror images of each other, exactly; see
        :func:`jumplab.robot.reduction.mirror`.
        """
        return mirror(self.model, EXACT_M)

    @cached_property
    def left_half(self) -> tuple[int, ...]:
        """Bodies in the middle and to the left of it; bodies that begin in the middle go with what
        they carry.
        """
        bodies = enumerate(zip(self.across, self._aside_m, strict=True))
        return tuple(k for k, (across, aside) in bodies if across is not None or aside > 0)

    def local(self, joint: int, point: np.ndarray) -> np.ndarray:
        """A ``point`` (3,) in Pinocchio's frame of a ``joint`` (its index there), in the frame of
        its body here [m].
        """
        return _clean(self.bodies[joint - 1].own.T @ np.asarray(point, float))

    @staticmethod
    def attitudes(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of yaw, roll and pitch (n, 3), the base's attitudes (n, 3, 3), and the slopes (n, 3, 3)
        of its angular velocity, in its own axes, along their rates.
        """
        return _rotation().from_euler("ZXY", angles).as_matrix(), _slopes(angles)

    def to_pinocchio(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Configurations (n, nq), twists and their time derivatives from charts, rates,
        accelerations, all (n, nv).
        """
        angles, rates, gains = (x[:, 3:6] for x in (q, v, a))
        turn = _rotation().from_euler("ZXY", angles)  # its quaternions follow whole turns
        slope, change = _slopes(angles), _slopes(angles, rates)
        speed = turn.apply(np.array(v[:, :3]), inverse=True)
        spin = np.matvec(slope, rates)
        accel = turn.apply(np.array(a[:, :3]), inverse=True) - np.cross(spin, speed)
        turning = np.matvec(slope, gains) + np.matvec(change, rates)
        configurations = np.hstack([q[:, :3], turn.as_quat(), q[:, 6:]])
        twists = np.hstack([speed, spin, v[:, 6:]])
        return configurations, twists, np.hstack([accel, turning, a[:, 6:]])

    def charts(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, near: ArrayLike = (0.0, 0.0, 0.0)
    ) -> np.ndarray:
        """Charts, rates and accelerations (3, n, 6 + joints) of a motion in Pinocchio's words: the
        inverse of :meth:`to_pinocchio`. The first attitude is within half a turn of the angles
        ``near`` (3,)."""
        chart = self.of_pinocchio(q, near)
        turn = _rotation().from_quat(q[:, 3:7])
        speed = np.array(v[:, :3])  # SciPy turns no read-only arrays
        spin = v[:, 3:6]
        back = np.linalg.inv(_slopes(chart[:, 3:6]))
        rates = np.matvec(back, spin)
        gains = np.matvec(back, a[:, 3:6] - np.matvec(_slopes(chart[:, 3:6], rates), rates))
        accel = turn.apply(a[:, :3] + np.cross(spin, speed))
        rates = np.hstack([turn.apply(speed), rates, v[:, 6:]])
        return np.array([chart, rates, np.hstack([accel, gains, a[:, 6:]])])

    def of_pinocchio(self, q: np.ndarray, near: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
        """Charts (n, 6 + joints) of configurations (n, nq), their angles continuous.

        The first attitude is within half a turn of the angles ``near`` (3,).
        """
        angles = _rotation().from_quat(q[:, 3:7]).as_euler("ZXY")
        angles = np.unwrap(np.vstack([near, angles]), axis=0)[1:]
        return np.hstack([q[:, :3], angles, q[:, 7:]])


def _rotation() -> type:
    """SciPy's rotations, whose "ZXY" are those of the chart."""
    from scipy.spatial.transform import Rotation  # slow to import

    return Rotation


def _slopes(angles: np.ndarray, rates: np.ndarray | None = None) -> np.ndarray:
    """Slopes (n, 3, 3) of the base's angular velocity, in its own axes, along the rates of yaw,
    roll and pitch (n, 3); with ``rates`` of these angles, their time derivative.
    """
    if rates is not None:
        tiny = 1e-30  # a step along the imaginary axis loses no digit
        return _slopes(angles + 1j * tiny * rates).imag / tiny
    _, roll, pitch = angles.T
    yawing = [-np.cos(roll) * np.sin(pitch), np.sin(roll), np.cos(roll) * np.cos(pitch)]
    rolling = [np.cos(pitch), 0 * pitch, np.sin(pitch)]
    pitching = [0 * pitch, 0 * pitch + 1, 0 * pitch]
    return np.array([yawing, rolling, pitching]).transpose(2, 1, 0)


class Turn:
    """A rotation about a coordinate axis by the angle in a ``column`` of the chart ``q``, after a
    fixed one (3, 3)."""

    def __init__(self, q: ca.SX, column: int, axis: int, fixed: np.ndarray | None = None):
        i = (axis + 1) % 3
        j = (axis + 2) % 3
        angle = q[column]
        self.column = column
        self.axis = axis
        self.fixed = ca.sparsify(ca.DM(np.eye(3) if fixed is None else fixed))
        self.turn = ca.SX(3, 3)
        self.turn[axis, axis] = 1
        self.turn[i, i] = self.turn[j, j] = ca.cos(angle)
        self.turn[j, i] = ca.sin(angle)
        self.turn[i, j] = -ca.sin(angle)

    def out(self, x: ca.SX) -> ca.SX:
        """A vector (3,) of the turned frame in the outer one."""
        return self.fixed @ (self.turn @ x)

    def into(self, x: ca.SX) -> ca.SX:
        """A vector (3,) of the outer frame in the turned one."""
        return self.turn.T @ (self.fixed.T @ x)


def along(axis: int, size: ca.SX) -> ca.SX:
    """A vector (3,) along a coordinate axis."""
    x = ca.SX.zeros(3)
    x[axis] = size
    return x


class SpatialState:
    """All quantities of a tree at one instant, as CasADi expressions; made when first asked for.

    ``q``, ``v``, ``a`` (6 + joints,) are chart, rates and accelerations; vectors are in world axes
    if not said otherwise. ``gravity`` is positive [m/s^2].

    In a motion that is ``even``, whose right half is the mirror image of the left one in the x-z
    plane, sums over the tree run over the left half and count it twice.
    """

    def __init__(
        self,
        model: SpatialModel,
        q: ca.SX,
        v: ca.SX,
        a: ca.SX,
        gravity: float | ca.SX = GRAVITY,
        even: bool = False,
    ):
        self.model = model
        self.q = q
        self.v = v
        self.a = a
        self.gravity = gravity
        base = [Turn(q, 3 + k, axis) for k, axis in enumerate(ATTITUDE_AXES)]
        joints = [[Turn(q, k, b.axis, b.turn)] for k, b in enumerate(model.bodies[1:], 6)]
        self._turns = [base, *joints]
        self._even = even
        counted = model.left_half if even else range(len(model.bodies))
        self._counted = {k: model.bodies[k] for k in counted}

    # from the base outwards, in the bodies' own axes
    # ------------------------------------------------------------------------------------------
    @cached_property
    def _spins(self) -> list[ca.SX]:
        """Angular velocities."""
        out = []
        for b, turns in zip(self.model.bodies, self._turns, strict=True):
            spin = out[b.parent] if out else ca.SX.zeros(3)
            for turn in turns:
                spin = turn.into(spin) + along(turn.axis, self.v[turn.column])
            out.append(spin)
        return out

    @cached_property
    def _velocities(self) -> list[ca.SX]:
        """Velocities of the origins, less that of the base's."""
        out = [ca.SX.zeros(3)]
        for b, (turn,) in zip(self.model.bodies[1:], self._turns[1:], strict=True):
            out.append(turn.into(out[b.parent] + cross(self._spins[b.parent], b.place)))
        return out

    @cached_property
    def _accelerations(self) -> list[tuple[ca.SX, ca.SX]]:
        """(linear less gravity, angular) accelerations of the origins."""
        out = []
        for b, turns in zip(self.model.bodies, self._turns, strict=True):
            if out:
                linear, angular = out[b.parent]
                spin = self._spins[b.parent]
                linear = linear + cross(angular, b.place) + cross(spin, cross(spin, b.place))
            else:
                linear = self.a[:3] + along(2, self.gravity)
                angular = spin = ca.SX.zeros(3)
            for turn in turns:
                rate = along(turn.axis, self.v[turn.column])
                linear = turn.into(linear)
                spin = turn.into(spin)
                angular = turn.into(angular) + cross(spin, rate)
                angular = angular + along(turn.axis, self.a[turn.column])
                spin = spin + rate
            out.append((linear, angular))
        return out

    @cached_property
    def _frames(self) -> list[tuple[ca.SX, ca.SX]]:
        """Attitudes (3, 3), and origins seen from the base's, in world axes."""
        out = []
        for b, turns in zip(self.model.bodies, self._turns, strict=True):
            above, place = out[b.parent] if out else (ca.SX.eye(3), ca.SX.zeros(3))
            turned = above
            for turn in turns:
                turned = turned @ turn.fixed @ turn.turn
            out.append((turned, place + above @ b.place if out else place))
        return out

    # from the ends of the limbs inwards
    # ------------------------------------------------------------------------------------------
    def _doubled(self, k: int) -> int | None:
        """The axis of a body's parent that lies across the plane, where both sides of the robot
        meet there.
        """
        beside = self._even and self.model.across[k] is None
        return self.model.across[self.model.bodies[k].parent] if beside else None

    def _gathered(self, parts: Mapping[int, ca.SX]) -> dict[int, ca.SX]:
        """Force-like and moment-like vectors (6,) at the bodies' origins, in their axes, each with
        those of all bodies beyond."""
        sums = dict(parts)
        for k in [*self._counted][:0:-1]:
            parent = self._counted[k].parent
            sums[parent] = sums[parent] + self._at_parent(k, sums[k])
        return sums

    def _at_parent(self, k: int, x: ca.SX, both: bool = True) -> ca.SX:
        """Such vectors (6,) of a body at its parent's origin, in its axes; of ``both`` sides of an
        even motion where they meet."""
        (turn,) = self._turns[k]
        force, moment = (turn.out(y) for y in ca.vertsplit(x, 3))
        moment = moment + cross(self.model.bodies[k].place, force)
        across = self._doubled(k)
        if across is not None and both:
            force = 2 * (force - along(across, force[across]))
            moment = 2 * along(across, moment[across])
        return ca.vertcat(force, moment)

    def _in_world(self, x: ca.SX) -> list[ca.SX]:
        """Vectors (3,) of the base, one below the other, in world axes."""
        for turn in self._turns[0][::-1]:
            x = ca.vertcat(*(turn.out(y) for y in ca.vertsplit(x, 3)))
        return ca.vertsplit(x, 3)

    def dynamics(
        self, wrenches: Mapping[int, tuple[ca.SX, ca.SX]] = {}
    ) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Inverse dynamics: (force, moment about the base's origin, joint torques) that the motion
        needs besides (3,), (3,), (joints,) [N, N m].

        ``wrenches`` act from outside: body -> (force, moment about the body's origin), in the
        body's axes. In an even motion those on the left half stand for those on the right one too,
        and torques of the right half mean nothing.
        """
        parts = dict(self._inertial)
        for k in parts.keys() & wrenches.keys():
            parts[k] = parts[k] - ca.vertcat(*wrenches[k])
        sums = self._gathered(parts)
        bodies = enumerate(self.model.bodies)
        _, *axial = (sums[k][3 + b.axis] if k in sums else ca.SX(0) for k, b in bodies)
        torques = ca.vertcat(ca.SX(0, 1), *axial) + self.model.armature * self.a[6:]
        return *self._in_world(sums[0]), torques

    @cached_property
    def _inertial(self) -> dict[int, ca.SX]:
        """Force, and moment about its origin (6,), that the motion of each body needs, in its
        axes."""
        bodies = self._counted.items()
        return {k: self._inertial_of(k, b.mass, b.first, b.second) for k, b in bodies}

    def _inertial_of(self, k: int, mass: float, first: np.ndarray, second: np.ndarray) -> ca.SX:
        """The same of anything that is rigid with a body; see :class:`Link`."""
        spin = self._spins[k]
        linear, angular = self._accelerations[k]
        second = ca.DM(second)
        force = mass * linear + cross(angular, first) + cross(spin, cross(spin, first))
        moment = second @ angular + cross(spin, second @ spin) + cross(first, linear)
        return ca.vertcat(force, moment)

    def locked_torque(self, joint: LockedJoint) -> ca.SX:
        """Torque with which a joint that never moves holds its part on the base [N m].

        In an even motion a joint in the middle holds the limbs of both sides.
        """
        part = joint.part
        second = part.matrix()[3:, 3:]  # about the origin
        total = self._inertial_of(0, part.mass, part.mass * part.lever, second)
        sums = self._gathered(self._inertial)
        for k, b in self._counted.items():
            if b.name in joint.joints:
                total = total + self._at_parent(k, sums[k], abs(joint.place[1]) < EXACT_M)
        return ca.dot(joint.axis, total[3:] - cross(joint.place, total[:3]))

    @cached_property
    def _momenta(self) -> list[ca.SX]:
        """Linear momentum, and angular momentum about the base's origin, of a base whose origin
        rests.
        """
        parts = {}
        for k, b in self._counted.items():
            spin = self._spins[k]
            linear = self._velocities[k]
            angular = ca.DM(b.second) @ spin + cross(b.first, linear)
            parts[k] = ca.vertcat(b.mass * linear + cross(spin, b.first), angular)
        return self._in_world(self._gathered(parts)[0])

    @cached_property
    def com_from_base(self) -> ca.SX:
        """CoM seen from the base's origin (3,) [m], by first moments about the bodies' origins."""
        parts = {k: ca.SX(b.first) for k, b in self._counted.items()}
        for k in [*parts][:0:-1]:
            b = self._counted[k]
            (turn,) = self._turns[k]
            more = turn.out(parts[k]) + self.model.carried[k] * b.place
            if (across := self._doubled(k)) is not None:
                more = 2 * (more - along(across, more[across]))
            parts[b.parent] += more
        return self._in_world(parts[0])[0] / self.model.mass

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
        com = self.com_from_base
        total = -self.model.mass * _spread(com, com)
        for k, b in self._counted.items():
            turn, place = self._frames[k]
            first = turn @ b.first
            inertia = turn @ ca.DM(b.second) @ turn.T + b.mass * _spread(place, place)
            inertia += _spread(place, first) + _spread(first, place)
            beside = self._even and self.model.across[k] is None
            total += inertia * WITH_MIRROR_IMAGE if beside else inertia
        return total

    @property
    def rho(self) -> ca.SX:
        """The paper's pitch inertia, ``inertia[1, 1]`` [kg m^2]."""
        return self.inertia[1, 1]

    @property
    def rho_rate(self) -> ca.SX:
        """Its rate [kg m^2/s]."""
        q = ca.SX.sym("q", self.q.numel())
        v = ca.SX.sym("v", self.q.numel())
        rho = SpatialState(self.model, q, q, q, even=self._even).rho
        return ca.Function("rate", [q, v], [ca.jtimes(rho, q, v)])(self.q, self.v)

    # points of the bodies
    # ------------------------------------------------------------------------------------------
    def spin(self, body: int) -> ca.SX:
        """Angular velocity (3,) of a body [rad/s]."""
        return self.rotation(body) @ self._spins[body]

    def rotation(self, body: int) -> ca.SX:
        """Attitude (3, 3) of a body."""
        return self._frames[body][0]

    def point(self, body: int, local: np.ndarray) -> ca.SX:
        """Place of a point of a body (3,) [m], in the world; see :meth:`SpatialModel.local`."""
        turn, origin = self._frames[body]
        return self.q[:3] + origin + turn @ local

    def from_base(self, body: int, local: np.ndarray) -> ca.SX:
        """Place of a point of a body (3,) [m], seen from the base's origin in the base's axes."""
        place = ca.SX(local)
        while body:
            (turn,) = self._turns[body]
            place = turn.out(place) + self.model.bodies[body].place
            body = self.model.bodies[body].parent
        return place

    def own_rates(self, body: int, local: np.ndarray) -> tuple[ca.SX, ca.SX]:
        """Velocity of a point of a body, and angular velocity of the body (3,) each, in the body's
        axes [m/s, rad/s].
        """
        spin = self._spins[body]
        base = self.rotation(body).T @ self.v[:3]
        return base + self._velocities[body] + cross(spin, local), spin

    def own_accelerations(self, body: int, local: np.ndarray) -> tuple[ca.SX, ca.SX]:
        """Acceleration of a point of a body, and angular acceleration of the body (3,) each, in the
        body's axes [m/s^2, rad/s^2].
        """
        spin = self._spins[body]
        linear, angular = self._accelerations[body]
        fall = self.gravity * self.rotation(body)[2, :].T
        return linear - fall + cross(angular, local) + cross(spin, cross(spin, local)), angular

    def point_velocity(self, body: int, local: np.ndarray) -> ca.SX:
        """Velocity (3,) of a point of a body [m/s]."""
        return self.rotation(body) @ self.own_rates(body, local)[0]


def _spread(x: ca.SX, y: ca.SX) -> ca.SX:
    """(3, 3): x . y times the unit matrix, less the dyad y x'."""
    return ca.skew(x).T @ ca.skew(y)
