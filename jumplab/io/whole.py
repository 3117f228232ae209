"""Motions of the robot that jumps as those of the published one: held joints too."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError
from jumplab.io.motion import Motion, steady
from jumplab.robot import Robot
from jumplab.robot.contact import WORLD, Anchor, on_feet
from jumplab.robot.files import entry, numbers, read_toml

ORDERS = ("depth-first", "breadth-first")  # of links and joints: MuJoCo's and Isaac Lab's
# [m] joints of both robots may be apart: twice what left and right are evened out by at most
APART_M = 0.01
# of the surface on which a motion ends: least height over where it begins; how far it reaches
# before the soles at most, and beyond them
RAISED_M = 0.02
RIM_M = 0.05
BEYOND_M = 1.0


class Whole:
    """The published robot behind a :class:`Robot`, from its table [published]; the robot itself
    where there is none.

    ``urdf`` is its text, ``joints`` and ``links`` are names in depth-first order, its maker's, the
    root link first; links that are fixed to another are part of that. Raises :class:`RobotError` if
    the table makes no robot.
    """

    def __init__(self, robot: Robot):
        config = read_toml(robot.config_text, "robot configuration")
        self.robot = robot
        self.urdf = entry(config, "published", "urdf", kind=str, default=robot.urdf)
        xyz, rpy = (
            np.array(entry(config, "published", key, count=3, default=[0.0] * 3))
            for key in ("xyz_m", "rpy_rad")
        )
        self._offset = pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)
        try:
            self.joints, self.links = ordered(self.urdf)
            self.model = pin.buildModelFromXML(self.urdf, pin.JointModelFreeFlyer())
        except (ValueError, AttributeError, KeyError, ElementTree.ParseError) as e:
            raise robot.error(f"[published] holds no URDF: {str(e).splitlines()[0]}") from e
        self.model.gravity.linear = np.array([0.0, 0.0, -robot.gravity])
        self._data = self.model.createData()
        self._held = numbers(config, "published", "held")
        self._trunk = self._frame(
            entry(config, "published", "trunk", kind=str, default=self.links[0])
        )
        for name in (*robot.joint_names, *self._held):
            if name not in self.joints:
                raise robot.error(f"[published] lacks the joint {name!r}")
        self.order = self._columns(self.joints)
        self._back = np.argsort(self.order)
        self._jumping = self._columns(robot.joint_names)

    def _columns(self, names: Iterable[str]) -> np.ndarray:
        """Columns of joints in Pinocchio's order, counted behind the base."""
        columns = [self.model.idx_vs[self.model.getJointId(name)] - 6 for name in names]
        return np.array(columns, int)

    def _frame(self, link: str) -> int:
        if not self.model.existFrame(link, pin.FrameType.BODY):
            raise self.robot.error(f"[published] lacks the link {link!r}")
        return self.model.getFrameId(link, pin.FrameType.BODY)

    def feet(self, point: np.ndarray) -> list[Anchor]:
        """A ``point`` (3,) of the foot links' frames [m], of the left and of the right foot."""
        names = self.robot.model.names
        feet = on_feet(self.robot, point)
        return [replace(foot, joint=self.model.getJointId(names[foot.joint])) for foot in feet]

    def states(self, x: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Configurations (F, nq) and velocities (F, nv) of :meth:`frames` in Pinocchio's order."""
        return _sorted(x.q, self._back), _sorted(x.v, self._back)

    def com(self, q: np.ndarray) -> np.ndarray:
        """CoM (F, 3) [m] at configurations (F, nq) of :meth:`frames`."""
        rows = _sorted(q, self._back)
        return np.array([pin.centerOfMass(self.model, self._data, row).copy() for row in rows])

    def frames(self, motion: Motion, fps: float) -> Motion:
        """A motion at ``fps`` [1/s] and at its end, as one of the published robot from time 0 [s],
        its joints depth-first, those without a role held.

        They are held by the torques of inverse dynamics, at the mean acceleration between the
        frames beside; what hangs on them touches nothing. Raises :class:`InputError` for rates that
        cannot be meant, and if the joints of the published robot are elsewhere than those of the
        robot that jumps, which was changed then.
        """
        x = motion.every(fps, end=True)
        model = self.model
        data = self._data
        q = np.tile(pin.neutral(model), (len(x.t), 1))
        v = np.zeros((len(x.t), model.nv))
        q[:, 7 + self._columns(self._held)] = [*self._held.values()]
        q[:, 7 + self._jumping] = x.q[:, 7:]
        v[:, 6 + self._jumping] = x.v[:, 6:]
        for qk, vk, base, base_twist in zip(q, v, x.q[:, :7], x.v[:, :6], strict=True):
            # the root's state is that which gives the trunk its own
            pin.forwardKinematics(model, data, qk, vk)
            trunk = pin.updateFramePlacement(model, data, self._trunk)
            twist = self._offset.actInv(pin.Motion(base_twist))
            twist -= pin.getFrameVelocity(model, data, self._trunk)
            qk[:7] = pin.SE3ToXYZQUAT(pin.XYZQUATToSE3(base) * self._offset * trunk.inverse())
            vk[:6] = trunk.act(twist).vector
        q[:, 3:7] = steady(q[:, 3:7])
        self._check_places(q[0], x.q[0])
        change = np.gradient(v, x.t, axis=0) if len(x.t) > 1 else np.zeros_like(v)
        tau = np.array([pin.rnea(model, data, *row)[6:] for row in zip(q, v, change, strict=True)])
        tau[:, self._jumping] = x.tau
        states = (_sorted(rows, self.order) for rows in (q, v, tau))
        return Motion(x.t - x.t[0], *states, x.phase, x.source, x.wrench, x.contact)

    def soles(self, q: np.ndarray) -> np.ndarray:
        """Corners (2, 4, 3) of the soles [m] at a configuration (nq,) of :meth:`frames`."""
        pin.forwardKinematics(self.model, self._data, _sorted(q[None], self._back)[0])
        places = [foot.place(self._data) for foot in self.feet(np.zeros(3))]
        return np.array([[place.act(x) for x in self.robot.foot.corners] for place in places])

    def block(self, x: Motion) -> tuple[np.ndarray, np.ndarray, float] | None:
        """Half sizes (3,) and centre (3,) [m], and heading [rad], of a box on the lower of the two
        surfaces on which a motion of :meth:`frames` begins and ends, as high as the other one;
        None if they are level, or the motion does not end on flat soles.
        """
        ends = np.array([self.soles(x.q[k]).reshape(-1, 3) for k in (0, -1)])
        way = (ends[1] - ends[0]).mean(axis=0)
        if abs(way[2]) < RAISED_M or np.ptp(ends[1, :, 2]) > RAISED_M:
            return None
        heading = float(np.arctan2(way[1], way[0]))
        axes = pin.rpy.rpyToMatrix(0.0, 0.0, heading)
        (begin, end), across, _ = np.moveaxis(ends @ axes, -1, 0)
        rim = min(RIM_M, max(end.min() - begin.max(), 0.0) / 2)
        edges = [end.min() - rim, end.max() + BEYOND_M]
        if way[2] < 0:
            edges = [begin.min() - BEYOND_M, begin.max() + rim]
        half = np.array([np.ptp(edges) / 2, BEYOND_M, abs(way[2]) / 2])
        return half, axes @ [np.mean(edges), across.mean(), way[2] / 2], heading

    def own(self, q: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
        """The inverse of :meth:`frames`: configurations (F, nq) of the robot that jumps, from those
        of the published one (F, 7 + J), joints depth-first; and how far joints that it holds move
        off where they are held [rad].
        """
        state = _sorted(q, self._back)
        places = []
        for row in state:
            pin.forwardKinematics(self.model, self._data, row)
            trunk = pin.updateFramePlacement(self.model, self._data, self._trunk)
            places.append(pin.SE3ToXYZQUAT(trunk * self._offset.inverse()))
        moved = {
            name: float(np.abs(q[:, 7 + k] - self._held.get(name, 0.0)).max())
            for k, name in enumerate(self.joints)
            if name not in self.robot.joint_names
        }
        return np.hstack([places, state[:, 7 + self._jumping]]), moved

    def _check_places(self, q: np.ndarray, q_robot: np.ndarray) -> None:
        """The joints of the two robots are in the same places, but for what was evened out."""
        names = self.robot.joint_names
        both = []
        for model, state in ((self.model, q), (self.robot.model, q_robot)):
            data = model.createData()
            pin.forwardKinematics(model, data, state)
            both.append([data.oMi[model.getJointId(name)].translation for name in names])
        gaps = np.linalg.norm(np.subtract(*both), axis=1)
        if gaps.max() > APART_M:
            raise InputError(
                f"robot {self.robot.name}: joint {names[gaps.argmax()]!r} lies "
                f"{1e3 * gaps.max():.0f} mm from its place in the published robot, at most "
                f"{1e3 * APART_M:.0f}; import the changed robot's own URDF"
            )

    def bodies(self, x: Motion, links: tuple[str, ...], *, at_com: bool) -> dict[str, np.ndarray]:
        """Places (F, B, 3) [m], attitudes (F, B, 4) w x y z, velocities (F, B, 3) and angular
        velocities of links.

        All in world axes; velocities are of the links' origins, or of their centres of mass,
        ``at_com``.
        """
        model = self.model
        data = self._data
        frames = [self._frame(name) for name in links]
        levers = [model.inertias[model.frames[i].parentJoint].lever * at_com for i in frames]
        rows = []
        for q, v in zip(*self.states(x), strict=True):
            pin.forwardKinematics(model, data, q, v)
            pin.updateFramePlacements(model, data)
            for frame, lever in zip(frames, levers, strict=True):
                pose = data.oMf[frame]
                twist = pin.getFrameVelocity(model, data, frame, WORLD)
                speed = twist.linear + np.cross(twist.angular, pose.rotation @ lever)
                rows.append([*pin.SE3ToXYZQUAT(pose), *speed, *twist.angular])
        table = np.reshape(rows, (len(x.t), len(links), 13))
        place, turn, speed, spin = np.split(table, [3, 7, 10], axis=-1)
        return {
            "body_pos_w": place,
            "body_quat_w": steady(np.roll(turn, 1, axis=-1)),
            "body_lin_vel_w": speed,
            "body_ang_vel_w": spin,
        }


def _sorted(rows: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Rows (F, n) whose last columns, the joints, are in another ``order`` (J,)."""
    base, joints = np.split(rows, [-len(order)], axis=1)
    return np.hstack([base, joints[:, order]])


def ordered(urdf: str, order: str = ORDERS[0]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of joints and links of a URDF in one of :data:`ORDERS`, siblings as it lists them."""
    tree = ElementTree.fromstring(urdf)
    below = {link.get("name"): [] for link in tree.iterfind("link")}
    roots = list(below)
    for joint in tree.iterfind("joint"):
        parent, child = (joint.find(end).get("link") for end in ("parent", "child"))
        below[parent].append((joint.get("name"), child, joint.get("type")))
        roots.remove(child)
    waiting = [("", roots[0], "root")]
    moving = []
    while waiting:
        name, link, kind = waiting.pop(0)
        if kind != "fixed":
            moving.append((name, link))
        waiting = below[link] + waiting if order == ORDERS[0] else waiting + below[link]
    joints, links = zip(*moving, strict=True)
    return joints[1:], links


def axes_of(urdf: str, names: Sequence[str]) -> np.ndarray:
    """Axes (J, 3) of the joints with these names, in their own frames."""
    axes = {
        joint.get("name"): getattr(joint.find("axis"), "attrib", {}).get("xyz", "1 0 0")
        for joint in ElementTree.fromstring(urdf).iterfind("joint")
    }
    ways = np.array([axes[name].split() for name in names], float)
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)
