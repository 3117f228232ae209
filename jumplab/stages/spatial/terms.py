"""The named costs and constraints of the spatial program, as functions of one instant; nothing here solves."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin

from jumplab.models.spatial import CHART, SpatialModel, SpatialState, rates
from jumplab.ocp.problem import Point, Term
from jumplab.robot import Robot
from jumplab.robot.description import SLIDING_RATE
from jumplab.robot.reduction import mirror
from jumplab.robot.stance import knees, stance_configuration
from jumplab.stages.spatial.settings import SpatialLimits, SpatialWeights
from jumplab.stages.spatial.shapes import boxes, pairs
from jumplab.stages.whole_body.settings import Contact
from jumplab.stages.whole_body.terms import POSITIVE, cost, row
from jumplab.task import GRAVITY

PYRAMID = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])  # directions of the friction cone's edges
MOMENT_ARM_M = 0.1  # nominal size of moments over that of forces


class SpatialTerms:
    """Terms of one phase, which is a mode of contact, and the expressions that they share.

    The world's origin lies in the middle of the soles in their first place, x forward, z up.

    Attributes
    ----------
    coordinates : of the phase: the chart with the base's place, in flight without it, then the joints.
    states : further variables: force along each edge of each corner's friction cone, in flight the acceleration of
        the base against free fall; then the joint torques.
    corners : (2, k, 3) places on the ground where forces act.
    """

    def __init__(self, robot: Robot, limits: SpatialLimits, weights: SpatialWeights, contact: Contact):
        self.robot, self.limits, self.weights, self.contact = robot, limits, weights, contact
        self.model, self.flying = SpatialModel(robot.model), contact is Contact.FLIGHT
        self.mg, foot = self.model.mass * GRAVITY, robot.foot
        frames = [self.model.model.frames[self.model.model.getFrameId(name)] for name in foot.frames]
        self.feet = [f.parentJoint - 1 for f in frames]
        self._foot_axes = [
            self.model.bodies[k].own.T @ f.placement.rotation for k, f in zip(self.feet, frames, strict=True)
        ]

        def on_foot(x):
            return [self.model.local(f.parentJoint, f.placement.act(np.array(x))) for f in frames]

        self.toes, self.soles = on_foot([foot.toe, 0.0, foot.sole_z]), on_foot(foot.center)
        self.sole_corners = np.array([on_foot(x) for x in foot.corners]).transpose(1, 0, 2)  # (2, 4, 3)
        self.stance = self.model.of_pinocchio(stance_configuration(robot)[None])[0]
        meeting = {0, *(j for k in self.feet for j in self.chain(k))} if robot.planar else range(len(self.model.bodies))
        self.pairs = pairs(robot, self.model, set(meeting), stance_configuration(robot))
        self.knees = knees(robot)
        self.places = self._first_places(frames)
        self.corners = self._ground_corners()
        first = 3 if self.flying else 0
        self.coordinates = self.model.names[first:]
        n = self.corners.shape[1] * len(PYRAMID)
        forces = [f"force {k} of {side} foot" for side in ("left", "right") for k in range(n)]
        falling = [f"acceleration {x} against free fall" for x in "xyz"]
        self.n_forces = 0 if self.flying else len(forces)
        self.states = (*(falling if self.flying else forces), *(f"torque of {name}" for name in self.joint_names))
        rows = [robot.actuators[name] for name in self.joint_names]
        self.motors = {key: np.array([r[key] for r in rows]) for key in rows[0]}

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.model.names[len(CHART) :]

    def chain(self, body: int) -> list[int]:
        """Bodies from one up to the base, which is left out."""
        found = []
        while body:
            found.append(body)
            body = self.model.bodies[body].parent
        return found

    @property
    def short(self) -> bool:
        """Whether a leg has fewer than six joints: feet that stand then hold yaw and roll of the base."""
        return min(len(self.chain(k)) for k in self.feet) < 6

    @property
    def held(self) -> tuple[list[int], list[int]]:
        """Which components of their feet's places are told to the legs: of short ones, the second's side follows."""
        return [0, 1, 2], [0, 2] if self.short else [0, 1, 2]

    def _first_places(self, frames) -> np.ndarray:
        """Middles of both soles (2, 3) as the robot stands [m]."""
        model, data = self.model.model, self.model.model.createData()
        pin.framesForwardKinematics(model, data, stance_configuration(self.robot))
        ids = [model.getFrameId(name) for name in self.robot.foot.frames]
        return np.array([data.oMf[i].act(self.robot.foot.center) for i in ids])

    def _ground_corners(self) -> np.ndarray:
        lim, foot = self.limits, self.robot.foot
        half, wide = (foot.toe - foot.heel) / 2, foot.half_width - min(lim.side_margin_m, 0.4 * foot.half_width)
        xs = {Contact.FLAT: (lim.heel_margin_m - half, half), Contact.TOE: (half,), Contact.FLIGHT: ()}[self.contact]
        local = np.array([[x, y, 0.0] for x in xs for y in (-wide, wide)]).reshape(-1, 3)
        return self.places[:, None] + local

    # model on a point -------------------------------------------------------------------------------------------
    def state(self, p: Point) -> SpatialState:
        """The robot at this point; in flight its base rests at the origin and is accelerated against free fall."""
        if "state" not in p.memo:
            q, v, a = p.q, p.v, p.a
            if self.flying:
                q, v, a = ca.vertcat(ca.SX.zeros(3), q), ca.vertcat(ca.SX.zeros(3), v), ca.vertcat(p.z[:3], a)
            p.memo["state"] = SpatialState(self.model, q, v, a, 0.0 if self.flying else p.p.gravity)
        return p.memo["state"]

    def torques(self, p: Point) -> ca.SX:
        """Motor torques [N m]."""
        return p.z[self.n_forces or 3 :]

    def base(self, p: Point) -> ca.SX:
        """Place of the base (3,) [m]: in flight the CoM's parabola less the CoM seen from the base."""
        if not self.flying:
            return ca.SX.zeros(3)  # the state knows it
        return self.com(p) - self.state(p).com_from_base

    def com(self, p: Point) -> ca.SX:
        """Centre of mass (3,) [m]."""
        if not self.flying:
            return self.state(p).com
        t, c = p.time, p.c
        place = c.com_x + c.vel_x * t, c.com_y + c.vel_y * t, c.com_z + c.vel_z * t - p.p.gravity * t * t / 2
        return ca.vertcat(*place)

    def at(self, p: Point, body: int, local: np.ndarray) -> ca.SX:
        """Place of a point of a body (3,) [m]."""
        return self.base(p) + self.state(p).point(body, local)

    def foot_axes(self, p: Point, side: int) -> ca.SX:
        """Attitude (3, 3) of a foot."""
        return self.state(p).rotation(self.feet[side]) @ ca.DM(self._foot_axes[side])

    def foot_force(self, p: Point, side: int) -> list[ca.SX]:
        """Forces (3,) at the corners of one foot [N]."""
        k = self.corners.shape[1]
        f = ca.reshape(p.z[side * 4 * k : (side + 1) * 4 * k], 4, k)
        return [ca.vertcat(self.limits.friction * (PYRAMID.T @ f[:, i]), ca.sum1(f[:, i])) for i in range(k)]

    def needed(self, p: Point) -> tuple[ca.SX, ca.SX, ca.SX]:
        """(force, moment about the base, torques of the motors) that the motion needs besides the ground's forces; made
        once."""
        if "needed" not in p.memo:
            s, wrenches = self.state(p), {}
            for side, body in enumerate(self.feet if not self.flying else ()):
                origin, forces = p.q[:3] + s.origin(body), self.foot_force(p, side)
                arms = [ca.DM(c) - origin for c in self.corners[side]]
                moment = sum(ca.cross(arm, f) for arm, f in zip(arms, forces, strict=True))
                wrenches[body] = sum(forces), moment
            force, moment, torques = s.dynamics(wrenches)
            p.memo["needed"] = force, moment, torques + self.lost(p) if self.robot.lossy else torques
        return p.memo["needed"]

    def lost(self, p: Point) -> ca.SX:
        """Torques that the motors lose to their own friction, as :meth:`.Robot.lost_torque` [N m]."""
        m, rates = self.motors, p.v[len(self.coordinates) - self.model.joints :]
        return ca.DM(m["friction"]) * ca.tanh(rates / SLIDING_RATE) + ca.DM(m["damping"]) * rates

    # all phases -------------------------------------------------------------------------------------------------
    def smoothness(self) -> list[Term]:
        """Costs on accelerations, jerk, torques and forces."""
        w, first = self.weights, len(self.coordinates) - self.model.joints - 3
        terms = [
            cost("acceleration", "WL-J2, WF-J2", "rad/s^2", lambda p: p.a[first:], w.acceleration),
            cost("jerk", "WL-J2, WF-J2", "rad/s^3", lambda p: p.j, w.jerk, "mid"),
            cost("torque", "ours: effort", "N m", self.torques, w.torque),
        ]
        if not self.flying:
            terms.append(cost("force", "ours: spread", "N", lambda p: p.z[: self.n_forces], w.force))
        if not self.robot.planar:
            terms.append(cost("mirror", "ours: a jump straight ahead is even", "rad", self.uneven, w.mirror))
        return terms

    def uneven(self, p: Point) -> ca.SX:
        """How far left and right are from mirror images in a jump straight ahead; yaw and roll of the base."""
        first = len(self.coordinates) - self.model.joints
        rows = [p.q[first + k] - sign * p.q[first + i] for i, k, sign in mirror(self.model.model)]
        return p.p.straight * ca.vertcat(p.q[first - 3 : first - 1], *rows)

    def dynamics(self) -> list[Term]:
        """Newton and Euler: nothing but the ground moves the base; joint torques go with the motion."""

        def torques(p):
            return self.needed(p)[2] - self.torques(p)

        rows = [row("joint dynamics", "ours", "N m", torques, scale=MOMENT_ARM_M * self.mg, identity=True)]
        rows.append(row("base forces", "ours", "N", lambda p: self.needed(p)[0], scale=self.mg, identity=True))
        if not self.flying:
            turn = row("base moments", "ours", "N m", lambda p: self.needed(p)[1], scale=MOMENT_ARM_M * self.mg)
            rows.append(turn)
        return rows

    def motor_lines(self) -> Term:
        """Torque against speed of every joint."""
        m, first = self.motors, len(self.coordinates) - self.model.joints
        slope = m["effort"] / (m["no_load_speed"] - m["corner_speed"]) * self.limits.torque_share
        top = slope * m["no_load_speed"]
        return row(
            "torque-speed",
            "ours: motor line",
            "N m",
            lambda p: self.torques(p) + slope * p.v[first:],
            -top,
            top,
            scale=100.0,
        )

    # launch -----------------------------------------------------------------------------------------------------
    def contact_rows(self, q: ca.SX) -> ca.SX:
        """What the ground holds of both feet: place of the toe, its edge level and straight; flat feet do not pitch.

        Short legs leave the base no roll and no yaw.
        """
        s, rows, half = SpatialState(self.model, q, q, q), [], (self.robot.foot.toe - self.robot.foot.heel) / 2
        for side, (body, own) in enumerate(zip(self.feet, self._foot_axes, strict=True)):
            axes = s.rotation(body) @ ca.DM(own)
            place = s.point(body, self.toes[side]) - ca.DM(self.places[side] + np.array([half, 0.0, 0.0]))
            rows += [place[self.held[side]], axes[2, 1], axes[0, 1]]
            if self.contact is Contact.FLAT:
                rows.append(axes[2, 0])
        return ca.vertcat(*rows, *([q[3], q[4]] if self.short else []))

    def pitches(self, q: ca.SX) -> ca.SX:
        """Sines of the feet's pitch (2,); positive is heel up."""
        s = SpatialState(self.model, q, q, q)
        return ca.vertcat(
            *(-(s.rotation(k) @ ca.DM(own))[2, 0] for k, own in zip(self.feet, self._foot_axes, strict=True))
        )

    def launch_rows(self) -> list[Term]:
        """Feet in their places; loads of the feet; take-off."""
        lim = self.limits
        rows = [row("feet in place", "ours", "m, 1", lambda p: self.contact_rows(p.q), scale=0.1, skip=(1, 0))]
        if self.contact is Contact.FLAT:

            def loads(p):
                return ca.vertcat(*(sum(self.foot_force(p, side))[2] for side in (0, 1)))

            def heels(p):
                return rates(self.pitches, p.q, p.v)[0]

            least = lim.foot_share * self.mg
            rows.append(row("load of each foot", "ours", "N", loads, least, np.inf, scale=self.mg))
            rows.append(row("heels still at rest", "ours", "rad/s", heels, at="end"))
            return rows

        def accelerations(p):
            return rates(self.contact_rows, p.q, p.v, p.a)[1]

        heel = row(
            "heels not below ground",
            "WL-K2",
            "1",
            lambda p: self.pitches(p.q),
            0.0,
            np.sin(lim.heel_up_rad),
            skip=(1, 0),
        )
        speed = row(
            "vertical take-off speed",
            "SL-E2, WL-E1",
            "m/s",
            lambda p: self.state(p).com_velocity[2] - p.p.takeoff_speed,
            at="end",
        )
        still = row("toes still at take-off", "ours", "m/s^2, 1/s^2", accelerations, scale=10.0, at="end")
        return [*rows, heel, speed, still]

    # flight -----------------------------------------------------------------------------------------------------
    def flight_rows(self) -> list[Term]:
        """Flight: all three components of L stay, soles and body clear the ground."""
        lim = self.limits

        def kept(p):
            return self.state(p).angular_momentum - ca.vertcat(p.c.L_x, p.c.L_y, p.c.L_z)

        def rate(p):
            return self.needed(p)[1] - ca.cross(self.state(p).com_from_base, self.needed(p)[0])

        def clearance(p):
            shape, places = (4 * p.s * (1 - p.s)) ** 3, []
            for body, corners in zip(self.feet, self.sole_corners, strict=True):
                places += [self.at(p, body, c) for c in corners]
            return ca.vertcat(*(x[2] - self.ground(p, x) - lim.clearance_m * shape for x in places))

        return [
            row("angular momentum", "WF-D1, three components", "kg m^2/s", kept),
            row("moment at take-off", "WF-D1", "N m", rate, scale=20.0, at="start"),
            cost("momentum rate", "WF-D1, between the nodes", "N m", rate, self.weights.momentum_rate),
            row("sole clearance", "ours", "m", clearance, *POSITIVE, scale=0.1, skip=(1, 1)),
        ]

    def ground(self, p: Point, x: ca.SX) -> ca.SX:
        """Height of the surface below a point."""
        return p.p.platform * (1 + ca.tanh((ca.dot(p.p.along, x[:2]) - p.p.edge) / 0.015)) / 2

    def body_clearance(self) -> Term:
        """Knees and hands stay away from the ground."""

        def heights(p):
            places = [self.at(p, body, local) for body, local in self.limb_points]
            return ca.vertcat(*(x[2] - self.ground(p, x) for x in places))

        return row("body clearance", "ours", "m", heights, self.limits.body_clearance_m, np.inf, scale=0.1)

    def link_distances(self) -> list[Term]:
        """Legs and trunk stay apart from each other wherever they can meet."""
        if not self.pairs:
            return []

        def gaps(p):
            return ca.vertcat(*(pair.gap(self.state(p)) for pair in self.pairs))

        return [row("distances between links", "ours", "m", gaps, self.limits.link_distance_m, np.inf, scale=0.1)]

    @property
    def limb_points(self) -> list[tuple[int, np.ndarray]]:
        """Knees, and the far ends of the bodies that end a limb but are no feet: (body, place in it)."""
        points = [(1 + k, np.zeros(3)) for k, _, _ in self.knees]
        carrying = {b.parent for b in self.model.bodies} | set(self.feet)
        for box in boxes(self.robot, self.model)[0]:
            if box.body not in carrying:
                along = box.axes[:, np.argmax(box.half)] * box.half.max()
                points.append((box.body, box.centre + along * (1.0 if along @ box.centre > 0 else -1.0)))
        return points

    def bend(self, p: Point) -> ca.SX:
        """Flexion of both knees (2,) [rad]."""
        first = len(self.coordinates) - self.model.joints
        return ca.vertcat(*(sign * p.q[first + k] + angle for k, sign, angle in self.knees))

    def turned(self, p: Point, x: ca.SX | np.ndarray, way: int = 1) -> ca.SX:
        """A vector (3,) turned by the asked yaw, or back."""
        c, s = ca.cos(p.p.yaw), way * ca.sin(p.p.yaw)
        return ca.vertcat(c * x[0] - s * x[1], s * x[0] + c * x[1], x[2])

    def feet_at_goal(self, p: Point) -> ca.SX:
        """What is left between both feet and their new places: place (3,), pitch, roll, heading of each."""
        rows = []
        for side, body in enumerate(self.feet):
            goal = self.turned(p, self.places[side]) + ca.vertcat(p.p.distance, p.p.side, p.p.platform)
            axes, ahead = self.foot_axes(p, side), self.turned(p, np.array([1.0, 0.0, 0.0]))
            off = self.at(p, body, self.soles[side]) - goal
            if self.short:
                off = self.turned(p, off, -1)[self.held[side]]
            rows += [off, axes[2, 0], axes[2, 1], ca.dot(ahead, axes[:, 1])]
        return ca.vertcat(*rows, *([p.q[0] - p.p.yaw, p.q[1]] if self.short else []))

    def capture(self, p: Point) -> ca.SX:
        """How far the middle between the soles is off the place (2,) where it catches the robot [m]."""
        lim = self.limits
        middle = sum(self.at(p, body, x) for body, x in zip(self.feet, self.soles, strict=True)) / 2
        ahead = self.turned(p, np.array([lim.capture_offset_m, 0.0, 0.0]))
        speed = ca.vertcat(p.c.vel_x, p.c.vel_y, 0)
        return (middle - self.com(p) - ahead - lim.capture_slope_s * speed)[:2]

    def sole_speeds(self, p: Point) -> ca.SX:
        """Velocity (3, 2) of the middle of each sole in flight [m/s]."""
        state, gone = self.state(p), p.p.gravity * p.time
        base = ca.vertcat(p.c.vel_x, p.c.vel_y, p.c.vel_z - gone) - state.com_velocity
        return ca.horzcat(*(base + state.point_velocity(*sole) for sole in zip(self.feet, self.soles, strict=True)))

    def sliding(self, p: Point) -> ca.SX:
        """By how much (8,) soles come down steeply enough to stick, each way along x and y [m/s]."""
        speeds = self.sole_speeds(p)
        return ca.vec(ca.mtimes(PYRAMID, speeds[:2, :]) - self.limits.touchdown_slope * ca.repmat(speeds[2, :], 4, 1))

    def capture_rows(self) -> Term:
        """Where the soles meet the ground, so that the robot can be caught."""
        lim, moment, window = self.limits, self.limits.capture_moment, self.limits.capture_window_m
        if moment is None:
            return row(
                "capture window", "ours; replaces WF-E2", "m", self.capture, -window, window, at="end", scale=0.1
            )

        def about_soles(p):
            middle = sum(self.at(p, body, x) for body, x in zip(self.feet, self.soles, strict=True)) / 2
            speed = ca.vertcat(p.c.vel_x, p.c.vel_y, p.c.vel_z - p.p.gravity * p.time)
            spin = ca.vertcat(p.c.L_x, p.c.L_y, p.c.L_z)
            return (spin + self.model.mass * ca.cross(self.com(p) - middle, speed))[:2]

        words = "capture by momentum", "ours, for flips; replaces WF-E2", "kg m^2/s"
        return row(*words, about_soles, -lim.capture_moment, lim.capture_moment, at="end", scale=10.0)

    def touchdown_rows(self) -> list[Term]:
        """Touchdown: both feet in their new places, flat; posture, rates, and where the soles are against the CoM."""
        lim, rate, foot = self.limits, self.limits.touchdown_joint_rate, self.limits.touchdown_foot_rate
        trunk = lim.touchdown_trunk_rate

        def within(rates, vertical):
            """Bounds on rates, those about the vertical wider where more than half a turn has to be stopped."""

            def most(parameters):
                more = max(0.0, abs(float(parameters["yaw"])) / np.pi - 1)
                return rates + lim.touchdown_turning * more * np.array(vertical)

            return (lambda parameters: -most(parameters)), most

        def spins(p):
            return ca.vertcat(*(self.state(p).spin(body) for body in self.feet))

        def attitude(p):
            return p.q[:3] - ca.vertcat(p.p.yaw, 0, p.p.rotation)

        def end(name, equation, unit, of, lower=0.0, upper=0.0, **how):
            return row(name, equation, unit, of, lower, upper, at="end", **how)

        low = -lim.touchdown_yaw, -lim.touchdown_roll, lim.touchdown_pitch[0]
        high = lim.touchdown_yaw, lim.touchdown_roll, lim.touchdown_pitch[1]
        return [
            end("touchdown of the feet", "WL-E1, SL-E1: place and heading", "m, 1", self.feet_at_goal, scale=0.1),
            end("foot rates at touchdown", "ours", "rad/s", spins, *within(foot, [0, 0, 1, 0, 0, 1])),
            end("soles that stick at touchdown", "ours: friction", "m/s", self.sliding, *POSITIVE),
            end("attitude at touchdown", "ours", "rad", attitude, low, high),
            end("knees at touchdown", "ours: stroke", "rad", self.bend, *lim.touchdown_knee),
            end("joint rates at touchdown", "WF-E1, relaxed", "rad/s", lambda p: p.v[3:], -rate, rate),
            end("trunk rates at touchdown", "ours", "rad/s", lambda p: p.v[:3], *within(trunk, [1, 0, 0])),
            self.capture_rows(),
        ]
