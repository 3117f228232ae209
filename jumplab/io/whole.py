"""Motions of the robot that jumps, as motions of the robot that was published: with every joint, held ones too."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, RobotError
from jumplab.io.motion import Motion, steady
from jumplab.robot import Robot
from jumplab.robot_import.config import entry, read_toml, table

ORDERS = ("depth-first", "breadth-first")  # of links and joints: MuJoCo's and Isaac Lab's
APART_M = 0.01  # [m] joints of both robots may be apart: twice what left and right are evened out by at most


@dataclass(frozen=True)
class Frames:
    """F states of a :class:`Whole` with J joints, depth-first: the maker's order."""

    t: np.ndarray  # (F,) from the motion's start [s]
    phase: np.ndarray  # (F,) "launch", "flight" or "landing"
    contact: np.ndarray  # (F, 2) whether left and right foot press on the ground
    place: np.ndarray  # (F, 3) of the root link in the world [m]
    turn: np.ndarray  # (F, 4) its attitude x y z w, free of jumps in sign
    velocity: np.ndarray  # (F, 3) of its origin, world axes [m/s]
    spin: np.ndarray  # (F, 3) its angular velocity in its own axes [rad/s]
    angles: np.ndarray  # (F, J) [rad, m]
    rates: np.ndarray  # (F, J) [rad/s, m/s]
    torques: np.ndarray  # (F, J) [N m, N]
    source: str  # "plan" or "simulation"
    q: np.ndarray  # (F, nq) and
    v: np.ndarray  # (F, nv) the same in Pinocchio's order

    @property
    def rotation(self) -> np.ndarray:
        """(F, 3, 3) attitude of the root link."""
        return np.array([pin.Quaternion(turn).toRotationMatrix() for turn in self.turn])

    @property
    def spin_world(self) -> np.ndarray:
        """(F, 3) angular velocity of the root link, world axes [rad/s]."""
        return np.einsum("fij,fj->fi", self.rotation, self.spin)


