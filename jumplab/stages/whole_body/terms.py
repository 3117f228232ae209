"""The named costs and constraints of the whole-body program, as functions of one instant; nothing here solves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from types import SimpleNamespace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import pinocchio as pin

from jumplab.models.planar import PlanarState
from jumplab.models.spatial import SpatialModel, SpatialState, cross
from jumplab.ocp.problem import Point, Term
from jumplab.robot import Robot
from jumplab.robot.reach import rod_of
from jumplab.robot.reduction import even_masses, mirror
from jumplab.robot.stance import knees, leg_length, stance_angles, stance_configuration
from jumplab.robot_import.config import ROLES
from jumplab.stages.whole_body.contacts import SIDES
from jumplab.stages.whole_body.coordinates import BASE, PITCH, Coordinates, whole
from jumplab.stages.whole_body.legs import Legs
from jumplab.stages.whole_body.settings import LATE_SHARE, RESERVE_SHARE, Limits, Weights
from jumplab.stages.whole_body.shapes import Box, boxes, candidates
from jumplab.task import GRAVITY

if TYPE_CHECKING:
    from jumplab.stages.whole_body.apart import Apart

EDGES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])  # directions of the friction pyramid's edges
MOMENT_ARM_M = 0.2  # nominal size of moments over that of forces
SPIN_SCALE, ACCELERATION_SCALE = 10.0, 10.0  # [kg m^2/s], [m/s^2, rad/s^2] for conditioning
PLACE_SCALE = 0.1  # [m]
SOLE_SHARES = 0.0, 0.25, 0.5, 0.75, 1.0  # of the way from toes to heel
TORSION_SLACK_M = 1e-4  # where a foot hardly carries both sides of the row vanish


POSITIVE = 0.0, np.inf
SHANK_SHARES = -0.8, -0.4, 0.0, 0.4, 0.8  # of half the length of a shank's box, where a platform's edge may meet it


def cost(name: str, equation: str, unit: str, of: Callable, weight: float, at: str = "node") -> Term:
    """A cost on what ``of`` makes of a :class:`Point`."""
    return Term(name, equation, unit, at, of, weight=weight)


def row(
    name: str, equation: str, unit: str, of: Callable, lower: object = 0.0, upper: object = 0.0, at: str = "node", **how
) -> Term:
    """A constraint on it: an equality, or from ``lower`` to ``upper``; ``how`` as in :class:`Term`."""
    return Term(name, equation, unit, at, of, None, lower, upper, **how)


class Body:
    """A robot as the program sees it: its tree, soles, knees, motors and shapes; the same in every phase.

    The world's origin lies in the middle of the soles in their first place, x forward, z up.

    Attributes
    ----------
    model : the tree.  mg : weight on Earth [N].  stance : chart (6 + joints,) in which the robot waits.
    feet : bodies of the left and the right foot.  tips, middles : middle of the toe edge and of the sole, in them.
    corners : (2, 4, 3) of the soles, in them: toe left, toe right, heel left, heel right.
    places : (2, 3) middles of the toe edges in the stance [m].
    legs : columns of the chart that follow from a foot that stands: six joints of each leg, or all it has.
    ankle_m : height of the feet's joints in the stance [m].
    motors : key of :attr:`.Robot.actuators` -> (joints,).
    """

    def __init__(self, robot: Robot):
        self.robot, self.model = robot, SpatialModel(robot.model)
        self.mg, foot, tree = self.model.mass * GRAVITY, robot.foot, self.model.model
        frames = [tree.frames[tree.getFrameId(name)] for name in foot.frames]
        self.feet = [f.parentJoint - 1 for f in frames]
        self.axes = [self.model.bodies[k].own.T @ f.placement.rotation for k, f in zip(self.feet, frames, strict=True)]

        def on_foot(x):
            return [self.model.local(f.parentJoint, f.placement.act(np.array(x))) for f in frames]

        w, z = foot.half_width, foot.sole_z
        self.tips, self.middles = on_foot([foot.toe, 0.0, z]), on_foot(foot.center)
        corners = [[x, y, z] for x in (foot.toe, foot.heel) for y in (w, -w)]
        self.corners = np.array([on_foot(x) for x in corners]).transpose(1, 0, 2)
        self.half_m = (foot.toe - foot.heel) / 2
        configuration = stance_configuration(robot)
        self.stance = self.model.of_pinocchio(configuration[None])[0]
        self.knees = knees(robot)
        data = tree.createData()
        pin.framesForwardKinematics(tree, data, configuration)
        ids = [tree.getFrameId(name) for name in foot.frames]
        self.places = np.array([data.oMf[i].act(foot.tip) for i in ids])
        rows = [robot.actuators[name] for name in self.joint_names]
        self.motors = {key: np.array([r[key] for r in rows]) for key in rows[0]}
        self.legs = [self._leg(side, configuration) for side in (0, 1)]
        self.ankle_m = float(data.oMi[self.feet[0] + 1].translation[2])

    @cached_property
    def leg_m(self) -> float:
        """Length l of the legs in the stance [m]."""
        return leg_length(self.robot)

    @property
    def spin_size(self) -> float:
        """Natural size of angular momenta m l sqrt(g l) [kg m^2/s]."""
        return float(self.model.mass * self.leg_m * np.sqrt(GRAVITY * self.leg_m))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.model.names[BASE:]

    def chain(self, body: int) -> list[int]:
        """Bodies from one up to the base, which is left out."""
        found = []
        while body:
            found.append(body)
            body = self.model.bodies[body].parent
        return found

    def _leg(self, side: int, q: np.ndarray) -> list[int]:
        """Columns of the chart that follow from a foot that stands; of longer legs the six that move it best."""
        from scipy.linalg import qr  # slow to import

        tree, data = self.model.model, self.model.model.createData()
        shared = set(self.chain(self.feet[1 - side]))  # a waist above both hips, where the base is the trunk
        columns = [BASE - 1 + j for j in self.chain(self.feet[side]) if j not in shared]
        pin.computeJointJacobians(tree, data, q)
        slope = pin.getJointJacobian(tree, data, self.feet[side] + 1, pin.ReferenceFrame.LOCAL)[:, columns]
        best = qr(slope, pivoting=True)[2][:6]
        return sorted(columns[k] for k in best)

    @cached_property
    def shoulders(self) -> list[tuple[int, float]]:
        """Columns of the chart of the joints that swing the arms, with the sign that makes backward positive."""
        names = self.robot.joints.get("shoulder_pitch", ())
        signs = self.robot.sagittal.signs[3] if names else ()
        return [(BASE + self.joint_names.index(n), float(s)) for n, s in zip(names, signs, strict=True)]

    @property
    def short(self) -> bool:
        """Whether a leg has fewer than six joints: both feet on the ground then hold yaw and roll of the base."""
        return min(len(x) for x in self.legs) < 6

    @cached_property
    def mirrored(self) -> bool:
        """Whether left and right are built alike."""
        return even_masses(self.model.model, self.model.pairs)

    @cached_property
    def _boxes(self) -> tuple[list[Box], pin.GeometryModel]:
        return boxes(self.robot, self.model)

    @property
    def shapes(self) -> list[Box]:
        """Boxes of the links."""
        return self._boxes[0]

    @property
    def geometry(self) -> pin.GeometryModel:
        """Their collision shapes, in the same order."""
        return self._boxes[1]

    @cached_property
    def candidates(self) -> list[tuple[int, int]]:
        """Pairs of links that are no neighbours, as indices of :attr:`shapes`."""
        return candidates(self.robot, self.model, self.shapes)

    @cached_property
    def shank_m(self) -> float:
        """Half the thickness of the shank [m]: with a level shank its face is that much lower than the knee."""
        halves = [np.sort(x.half)[0] for x in self.shapes if x.body in {1 + k for k, _, _ in self.knees}]
        return float(max(halves, default=0.0))

    @cached_property
    def shank_points(self) -> list[tuple[int, np.ndarray]]:
        """Places along the middle of the boxes of the shanks: (body, place in it)."""
        shanks = [x for k, _, _ in self.knees for x in self.shapes if x.body == 1 + k]
        along = [(x, x.axes[:, np.argmax(x.half)] * x.half.max()) for x in shanks]
        return [(x.body, x.centre + share * way) for x, way in along for share in SHANK_SHARES]

    @cached_property
    def limb_points(self) -> list[tuple[int, np.ndarray]]:
        """Knees, and the far ends of the bodies that end a limb but are no feet: (body, place in it)."""
        points = [(1 + k, np.zeros(3)) for k, _, _ in self.knees]
        carrying = {b.parent for b in self.model.bodies} | set(self.feet)
        for box in self.shapes:
            if box.body not in carrying:
                along = box.axes[:, np.argmax(box.half)] * box.half.max()
                points.append((box.body, box.centre + along * (1.0 if along @ box.centre > 0 else -1.0)))
        return points


class WholeBodyTerms:
    """Terms of one mode of contact, and the expressions that they share.

    Attributes
    ----------
    modes : side -> "flat" or "toe", of the feet that carry; none in flight.
    coordinates : of a phase in this mode: the chart, then the pitch of each foot on its toes.
    states : force along each edge of each sole point's friction pyramid in the axes of the foothold, then torques.
    sides : those of the modes that have rows and forces of their own; in an even motion the left foot stands for both.
    integrated : coordinates that do not follow from feet in place or from flight.
    """

    def __init__(
        self,
        body: Body,
        limits: Limits,
        weights: Weights,
        modes: Mapping[int, str],
        free: Coordinates | None = None,
    ):
        self.body, self.limits, self.weights, self.modes = body, limits, weights, dict(modes)
        self.robot, self.model, self.mg, self.free = body.robot, body.model, body.mg, free or whole(body)
        self.flying, self.nv = not self.modes, self.free.size
        self.sides = [side for side in self.modes if side in self.free.sides]
        self.raised = [side for side in self.sides if self.modes[side] == "toe"]
        self.coordinates = (*self.free.free_names, *(f"pitch of {SIDES[side]} foot" for side in self.raised))
        self.edges = EDGES[:2] if self.free.plane else EDGES
        self.points = {side: self._sole_points(self.modes[side]) for side in self.sides}
        names = [
            f"force {k} of {SIDES[side]} foot"
            for side in self.sides
            for k in range(len(self.edges) * len(self.points[side]))
        ]
        self.n_forces = len(names)
        self.states = (*names, *(f"torque of {body.joint_names[k]}" for k in self.free.joints))
        follows = set(range(BASE)) if self.flying else {k for side in self.sides for k in body.legs[side]}
        if self.short and len(self.modes) == 2:
            follows |= {1, 3, 4}
        gone = {self.model.names[k] for k in follows}
        self.integrated = tuple(x for x in self.coordinates if x not in gone)

    @property
    def short(self) -> bool:
        """Whether both feet on the ground hold yaw and roll of a base that else could have them."""
        return self.body.short and not self.free.even

    @property
    def kind(self) -> str:
        """The mode in a word."""
        letters = {0: "L", 1: "R"}
        return "".join(letters[s] if m == "flat" else letters[s].lower() for s, m in self.modes.items()) or "-"

    @cached_property
    def legs(self) -> Legs:
        """The legs that follow from the feet that carry."""
        return Legs(self)

    def _sole_points(self, mode: str) -> np.ndarray:
        """Points of the sole where forces act (k, 3), seen from the middle of the toe edge [m]; the toes' first."""
        lim, foot = self.limits, self.robot.foot
        wide = foot.half_width - min(lim.side_margin_m, 0.4 * foot.half_width)
        length = 2 * self.body.half_m - min(lim.cop_margin_m, 0.4 * self.body.half_m)
        back = (0.0, -length) if mode == "flat" else (0.0,)
        across = (0.0,) if self.free.plane else (wide, -wide)
        return np.array([[x, y, 0.0] for x in back for y in across])

    # model on a point -------------------------------------------------------------------------------------------
    def chart(self, x: ca.SX, level: int = 0) -> ca.SX:
        """The chart (6 + joints,) of a phase's coordinates, or with ``level`` 1 or more its rates of theirs."""
        return self.free.chart(x, level)

    def state(self, p: Point) -> SpatialState:
        """The robot at this point; made once."""
        if "state" not in p.memo:
            motion = (self.chart(x, level) for level, x in enumerate((p.q, p.v, p.a)))
            p.memo["state"] = SpatialState(self.model, *motion, p.p.gravity, self.free.even)
        return p.memo["state"]

    def all_torques(self, p: Point) -> ca.SX:
        """Motor torques (joints,) of all joints; of those that are held none [N m]."""
        x = ca.SX.zeros(len(self.free.free))
        for k, torque in zip(self.free.joints, ca.vertsplit(self.torques(p)), strict=True):
            x[self.free.free.index(k + BASE)] = torque
        return self.chart(x, 1)[BASE:]

    def torques(self, p: Point) -> ca.SX:
        """Torques of the free joints' motors less their dry friction, whose kink at rest no solver likes [N m].

        The limits are lowered by that friction instead: joints that move have it, others need less.
        """
        return p.z[self.n_forces :]

    def pitch(self, side: int, x: ca.SX) -> ca.SX | float:
        """Pitch of a foot that carries [rad], heel up positive, from a phase's coordinates; or its rate of theirs."""
        return x[self.nv + self.raised.index(side)] if side in self.raised else ca.SX(0)

    def point_forces(self, p: Point, side: int) -> list[ca.SX]:
        """Forces (3,) at the points of one sole, in the axes of its foothold [N]."""
        count = len(self.edges)
        first = sum(count * len(x) for s, x in self.points.items() if s < side)
        found = []
        for k in range(len(self.points[side])):
            f = p.z[first + count * k : first + count * (k + 1)]
            mu = self.limits.friction
            across = 0 if self.free.plane else mu * (f[2] - f[3])
            found.append(ca.vertcat(mu * (f[0] - f[1]), across, ca.sum1(f)))
        return found

    def spread_forces(self, z: np.ndarray, side: int) -> np.ndarray:
        """Forces (n, .) along the edges of the pyramids of one foot when all coordinates are free, of even ones (n, .).

        In the plane a point stands for two, one on each side of the sole; a right foot is the mirror image of a left.
        """
        f = z.reshape(len(z), -1, len(self.edges))
        if self.free.plane:
            f = np.repeat(np.concatenate([f / 2, 0 * f], axis=2), 2, axis=1)
        elif side:
            f = f.reshape(len(z), -1, 2, 4)[:, :, ::-1][..., [0, 1, 3, 2]]
        return f.reshape(len(z), -1)

    def wrench(self, p: Point, side: int) -> tuple[ca.SX, ca.SX]:
        """Force and moment about the origin of the foot's body (3,) each, in its axes [N, N m]."""
        phi = self.pitch(side, p.q)
        c, s = ca.cos(phi), ca.sin(phi)
        force, moment = ca.SX.zeros(3), ca.SX.zeros(3)
        for place, f in zip(self.points[side], self.point_forces(p, side), strict=True):
            own = ca.vertcat(c * f[0] - s * f[2], f[1], s * f[0] + c * f[2])
            force += own
            moment += cross(ca.DM(place), own)
        turn = ca.DM(self.body.axes[side])
        force = turn @ force
        return force, turn @ moment + cross(ca.DM(self.body.tips[side]), force)

    def foot_force(self, p: Point, side: int) -> ca.SX:
        """Force (3,) of the ground on one foot, in the axes of its foothold [N]; zero in the air."""
        if side not in self.modes:
            return ca.SX.zeros(3)
        if side in self.sides:
            return sum(self.point_forces(p, side), ca.SX.zeros(3))
        return ca.DM([1.0, -1.0, 1.0]) * self.foot_force(p, 0)

    def needed(self, p: Point) -> tuple[ca.SX, ca.SX, ca.SX]:
        """(force, moment about the base, torques of the free joints' motors) that the motion needs besides the ground's
        forces, as far as they can change; made once."""
        if "needed" not in p.memo:
            wrenches = {self.body.feet[side]: self.wrench(p, side) for side in self.sides}
            force, moment, torques = self.state(p).dynamics(wrenches)
            p.memo["held"] = torques[self.held]
            torques = torques[self.free.joints] + ca.DM(self.motors["damping"]) * self.joint_rates(p)
            p.memo["needed"] = force[self.free.places], moment[self.free.spins], torques
        return p.memo["needed"]

    @cached_property
    def held(self) -> list[int]:
        """Joints of the left half that are held and have to carry something."""
        if self.robot.planar or not self.free.plane:
            return []
        return [k - 1 for k in self.model.left_half if self.model.across[k] is None and k - 1 not in self.free.joints]

    def held_torques(self, joined: bool) -> list[Term]:
        """Motors of joints that are held can hold them."""
        if not self.held:
            return []
        most = self.usable_torques[self.held] / self.body.motors["effort"][self.held]

        def torques(p):
            self.needed(p)
            return p.memo["held"] / ca.DM(self.body.motors["effort"][self.held])

        how = {"skip": (int(joined), 0), "group": "dynamics"}
        return [row("torques of held joints", "ours: limit", "of the effort", torques, -most, most, **how)]

    @property
    def usable_torques(self) -> np.ndarray:
        """Torques (joints,) that a plan may ask of the motors, less their dry friction [N m]."""
        return self.limits.torque_share * self.body.motors["effort"] - self.body.motors["friction"]

    @cached_property
    def motors(self) -> dict[str, np.ndarray]:
        """Key of :attr:`.Robot.actuators` -> (free joints,)."""
        return {key: x[self.free.joints] for key, x in self.body.motors.items()}

    def joint_rates(self, p: Point) -> ca.SX:
        """Rates of the free joints [rad/s]."""
        return p.v[self.nv - len(self.free.joints) : self.nv]

    def foot_axes(self, p: Point, side: int) -> ca.SX:
        """Attitude (3, 3) of a foot."""
        return self.state(p).rotation(self.body.feet[side]) @ ca.DM(self.body.axes[side])

    def foothold(self, p: Point, side: int) -> tuple[ca.SX, ca.SX]:
        """Place (3,) of the middle of the toe edge of a foot that carries [m], and its heading [rad]."""
        x, y, z, yaw = (getattr(p.c, f"{SIDES[side]}_{k}") for k in ("x", "y", "z", "yaw"))
        return ca.vertcat(x, y, z), yaw

    # all phases -------------------------------------------------------------------------------------------------
    def smoothness(self) -> list[Term]:
        """Costs on accelerations, jerk, torques and forces."""
        w = self.weights
        terms = [
            cost("acceleration", "WL-J2, WF-J2", "rad/s^2", lambda p: self.moving(p.a), w.acceleration),
            cost("jerk", "WL-J2, WF-J2", "rad/s^3", lambda p: self.moving(p.j), w.jerk, "mid"),
            cost("torque", "ours: effort", "N m", self.all_torques, w.torque),
        ]
        if not self.flying:
            terms.append(cost("force", "ours: spread", "N", lambda p: p.z[: self.n_forces], w.force))
        if not (self.robot.planar or self.free.even):
            terms.append(cost("mirror", "ours: a jump straight ahead is even", "rad", self.uneven, w.mirror))
        return terms

    def moving(self, x: ca.SX) -> ca.SX:
        """What turns, of derivatives: attitude of the base and joints, of both sides."""
        return self.chart(x, 1)[[*(3 + k for k in range(3) if 3 + k in self.free.free), *self._moved]]

    @cached_property
    def _moved(self) -> list[int]:
        """Columns of the chart of joints that are not held."""
        return [BASE + int(k) for k in np.flatnonzero(np.abs(self.free.spread[BASE:]).any(axis=1))]

    def uneven(self, p: Point) -> ca.SX:
        """How far left and right are from mirror images in a jump straight ahead; yaw and roll of the base."""
        rows = [p.q[BASE + k] - sign * p.q[BASE + i] for i, k, sign in mirror(self.model.model)]
        return p.p.straight * ca.vertcat(p.q[3:5], *rows)

    def dynamics(self, joined: bool) -> list[Term]:
        """Newton and Euler: nothing but the ground moves the base; joint torques go with the motion.

        Where a phase shares its first node with the one before (``joined``), that one has these rows.
        """

        def torques(p):
            return (self.needed(p)[2] - self.torques(p)) / ca.DM(self.motors["effort"])

        how = {"identity": True, "skip": (int(joined), 0), "group": "dynamics"}
        return [
            row("joint dynamics", "ours", "of the effort", torques, **how),
            row("base forces", "ours", "N", lambda p: self.needed(p)[0], scale=self.mg, **how),
            row("base moments", "ours", "N m", lambda p: self.needed(p)[1], scale=MOMENT_ARM_M * self.mg, **how),
        ]

    def motor_lines(self, joined: bool) -> Term:
        """Torque against speed of every joint."""
        m = self.motors
        slope = m["effort"] / (m["no_load_speed"] - m["corner_speed"]) * self.limits.torque_share
        top = slope * m["no_load_speed"] - m["friction"]

        def line(p):
            return (self.torques(p) + ca.DM(slope) * self.joint_rates(p)) / ca.DM(m["effort"])

        high = top / m["effort"]
        return row("torque-speed", "ours: motor line", "of the effort", line, -high, high, skip=(int(joined), 0))

    def body_clearance(self) -> Term:
        """Knees and hands stay away from the ground, and shanks from a platform that they are to be brought onto."""
        half = set(self.model.left_half) if self.free.even else set(range(len(self.model.bodies)))
        limbs, lim = self.body.limb_points, self.limits
        least = np.full(len(limbs), lim.body_clearance_m)
        least[:2] += self.body.shank_m
        kept = [k for k, (body, _) in enumerate(limbs) if body in half]
        shanks = [x for x in self.body.shank_points if x[0] in half]
        face = self.body.shank_m + lim.shank_clearance_m

        def heights(p):
            s, up, lowest = self.state(p), p.p.platform > 0, ca.fmin(p.p.platform, 0)
            limb = [s.point(*limbs[k]) for k in kept]
            heights = [x[2] - self.ground(p, x, lim.edge_clearance_m) for x in limb]
            for x in (s.point(*shank) for shank in shanks):
                heights.append(x[2] - lowest - up * (p.p.platform + face) * self.beyond_edge(p, x, face))
            return ca.vertcat(*heights)

        how = {"scale": PLACE_SCALE, "skip": (1, 0), "group": "clearance"}
        return row("body clearance", "ours", "m", heights, np.append(least[kept], np.zeros(len(shanks))), np.inf, **how)

    def sides_apart(self) -> list[Term]:
        """Left and right knees, ankles, toes and heels keep a share of their distance in the stance, seen from the
        trunk; hands stay outside. Cheap rows, which hold for most motions what distances of links would. In the plane
        legs do not move across it."""
        if self.robot.planar and self.free.plane:
            return []
        body, lim, state = self.body, self.limits, self.state
        pairs = [[(1 + k, np.zeros(3)) for k, _, _ in body.knees], [(k, np.zeros(3)) for k in body.feet]]
        pairs += [list(zip(body.feet, places, strict=True)) for places in (body.tips, body.corners[:, 2:].mean(axis=1))]
        hands = body.limb_points[2:]
        if self.free.plane:
            pairs = []
        if self.free.even:
            hands = [hand for hand in hands if hand[0] in self.model.left_half]

        def distance(s, left, right):
            if self.free.even:
                return 2 * s.from_base(*left)[1]
            return s.from_base(*left)[1] - s.from_base(*right)[1]

        def across(s):
            return ca.vertcat(*(distance(s, *pair) for pair in pairs), *(s.from_base(*hand)[1] for hand in hands))

        chart = ca.SX(ca.DM(body.stance))
        stood = ca.evalf(across(SpatialState(self.model, chart, 0 * chart, 0 * chart))).full().ravel()
        way = np.sign(stood)
        least = [lim.sides_share * abs(x) for x in stood[: len(pairs)]]
        least += [abs(x) - lim.hands_inward_m for x in stood[len(pairs) :]]

        def rows(p):
            return ca.DM(way) * across(state(p))

        how = {"scale": PLACE_SCALE, "skip": (1, 0), "group": "clearance"}
        return [row("sides apart", "ours", "m", rows, np.array(least), np.inf, **how)]

    def link_distance(self, kept: Apart, intervals: int) -> Term:
        """Two links stay apart at the nodes for which it is asked."""
        pair, skip = kept.pair, (kept.first, intervals - kept.last)

        def gap(p):
            return pair.gap(self.state(p))

        return row(
            pair.key,
            "ours",
            "m",
            gap,
            self.limits.link_distance_m + kept.more_m,
            np.inf,
            scale=PLACE_SCALE,
            skip=skip,
            group=pair.key,
        )

    def ground(self, p: Point, x: ca.SX, nearer_m: float = 0.0) -> ca.SX:
        """Height of the surface below a point, its upper part ``nearer_m`` than it is."""
        return p.p.platform * self.beyond_edge(p, x, nearer_m * ca.sign(p.p.platform))

    def beyond_edge(self, p: Point, x: ca.SX, nearer_m: float | ca.SX) -> ca.SX:
        """1 for a point beyond the edge where the ground steps up or down, 0 before it, smooth between."""
        beyond = ca.dot(p.p.along, x[:2]) - p.p.edge + nearer_m
        return (1 + ca.tanh(beyond / self.limits.edge_smoothing_m)) / 2

    # feet on the ground -----------------------------------------------------------------------------------------
    def foot_rows(self, side: int, joined: bool, landed: bool) -> list[Term]:
        """A foot that carries is in its place, still, and stays so, on its toes about their edge: all three levels.

        At a node that is ``joined`` to the phase before these rows stand there; where another foot lands, place and
        velocity are shared, so one that stood before has only the last level; one that has ``landed`` has all.
        """
        name, k = SIDES[side], self.body.feet[side]
        axes, tip = self.body.axes[side], self.body.tips[side]

        def place(p):
            at, yaw = self.foothold(p, side)
            s, turn = self.state(p), self.foot_axes(p, side)
            heading = ca.cos(yaw) * turn[1, 0] - ca.sin(yaw) * turn[0, 0]
            pitch = turn[2, 0] + ca.sin(self.pitch(side, p.q))
            return self._foot_rows(side, s.point(k, tip) - at, [heading, turn[2, 1], pitch], p.q)

        def rates(p):
            speed, spin = self.state(p).own_rates(k, tip)
            spin = ca.DM(axes).T @ spin
            spin[1] -= self.pitch(side, p.v)
            return self._foot_rows(side, ca.DM(axes).T @ speed, [spin[2], spin[0], spin[1]], p.v)

        def accelerations(p):
            gain, spin = self.state(p).own_accelerations(k, tip)
            spin = ca.DM(axes).T @ spin
            spin[1] -= self.pitch(side, p.a)
            return self._foot_rows(side, ca.DM(axes).T @ gain, [spin[2], spin[0], spin[1]], p.a)

        first = 1 if joined or not landed else 0
        levels = ("in place", "m, 1", place, 1.0, first), ("still", "m/s, rad/s", rates, 1.0, first)
        levels += (("held", "m/s^2, rad/s^2", accelerations, ACCELERATION_SCALE, int(joined)),)
        return [
            row(
                f"{name} foot {said}", "ours: contact", unit, of, identity=True, scale=scale, skip=(skip, 0), group=name
            )
            for said, unit, of, scale, skip in levels
        ]

    def _foot_rows(self, side: int, place: ca.SX, turn: list[ca.SX], chart: ca.SX) -> ca.SX:
        """The rows of a foot that can change: place, heading, roll and pitch.

        Short legs leave the base no yaw and no roll, and the right foot's side follows.
        """
        if not self.short:
            return ca.vertcat(place, *turn)[self.free.foot]
        return ca.vertcat(place, *turn) if side == 0 else ca.vertcat(place[[0, 2]], *turn, chart[3], chart[4])

    def loads(self) -> Term:
        """Both flat feet carry."""

        def forces(p):
            return ca.vertcat(*(self.foot_force(p, side)[2] for side in self.sides))

        least = (self.limits.least_push / 2 if self.free.even else self.limits.foot_share) * self.mg
        return row("load of each foot", "ours", "N", forces, least, np.inf, scale=self.mg, skip=(0, 0))

    def torsion(self, side: int) -> Term:
        """Friction holds a foot that carries alone against the moment about the vertical through its CoP."""
        arm = self.limits.friction * self.limits.torsion_arm_m

        def left(p):
            force, moment = ca.SX.zeros(3), ca.SX.zeros(3)
            for place, f in zip(self.points[side], self.point_forces(p, side), strict=True):
                force += f / self.mg
                moment += cross(ca.DM(place), f / self.mg)
            twist = ca.dot(force, moment)  # that moment times the load
            return ca.vertcat(arm * force[2] ** 2 - twist, arm * force[2] ** 2 + twist)

        words = f"spin of {SIDES[side]} foot", "ours: friction", "m, of the squared weight"
        return row(*words, left, -TORSION_SLACK_M, np.inf, scale=MOMENT_ARM_M / 10, group="torsion")

    def swing_rows(self, side: int) -> Term:
        """A foot in the air keeps its sole's corners off the ground, by as much as the references ask for.

        Its ankle stays as high as it stands, or the shank would graze.
        """
        k, least = self.body.feet[side], self.body.ankle_m + self.limits.ankle_margin_m

        def heights(p):
            places = [self.state(p).point(k, c) for c in self._sole_edge(side)]
            asked = getattr(p.ref, f"{SIDES[side]}_clearance")
            ankle = self.state(p).point(k, np.zeros(3))
            above = [x[2] - self.ground(p, x) - asked for x in places]
            return ca.vertcat(*above, ankle[2] - self.ground(p, ankle) - least)

        how = {"scale": PLACE_SCALE, "skip": (1, 1), "group": "clearance"}
        return row(f"clearance of {SIDES[side]} sole", "ours", "m", heights, *POSITIVE, **how)

    def _sole_edge(self, side: int) -> np.ndarray:
        """Points of the sole that stay clear of the ground: its corners, in the plane along its middle line."""
        if not self.free.plane:
            return self.body.corners[side]
        ends = self.body.corners[side].reshape(2, 2, 3).mean(axis=1)
        return np.array([ends[0] + share * (ends[1] - ends[0]) for share in SOLE_SHARES])

    # flight -----------------------------------------------------------------------------------------------------
    def flight_rows(self) -> list[Term]:
        """Flight: the CoM's parabola and all three components of L, at every node, the one of take-off included."""

        def com(p):
            t, c = p.time, p.c
            fall = ca.vertcat(0, 0, p.p.gravity * t * t / 2)
            start, speed = (self.constant(c, k) for k in ("com", "vel"))
            return (self.state(p).com - (start + speed * t - fall))[self.free.places]

        def speed(p):
            fall = ca.vertcat(0, 0, p.p.gravity * p.time)
            return (self.state(p).com_velocity - (self.constant(p.c, "vel") - fall))[self.free.places]

        def kept(p):
            return (self.state(p).angular_momentum - self.constant(p.c, "L"))[self.free.spins]

        at = self.free.turns

        def angles(left, right, step):
            """Of the base: places alone, rates come from L and accelerations from the moments."""
            turned = right.q[at] - left.q[at] - step * (left.v[at] + right.v[at]) / 2
            return turned - step**2 * (left.a[at] - right.a[at]) / 12

        return [
            row("ballistic CoM", "WF-D1", "m", com, identity=True, group="flight"),
            row("ballistic CoM velocity", "WF-D1", "m/s", speed, identity=True, group="flight"),
            row("angular momentum", "WF-D1, three components", "kg m^2/s", kept, scale=SPIN_SCALE, group="flight"),
            row("base turns", "state equation", "rad", angles, at="interval", identity=True),
        ]

    def constant(self, c: SimpleNamespace, kind: str) -> ca.SX:
        """A constant vector (3,) of the flight: "com", "vel" or "L"; what cannot change is zero."""
        return ca.vertcat(*(getattr(c, f"{kind}_{x}", ca.SX(0)) for x in "xyz"))

    @property
    def constants(self) -> list[str]:
        """Names of those that can change."""
        moved = [f"{kind}_{'xyz'[k]}" for kind in ("com", "vel") for k in self.free.places]
        return [*moved, *(f"L_{'xyz'[k]}" for k in self.free.spins)]

    # touchdown at the end of the schedule -----------------------------------------------------------------------
    def bend(self, p: Point) -> ca.SX:
        """Flexion of the knees [rad]."""
        chart, knees = self.chart(p.q), self.body.knees[: len(self.free.sides)]
        return ca.vertcat(*(sign * chart[BASE + k] + angle for k, sign, angle in knees))

    def turned(self, p: Point, x: ca.SX | np.ndarray, way: int = 1) -> ca.SX:
        """A vector (3,) turned by the asked yaw, or back."""
        c, s = ca.cos(p.p.yaw), way * ca.sin(p.p.yaw)
        return ca.vertcat(c * x[0] - s * x[1], s * x[0] + c * x[1], x[2])

    def sole_middle(self, p: Point) -> ca.SX:
        """Middle between both soles (3,) [m]; of an even motion, without the part across the plane."""
        soles = [self.state(p).point(self.body.feet[side], self.body.middles[side]) for side in self.free.sides]
        return sum(soles) / len(soles)

    def feet_at_goal(self, p: Point) -> ca.SX:
        """What is left between both feet and their new places: place (3,), pitch, roll, heading of each."""
        rows, short = [], self.short
        for side in self.free.sides:
            sole = self.state(p).point(self.body.feet[side], self.body.middles[side])
            first = self.body.places[side] - np.array([self.body.half_m, 0.0, 0.0])
            goal = self.turned(p, first) + ca.vertcat(p.p.distance, p.p.side, p.p.platform)
            axes, ahead = self.foot_axes(p, side), self.turned(p, np.array([1.0, 0.0, 0.0]))
            off = sole - goal
            if short:
                off = self.turned(p, off, -1)[[0, 1, 2] if side == 0 else [0, 2]]
            whole_rows = ca.vertcat(off, ca.dot(ahead, axes[:, 1]), axes[2, 1], axes[2, 0])
            rows.append(whole_rows if short else whole_rows[self.free.foot])
        return ca.vertcat(*rows, *([p.q[3] - p.p.yaw, p.q[4]] if short else []))

    def capture(self, p: Point) -> ca.SX:
        """How far the middle between the soles is off the place (2,) where it catches the robot [m]."""
        lim = self.limits
        ahead = self.turned(p, np.array([lim.capture_offset_m, 0.0, 0.0]))
        speed = self.constant(p.c, "vel")
        off = self.sole_middle(p) - self.state(p).com - ahead - lim.capture_slope_s * speed
        return off[[k for k in self.free.places if k < 2]]

    def sliding(self, p: Point) -> ca.SX:
        """By how much soles come down steeply enough to stick, each way along x and y (4,) of each foot [m/s]."""
        state, found = self.state(p), []
        for side in self.free.sides:
            k = self.body.feet[side]
            speed = state.rotation(k) @ state.own_rates(k, self.body.middles[side])[0]
            found.append(self.edges @ speed[:2] - self.limits.touchdown_slope * speed[2])
        return ca.vertcat(*found)

    def capture_rows(self) -> list[Term]:
        """Where the soles meet the ground, so that the robot can be caught; of a flip by its momentum."""
        moment, window = self.limits.capture_moment, self.limits.capture_window_m
        if moment is not None:
            moment = moment * self.body.spin_size
        if moment is None:
            how = {"at": "end", "scale": PLACE_SCALE}
            return [row("capture window", "ours; replaces WF-E2", "m", self.capture, -window, window, **how)]
        if self.free.plane:
            return self._flip_capture()

        def about_soles(p):
            speed = self.constant(p.c, "vel") - ca.vertcat(0, 0, p.p.gravity * p.time)
            arm = self.state(p).com - self.sole_middle(p)
            about = self.constant(p.c, "L") + self.model.mass * ca.cross(arm, speed)
            return about[[k for k in self.free.spins if k < 2]]

        words = "capture by momentum", "ours, for flips; replaces WF-E2", "kg m^2/s"
        return [row(*words, about_soles, -moment, moment, at="end", scale=SPIN_SCALE)]

    def _flip_capture(self) -> list[Term]:
        """A flip forward asks for its angular momentum about the soles, which the impact does not change; a flip
        backward for its capture point, x + v_x / sqrt(g / z), ahead of the toes."""
        lim, mass, body = self.limits, self.model.mass, self.body
        slope_s = lim.capture_backward_slope * float(np.sqrt(body.leg_m / GRAVITY))

        def moved(p, local):
            """Arm from a point of the left foot to the CoM, and L about that point over the mass."""
            arm = (self.state(p).com - self.state(p).point(body.feet[0], local))[[0, 2]]
            speed = (self.constant(p.c, "vel") - ca.vertcat(0, 0, p.p.gravity * p.time))[[0, 2]]
            return arm, p.c.L_y / mass + arm[1] * speed[0] - arm[0] * speed[1]

        def forward(p):
            return mass * moved(p, body.middles[0])[1]

        def backward(p):
            arm, left = moved(p, body.tips[0])
            # far from a landing the CoM of a start may be below the toes
            return arm[0] + left / ca.sqrt(p.p.gravity * ca.fmax(arm[1], body.leg_m / 2)) + slope_s * p.p.takeoff_speed

        def one_way(of, sign, bounds):  # in flips of the other direction the row is a constant inside its bounds
            return lambda p: ca.if_else(sign * p.p.rotation > 0, of(p), sum(bounds) / 2)

        def end(name, way, unit, of, bounds, scale):
            return row(name, f"ours, for flips {way}; replaces WF-E2", unit, of, *bounds, at="end", scale=scale)

        ahead = [x * body.spin_size for x in lim.capture_forward]
        back = [x * body.leg_m for x in lim.capture_backward]
        return [
            end("capture by momentum", "forward", "kg m^2/s", one_way(forward, 1, ahead), ahead, SPIN_SCALE),
            end("capture beyond the toes", "backward", "m", one_way(backward, -1, back), back, PLACE_SCALE),
        ]

    def touchdown_rows(self) -> list[Term]:
        """Touchdown: both feet in their new places, flat; posture, rates, and where the soles are against the CoM."""
        lim, rate, foot = self.limits, self.limits.touchdown_joint_rate, self.limits.touchdown_foot_rate
        trunk = lim.touchdown_trunk_rate

        def within(rates, vertical):
            """Bounds on rates, those about the vertical wider where more than half a turn has to be stopped."""
            vertical = np.array(vertical, float)

            def most(parameters):
                more = max(0.0, abs(float(parameters["yaw"])) / np.pi - 1)
                return rates + lim.touchdown_turning * more * vertical

            return (lambda parameters: -most(parameters)), most

        def spins(p):
            return ca.vertcat(*(self.state(p).spin(self.body.feet[side])[turning] for side in self.free.sides))

        def attitude(p):
            return (self.chart(p.q)[3:6] - ca.vertcat(p.p.yaw, 0, p.p.rotation))[angles]

        def trunk_rates(p):
            return p.v[self.free.turns]

        def end(name, equation, unit, of, lower=0.0, upper=0.0, **how):
            return row(name, equation, unit, of, lower, upper, at="end", **how)

        def speed(p):
            return p.c.vel_z - p.p.takeoff_speed

        turning = [1] if self.free.plane else [0, 1, 2]
        angles = [self.free.free[k] - 3 for k in self.free.turns]
        sticks = "soles that stick at touchdown", "ours: friction", "m/s"
        low = np.array([-lim.touchdown_yaw, -lim.touchdown_roll, lim.touchdown_pitch[0]])[angles]
        high = np.array([lim.touchdown_yaw, lim.touchdown_roll, lim.touchdown_pitch[1]])[angles]
        about = np.tile(np.array([0.0, 0.0, 1.0])[turning], len(self.free.sides))
        return [
            row("vertical take-off speed", "SL-E2, WL-E1", "m/s", speed, at="start"),
            end("touchdown of the feet", "WL-E1, SL-E1: place and heading", "m, 1", self.feet_at_goal),
            end("foot rates at touchdown", "ours", "rad/s", spins, *within(foot, about)),
            *([] if self.free.plane else [end(*sticks, self.sliding, *POSITIVE)]),
            end("attitude at touchdown", "ours", "rad", attitude, low, high),
            end("knees at touchdown", "ours: stroke", "rad", self.bend, *lim.touchdown_knee),
            end("joint rates at touchdown", "WF-E1, relaxed", "rad/s", self.joint_rates, -rate, rate),
            end("trunk rates at touchdown", "ours", "rad/s", trunk_rates, *within(trunk, np.eye(3)[0][angles])),
            *self.landing_stroke(),
            *self.capture_rows(),
        ]

    def landing_stroke(self) -> list[Term]:
        """If asked, ankles keep some way to the stop that the shanks lean into."""
        stroke = self.limits.touchdown_ankle_stroke
        if stroke is None or not self.free.plane:
            return []
        names, signs = self.robot.joints["ankle_pitch"], self.robot.sagittal.signs[2]
        least = float(self.robot.sagittal.lower[2]) + stroke

        def ankle(p):
            return float(signs[0]) * self.chart(p.q)[BASE + self.body.joint_names.index(names[0])]

        return [row("ankles at touchdown", "ours, for flips: stroke", "rad", ankle, least, np.inf, at="end")]

    # where stage 1 is followed ----------------------------------------------------------------------------------
    def links(self, x: ca.SX, level: int = 0) -> ca.SX:
        """Absolute angles (5,) of foot, shank, thigh, trunk and arm in the plane, or their rates of those of ``x``."""
        chart, sagittal, joints = self.chart(x, level), self.robot.sagittal, []
        for role, signs in zip(ROLES, sagittal.signs, strict=True):
            pair = self.robot.joints[role]
            column = BASE + self.body.joint_names.index(pair[0]) if pair else None
            joints.append(float(signs[0]) * chart[column] if pair else ca.SX(0))
        hip, knee, ankle, shoulder = joints
        trunk = chart[PITCH]
        return ca.vertcat(trunk + hip + knee + ankle, trunk + hip + knee, trunk + hip, trunk, trunk + shoulder)

    def plane_state(self, p: Point) -> PlanarState:
        """The five links at this point, rooted at the toe; made once."""
        if "plane" not in p.memo:
            links = (self.links(x, level) for level, x in enumerate((p.q, p.v, p.a)))
            p.memo["plane"] = PlanarState(self.robot.sagittal, *links, p.p.gravity)
        return p.memo["plane"]

    def tracking(self) -> list[Term]:
        """Stage 1's trajectories as references, at the same share of each phase (WL-J1, WL-J3, WF-J1, WF-J2).

        Heel up, the heel stays quiet besides, and L at take-off is stage 1's (WL-D1).
        """
        w, s, origin, spin = (
            self.weights,
            self.plane_state,
            "WF-J1" if self.flying else "WL-J1",
            "WL-D1, as a cost on L",
        )
        rates = w.track_flight_inertia_rate if self.flying else w.track_inertia_rate
        size = self.model.mass * rod_of(self.robot, stance_angles(self.robot))[3] ** 2  # [kg m^2] of the stance
        inertia, rate = float(w.track_inertia / size**2), float(rates / size**2)
        rows = [
            cost("track inertia", origin, "kg m^2", lambda p: s(p).inertia - p.ref.rho, inertia),
            cost("track inertia rate", origin, "kg m^2/s", lambda p: s(p).inertia_rate - p.ref.rho_rate, rate),
        ]
        if self.flying:
            return [*rows, cost("ankle rate", "WF-J2", "rad/s", lambda p: s(p).joint_rates[2], w.ankle_rate)]
        rows += [
            cost("track velocity", origin, "m/s", lambda p: s(p).com_velocity - p.ref.velocity, w.track_velocity),
            cost("track momentum", spin, "kg m^2/s", lambda p: s(p).angular_momentum - p.ref.L, w.track_momentum),
        ]
        if self.raised:
            rows.append(cost("heel velocity", "WL-J3", "m/s", lambda p: s(p).point("heel", 1)[1], w.heel_velocity))
            rows.append(row("L at take-off", "WL-D1", "kg m^2/s", self._momentum_kept, *POSITIVE, at="end"))
        return rows

    def _momentum_kept(self, p: Point) -> ca.SX:
        """What is left of the slack between L and stage 1's at take-off, on both sides."""
        slack = ca.fmax(self.limits.momentum_share * ca.fabs(p.p.momentum), self.limits.momentum_slack)
        difference = self.plane_state(p).angular_momentum - p.p.momentum
        return ca.vertcat(slack - difference, slack + difference)

    # flips ------------------------------------------------------------------------------------------------------
    def opening_rows(self) -> list[Term]:
        """If asked, joints open a tuck so slowly that they could do so later and faster; it sets in gradually."""
        if self.limits.opening_speed_share >= self.limits.speed_share:
            return []
        most = self.limits.opening_speed_share * self.motors["speed"]

        def rates(p):
            begun = ca.fmax(0, ca.fmin(1, 10 * (p.s - 1 + LATE_SHARE)))
            return begun * self.joint_rates(p)

        return [row("opening speed", "ours, for flips", "rad/s", rates, -most, most, scale=10.0, skip=(1, 0))]

    def reserve(self) -> list[Term]:
        """The CoP of flat feet keeps off both ends of the sole, but for the ends of the phase."""
        reserve, share = 2 * self.body.half_m * self.limits.cop_reserve_share, RESERVE_SHARE
        if not reserve:
            return []

        def left(p):
            kept = reserve * ca.fmax(0, ca.fmin(1, ca.fmin(p.s / share[0], (1 - p.s) / share[1])))
            rows = []
            for side in self.sides:
                forces = [f[2] / self.mg for f in self.point_forces(p, side)]
                ahead = sum(-x[0] * f for x, f in zip(self.points[side], forces, strict=True))
                load, length = sum(forces), -float(self.points[side][-1, 0])
                rows += [ahead - kept * load, (length - kept) * load - ahead]
            return ca.vertcat(*rows)

        return [row("CoP reserve", "ours", "m, of the weight", left, *POSITIVE, scale=PLACE_SCALE)]
