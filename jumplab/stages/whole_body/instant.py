"""The robot at a point of the whole-body program: what terms see by name; SI units."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from jumplab.errors import InputError, quoted
from jumplab.models.names import ByJoint
from jumplab.models.spatial import SpatialModel, SpatialState, cross
from jumplab.ocp.problem import Point
from jumplab.stages.whole_body.body import Spot
from jumplab.stages.whole_body.contacts import HOLD, SIDES
from jumplab.stages.whole_body.coordinates import BASE, PITCH
from jumplab.stages.whole_body.mode import Mode


@dataclass(frozen=True)
class Instant:
    """A point of the whole-body program: ``p.joints.left_knee`` and so on, see :class:`Point`.

    Vectors (3,) are in the axes of the start: x forward, y to the left, z up. Places count from the
    middle between the soles in their first place; angles are positive about +y. In a jump straight
    ahead of a robot whose halves are alike left and right move alike, and what points to the side
    is zero.
    """

    _mode: Mode
    _point: Point

    @cached_property
    def tree(self) -> SpatialState:
        """All links; ``tree.q`` is the chart (6 + joints,)."""
        p = self._point
        motion = (self._mode.free.chart(x, level) for level, x in enumerate((p.q, p.v, p.a)))
        return SpatialState(self._mode.model, *motion, p.p.gravity, self._mode.free.even)

    # what moves
    # ------------------------------------------------------------------------------------------
    @property
    def joints(self) -> ByJoint:
        """Joint angles [rad]: ``.left_knee`` (1,), ``.knee`` of left and right (2,)."""
        return ByJoint(self._mode.robot, self.tree.q[BASE:])

    @property
    def joint_rates(self) -> ByJoint:
        """Joint rates [rad/s]."""
        return ByJoint(self._mode.robot, self.tree.v[BASE:])

    @property
    def attitude(self) -> ca.SX:
        """Yaw, roll and pitch of the base (3,), turns included [rad]."""
        return self.tree.q[3:BASE]

    @property
    def posture(self) -> ca.SX:
        """Pitch of the base, forward positive, turns included [rad]."""
        return self.tree.q[PITCH]

    @property
    def com(self) -> ca.SX:
        """Centre of mass (3,) [m]."""
        return self.tree.com

    @property
    def com_velocity(self) -> ca.SX:
        """Its velocity (3,) [m/s]."""
        return self.tree.com_velocity

    @property
    def L(self) -> ca.SX:
        """Angular momentum about the CoM (3,) [kg m^2/s]."""
        return self.tree.angular_momentum

    @property
    def inertia(self) -> ca.SX:
        """Inertia of all bodies as one, about the CoM (3, 3) [kg m^2]."""
        return self.tree.inertia

    @property
    def rho(self) -> ca.SX:
        """The paper's pitch inertia about the CoM, ``p.inertia[1, 1]`` [kg m^2]."""
        return self.tree.rho

    @property
    def rho_rate(self) -> ca.SX:
        """Its rate [kg m^2/s]."""
        return self.tree.rho_rate

    @property
    def rates(self) -> ca.SX:
        """Rates of the free joints (.,) [rad/s]."""
        mode = self._mode
        return self._point.v[mode.nv - len(mode.free.joints) : mode.nv]

    # places
    # ------------------------------------------------------------------------------------------
    def point(self, name: str) -> ca.SX:
        """Place (3,) [m] of "left_toe", "left_heel", "left_sole", "left_hand", the right ones, or a
        joint's origin.

        Raises :class:`InputError` with the names that exist.
        """
        return self.tree.point(*self._spot(name))

    def point_velocity(self, name: str) -> ca.SX:
        """Velocity (3,) [m/s] of the same points."""
        return self.tree.point_velocity(*self._spot(name))

    def _spot(self, name: str) -> Spot:
        body = self._mode.body
        known = {joint: (1 + k, np.zeros(3)) for k, joint in enumerate(body.joint_names)}
        for i, (side, foot) in enumerate(zip(SIDES, body.feet, strict=True)):
            heel = body.corners[i, 2:].mean(axis=0)
            known |= {f"{side}_toe": (foot, body.tips[i]), f"{side}_heel": (foot, heel)}
            known[f"{side}_sole"] = foot, body.middles[i]
            for column, _ in body.shoulders[i : i + 1]:
                arm = 1 + column - BASE
                hands = [x for x in body.limb_points[2:] if arm in body.chain(x[0])]
                known |= {f"{side}_hand": x for x in hands[:1]}
        if name not in known:
            raise InputError(
                f"the robot has no point {quoted(name)}; it has {', '.join(sorted(known))}"
            )
        return known[name]

    @property
    def soles(self) -> list[ca.SX]:
        """Middles (3,) of the soles that have rows of their own [m]."""
        return [self.point(f"{SIDES[k]}_sole") for k in self._mode.free.sides]

    @property
    def sole_middle(self) -> ca.SX:
        """Middle between both soles (3,) [m]; of an even motion, that of the left one."""
        return sum(self.soles) / len(self.soles)

    def sole_axes(self, side: int) -> ca.SX:
        """Attitude (3, 3) of a foot."""
        return self.tree.rotation(self._mode.body.feet[side]) @ ca.DM(self._mode.body.axes[side])

    def pitch(self, side: int, x: ca.SX) -> ca.SX:
        """Pitch of a foot that carries [rad], heel up positive, from a phase's coordinates; or its
        rate of theirs.
        """
        mode = self._mode
        return x[mode.nv + mode.raised.index(side)] if side in mode.raised else ca.SX(0)

    def foothold(self, side: int) -> tuple[ca.SX, ca.SX]:
        """Place (3,) of the middle of the toe edge of a foot that carries [m], and its heading
        [rad].
        """
        x, y, z, yaw = (getattr(self._point.c, f"{SIDES[side]}_{k}") for k in HOLD)
        return ca.vertcat(x, y, z), yaw

    def flight(self, kind: str) -> ca.SX:
        """A constant (3,) of the flight: "com", "vel" or "L"; what cannot change is zero."""
        return ca.vertcat(*(getattr(self._point.c, f"{kind}_{x}", ca.SX(0)) for x in "xyz"))

    def turned(self, x: ca.SX | np.ndarray, way: int = 1) -> ca.SX:
        """A vector (3,) turned by the asked yaw, or back."""
        return _about_z(way * self._point.p.yaw, x)

    def ground(self, x: ca.SX, nearer_m: float = 0.0) -> ca.SX:
        """Height of the surface below a point, its upper part ``nearer_m`` than it is [m]."""
        platform = self._point.p.platform
        return platform * self.over_edge(x, nearer_m * ca.sign(platform))

    def over_edge(self, x: ca.SX, nearer_m: float | ca.SX) -> ca.SX:
        """1 for a point (3,) beyond the edge where the ground steps up or down, 0 before it, smooth
        between.
        """
        p = self._point.p
        beyond = ca.dot(p.along, x[:2]) - p.edge + nearer_m
        return (1 + ca.tanh(beyond / self._mode.limits.edge_smoothing_m)) / 2

    # forces
    # ------------------------------------------------------------------------------------------
    @property
    def motor_torques(self) -> ca.SX:
        """Torques (.,) of the free joints' motors less their dry friction, whose kink at rest no
        solver likes [N m].

        The limits are lowered by that friction instead: joints that move have it, others need less.
        """
        return self._point.z[self._mode.n_forces :]

    @property
    def joint_torques(self) -> ca.SX:
        """Those of all joints (joints,); of joints that are held none [N m]."""
        free = self._mode.free
        base = ca.SX.zeros(free.size - len(free.joints))
        return free.chart(ca.vertcat(base, self.motor_torques), 1)[BASE:]

    @property
    def torques(self) -> ByJoint:
        """Joint torques [N m]."""
        return ByJoint(self._mode.robot, self.joint_torques)

    def pushes(self, side: int) -> list[tuple[np.ndarray, ca.SX]]:
        """Points of one sole (3,) [m] and the forces on it there (3,) [N], in the axes of its
        foothold.
        """
        mode = self._mode
        count = len(mode.edges)
        first = sum(count * len(x) for s, x in mode.points.items() if s < side)
        along = ca.vertsplit(self._point.z[first : first + count * len(mode.points[side])], count)
        edges = ca.sparsify(ca.DM(mode.edges.T))
        return [(x, edges @ f) for x, f in zip(mode.points[side], along, strict=True)]

    def pressed(self, side: int) -> tuple[ca.SX, ca.SX]:
        """Their sum (3,) [N], and their moment about the middle of the toe edge (3,) [N m]."""
        pushes = self.pushes(side)
        return sum(f for _, f in pushes), sum(cross(ca.DM(x), f) for x, f in pushes)

    def sole_wrench(self, side: int) -> tuple[ca.SX, ca.SX]:
        """Force and moment about the origin of the foot's body (3,) each, in its axes [N, N m]."""
        body = self._mode.body
        phi = self.pitch(side, self._point.q)
        c = ca.cos(phi)
        s = ca.sin(phi)
        turn = ca.DM(body.axes[side])
        # a foot turns about its toe edge, where all points are if it is pitched
        force, moment = (
            turn @ ca.vertcat(c * x[0] - s * x[2], x[1], s * x[0] + c * x[2])
            for x in self.pressed(side)
        )
        return force, moment + cross(ca.DM(body.tips[side]), force)

    @property
    def feet_forces(self) -> list[ca.SX]:
        """Force of the ground on the left and on the right foot (3,) in the axes of its foothold
        [N]; zero in the air.
        """
        out = [ca.SX.zeros(3), ca.SX.zeros(3)]
        for side in self._mode.sides:
            out[side] = self.pressed(side)[0]
        if self._mode.free.even:
            out[1] = ca.DM([1.0, -1.0, 1.0]) * out[0]
        return out

    @property
    def wrench(self) -> ca.SX:
        """The ground's force on the robot, and its moment about the origin (6,) [N, N m]; zero in
        flight.
        """
        total = ca.SX.zeros(6)
        for side in self._mode.sides:
            place, yaw = self.foothold(side)
            force, moment = (_about_z(yaw, x) for x in self.pressed(side))
            total += ca.vertcat(force, moment + cross(place, force))
        # in even motions the right foot is the left one's mirror image
        return ca.DM([2, 0, 2, 0, 2, 0]) * total if self._mode.free.even else total

    @cached_property
    def needed(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """(force, moment about the base, joint torques) that the motion needs besides the ground's
        forces (3,), (3,), (joints,) [N, N m]; the motors' dry friction is left out.
        """
        mode = self._mode
        wrenches = {mode.body.feet[side]: self.sole_wrench(side) for side in mode.sides}
        force, moment, torques = self.tree.dynamics(wrenches)
        return force, moment, torques + ca.DM(mode.body.motors.damping) * self.tree.v[BASE:]

    def moved(self, model: SpatialModel) -> SpatialState:
        """Another robot, whose tree has the same joints (n,), in the same motion."""
        return SpatialState(model, self.tree.q, self.tree.v, self.tree.v, self._point.p.gravity)


def _about_z(yaw: ca.SX, x: ca.SX | np.ndarray) -> ca.SX:
    """A vector (3,) turned about the vertical."""
    c = ca.cos(yaw)
    s = ca.sin(yaw)
    return ca.vertcat(c * x[0] - s * x[1], s * x[0] + c * x[1], x[2])