class Whole:
    """The published robot behind a :class:`Robot`, from its table [published]; the robot itself where there is none.

    ``urdf`` is its text, ``joints`` and ``links`` are names in depth-first order, the root link first; links that are
    fixed to another are part of that. Raises :class:`RobotError` if the table makes no robot.
    """

    def __init__(self, robot: Robot):
        config = read_toml(robot.config_text, "robot configuration")
        self.robot, told = robot, "published" in config
        get = partial(entry, config, "published")
        self.urdf = get("urdf", kind=str) if told else robot.urdf
        xyz, rpy = (get(key, count=3) if told else [0.0] * 3 for key in ("xyz_m", "rpy_rad"))
        self._offset = pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(xyz))
        try:
            self._below = _children(self.urdf)
            self.model = pin.buildModelFromXML(self.urdf, pin.JointModelFreeFlyer())
        except (ValueError, AttributeError, KeyError, ElementTree.ParseError) as e:
            raise RobotError(f"robot {robot.name}: [published] holds no URDF: {str(e).splitlines()[0]}") from e
        self.model.gravity.linear = np.array([0.0, 0.0, -robot.gravity])
        self.joints, self.links = self.ordered()
        held = table(table(config, "published"), "held")
        self._held = {name: entry(config, "published", "held", name) for name in held}
        self._trunk = self._frame(get("trunk", kind=str) if told else self.links[0])
        lacks = [name for name in (*robot.joint_names, *held) if name not in self.joints]
        if lacks:
            raise RobotError(f"robot {robot.name}: [published] lacks the joint {lacks[0]!r}")
        ids = [self.model.getJointId(name) for name in self.joints]
        self._q, self._v = (np.array(x)[ids] for x in (self.model.idx_qs, self.model.idx_vs))

    def _frame(self, link: str) -> int:
        if not self.model.existFrame(link, pin.FrameType.BODY):
            raise RobotError(f"robot {self.robot.name}: [published] lacks the link {link!r}")
        return self.model.getFrameId(link, pin.FrameType.BODY)

    def ordered(self, order: str = ORDERS[0]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of joints and of links in one of :data:`ORDERS`, siblings as the URDF lists them."""
        below, waiting = self._below, [(None, next(iter(self._below)), None)]
        joints, links = [], []
        while waiting:
            name, link, kind = waiting.pop(0)
            if kind != "fixed":
                joints.append(name)
                links.append(link)
            found = below[link]
            waiting = found + waiting if order == ORDERS[0] else waiting + found
        return tuple(joints[1:]), tuple(links)

    def frames(self, motion: Motion, fps: float) -> Frames:
        """A motion at ``fps`` frames a second and at its end, joints without a role held.

        What holds them are the torques of inverse dynamics, at the mean acceleration between the frames beside; what
        hangs on them touches nothing. Raises :class:`InputError` for rates that cannot be meant, and if the joints of
        the published robot are elsewhere than those of the robot that jumps, which was changed then.
        """
        x, model, data = motion.every(fps, end=True), self.model, self.model.createData()
        moving = [self.robot.joint_names.index(n) if n in self.robot.joint_names else -1 for n in self.joints]
        fixed = np.array([self._held.get(name, 0.0) for name in self.joints])
        move, count = np.array(moving) >= 0, len(x.t)
        angles, rates = (np.where(move, now[:, moving], rest) for now, rest in ((x.q[:, 7:], fixed), (x.v[:, 6:], 0.0)))
        q, v = np.tile(pin.neutral(model), (count, 1)), np.zeros((count, model.nv))
        q[:, self._q], v[:, self._v] = angles, rates
        for k in range(count):  # the root's state is that which gives the trunk its own
            pin.forwardKinematics(model, data, q[k], v[k])
            trunk = pin.updateFramePlacement(model, data, self._trunk)
            twist = self._offset.actInv(pin.Motion(x.v[k, :6])) - pin.getFrameVelocity(model, data, self._trunk)
            q[k, :7] = pin.SE3ToXYZQUAT(pin.XYZQUATToSE3(x.q[k, :7]) * self._offset * trunk.inverse())
            v[k, :6] = trunk.act(twist).vector
        q[:, 3:7] = steady(q[:, 3:7])
        self._check_places(q[0], x.q[0])
        change = np.gradient(v, x.t, axis=0) if count > 1 else np.zeros_like(v)
        holding = np.array([pin.rnea(model, data, *row) for row in zip(q, v, change, strict=True)])[:, self._v]
        torques = np.where(move, x.tau[:, moving], holding)
        velocity = np.array([pin.Quaternion(a[3:7]) * b[:3] for a, b in zip(q, v, strict=True)])
        base = (q[:, :3], q[:, 3:7], velocity, v[:, 3:6])
        return Frames(x.t - x.t[0], x.phase, x.contact, *base, angles, rates, torques, x.source, q, v)

    def _check_places(self, q: np.ndarray, own: np.ndarray) -> None:
        """The joints of the two robots are in the same places, but for what was evened out."""
        here, jumper = self.model.createData(), self.robot.model
        there = jumper.createData()
        pin.forwardKinematics(self.model, here, q)
        pin.forwardKinematics(jumper, there, own)
        for name in self.robot.joint_names:
            gap = here.oMi[self.model.getJointId(name)].translation - there.oMi[jumper.getJointId(name)].translation
            if np.linalg.norm(gap) > APART_M:
                far = f"is {1e3 * np.linalg.norm(gap):.0f} mm off the published robot's, at most {1e3 * APART_M:.0f}"
                raise InputError(f"robot {self.robot.name}: joint {name!r} {far}; import the changed robot's own URDF")

    def bodies(self, x: Frames, links: tuple[str, ...], *, at_com: bool) -> dict[str, np.ndarray]:
        """Places (F, B, 3) [m], attitudes (F, B, 4) w x y z, velocities (F, B, 3) and angular velocities of links.

        All in world axes; velocities are of the links' origins, or of their centres of mass, ``at_com``.
        """
        model, data, ids = self.model, self.model.createData(), [self._frame(name) for name in links]
        place, turn, speed, spin = (np.empty((len(x.t), len(ids), k)) for k in (3, 4, 3, 3))
        levers = [model.inertias[model.frames[i].parentJoint].lever * at_com for i in ids]
        for k, (q, v) in enumerate(zip(x.q, x.v, strict=True)):
            pin.forwardKinematics(model, data, q, v)
            pin.updateFramePlacements(model, data)
            for i, (frame, lever) in enumerate(zip(ids, levers, strict=True)):
                pose = data.oMf[frame]
                twist = pin.getFrameVelocity(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
                place[k, i], spin[k, i] = pose.translation, twist.angular
                turn[k, i] = pin.Quaternion(pose.rotation).coeffs()[[3, 0, 1, 2]]
                speed[k, i] = twist.linear + np.cross(twist.angular, pose.rotation @ lever)
        return {
            "body_pos_w": place,
            "body_quat_w": steady(turn),
            "body_lin_vel_w": speed,
            "body_ang_vel_w": spin,
        }


def _children(urdf: str) -> dict[str, list[tuple[str, str, str]]]:
    """Link -> (joint, link below, kind of joint) in the URDF's order; the root link first."""
    tree = ElementTree.fromstring(urdf)
    out = {link.get("name"): [] for link in tree.iterfind("link")}
    for joint in tree.iterfind("joint"):
        child = joint.find("child").get("link")
        out[joint.find("parent").get("link")].append((joint.get("name"), child, joint.get("type")))
    children = {child for found in out.values() for _, child, _ in found}
    return dict(sorted(out.items(), key=lambda item: item[0] in children))
