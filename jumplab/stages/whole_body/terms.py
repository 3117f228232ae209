"""The named costs and constraints of stage 3, as functions of one instant; pure, nothing here solves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np

from jumplab.models.planar import PlanarState
from jumplab.ocp.problem import Point, Term
from jumplab.robot import Robot
from jumplab.robot.reach import rod_of
from jumplab.robot.stance import stance_angles
from jumplab.stages.whole_body.settings import JERK_SCALE, LATE_SHARE, RESERVE_SHARE, Contact, Limits, Weights
from jumplab.task import GRAVITY

POSITIVE = 0.0, np.inf


def relative(links: ca.SX | np.ndarray) -> ca.SX | np.ndarray:
    """Hip, knee, ankle, shoulder and trunk from the rates, accelerations or jerks of the five links, (5,) or (5, n)."""
    foot, shank, thigh, trunk, arm = (links[i] for i in range(5))
    rows = thigh - trunk, shank - thigh, foot - shank, arm - trunk, trunk
    return np.array(rows) if isinstance(links, np.ndarray) else ca.vertcat(*rows)


def cost(name: str, equation: str, unit: str, of: Callable, weight: float, at: str = "node") -> Term:
    """A cost on what ``of`` makes of a :class:`Point`."""
    return Term(name, equation, unit, at, of, weight=weight)


def row(
    name: str, equation: str, unit: str, of: Callable, lower: object = 0.0, upper: object = 0.0, at: str = "node", **how
) -> Term:
    """A constraint on it: an equality, or from ``lower`` to ``upper``; ``how`` as in :class:`Term`."""
    return Term(name, equation, unit, at, of, None, lower, upper, **how)


def everywhere(*terms: Term) -> list[Term]:
    """Constraints at the nodes, and the same in the middle of every interval."""
    return [*terms, *(replace(t, name=f"{t.name} (mid)", at="mid", skip=(0, 0)) for t in terms)]


class WholeBodyTerms:
    """Terms of one phase, which is a mode of contact, and the expressions that they share."""

    def __init__(self, robot: Robot, limits: Limits, weights: Weights, contact: Contact):
        self.model, self.limits, self.weights, self.contact = robot.sagittal, limits, weights, contact
        self.flying = contact is Contact.FLIGHT
        self.mg = self.model.total_mass * GRAVITY  # nominal size of forces
        self.stance_inertia = self.model.total_mass * rod_of(robot, stance_angles(robot))[3] ** 2  # [kg m^2]

    # model on a point -------------------------------------------------------------------------------------------
    def links(self, x: ca.SX) -> ca.SX:
        """All five links (5,) from a phase's coordinates or their derivatives; a flat foot does not turn."""
        return ca.vertcat(0, x) if self.contact is Contact.FLAT else x

    def state(self, p: Point) -> PlanarState:
        """The five links at this point, rooted at the toe; made once per point."""
        if "state" not in p.memo:
            p.memo["state"] = PlanarState(self.model, *(self.links(x) for x in (p.q, p.v, p.a)), p.p.gravity)
        return p.memo["state"]

    def wrench(self, p: Point) -> ca.SX:
        """The ground's wrench (3,): F_x, F_z [N], moment about the toe [N m]; made once per point."""
        if "wrench" not in p.memo:
            p.memo["wrench"] = self.state(p).ground_wrench()
        return p.memo["wrench"]

    def torques(self, p: Point) -> ca.SX:
        """Motor torques (4,) of both sides together [N m]; made once per point."""
        if "torques" not in p.memo:
            p.memo["torques"] = self.state(p).torques(None if self.flying else (0.0, 0.0))
        return p.memo["torques"]

    def toe(self, p: Point) -> ca.SX:
        """Place of the toe (2,) [m]: the origin in launch; in flight the CoM's parabola less the CoM from the toe."""
        if not self.flying:
            return ca.SX.zeros(2)
        t, c = p.time, p.c
        return ca.vertcat(c.com_x + c.vel_x * t, c.com_z + c.vel_z * t - p.p.gravity * t * t / 2) - self.state(p).com

    def ground(self, p: Point, x: ca.SX) -> ca.SX:
        """Height of the surface below x: a step of the platform's height at the edge, smoothed."""
        return p.p.platform * (1 + ca.tanh((x - p.p.edge) / self.limits.edge_smoothing_m)) / 2

    # all phases -------------------------------------------------------------------------------------------------
    def smoothness(self) -> list[Term]:
        """Costs on joint accelerations and jerk (WL-J2, WF-J2), and ours on torques."""
        w, s, origin = self.weights, self.state, "WL-J2, WF-J2"
        return [
            cost("joint acceleration", origin, "rad/s^2", lambda p: relative(s(p).accels), w.joint_acceleration),
            cost("jerk", origin, "rad/s^3", lambda p: p.j, w.jerk, "mid"),
            cost("torque", "ours: effort", "N m", self.torques, w.torque),
        ]

    def limits_of_joints(self) -> list[Term]:
        """Range, speed, torque, and torque against speed of every joint; all ours."""
        m, s, lim = self.model, self.state, self.limits
        speed, peak, margin = lim.speed_share * m.speed, lim.torque_share * m.effort, lim.range_margin_rad
        slope = m.effort / (m.no_load_speed - m.corner_speed) * lim.torque_share
        top = np.tile(slope * m.no_load_speed, 2)

        def motor(p):
            tau, rate = self.torques(p), s(p).joint_rates
            return ca.vertcat(tau + ca.DM(slope) * rate, -tau - ca.DM(slope) * rate)

        line = row("torque-speed", "ours: motor line", "N m", motor, -np.inf, top, scale=100.0)
        return [
            row("joint range", "ours: stops", "rad", lambda p: s(p).joints, m.lower + margin, m.upper - margin),
            row("joint speed", "ours: limit", "rad/s", lambda p: s(p).joint_rates, -speed, speed, scale=10.0),
            *everywhere(row("joint torque", "ours: limit", "N m", self.torques, -peak, peak, scale=100.0)),
            *(everywhere(line) if lim.envelope_between else [line]),
        ]

    def jerk_steps(self) -> list[Term]:
        """Jerks of joints and trunk, carried on in the states z, do not jump farther than they may."""
        most, how = self.limits.jerk_step, {"at": "interval", "scale": JERK_SCALE}

        def carried(left, right, step):
            return right.z - relative(self.links(left.j))

        def jump(left, right, step):
            return relative(self.links(left.j)) - left.z

        return [
            row("jerk carried on", "ours: flips", "rad/s^3", carried, identity=True, **how),
            row("jerk step", "ours: flips", "rad/s^3", jump, -most, most, **how),
        ]

    def body_clearance(self) -> Term:
        """Hand, mid-arm and knee (in a flip, hip and shoulder too) stay away from ground and platform's edge."""
        lim = self.limits
        names = lim.flight_clear if self.flying else ("hand", "mid-arm", "knee")
        least = lim.flight_clearance_m if self.flying else lim.hand_clearance_m

        def heights(p):
            toe = self.toe(p)
            points = [toe + self.state(p).point(name) for name in names]
            return ca.vertcat(*(x[1] - self.ground(p, x[0] + lim.edge_clearance_m) for x in points))

        return row("body clearance", "ours", "m", heights, least, np.inf, scale=0.1)

    def tracking(self) -> list[Term]:
        """Stage 1's trajectories as references, at the same share of each phase (WL-J1, WL-J3, WF-J1, WF-J2).

        Heel up, the heel stays quiet besides, and L at take-off is stage 1's (WL-D1).
        """
        w, s, origin, spin = self.weights, self.state, "WF-J1" if self.flying else "WL-J1", "WL-D1, as a cost on L"
        rates = w.track_flight_inertia_rate if self.flying else w.track_inertia_rate
        inertia, rate = (float(x / self.stance_inertia**2) for x in (w.track_inertia, rates))
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
        if self.contact is Contact.TOE:
            rows.append(cost("heel velocity", "WL-J3", "m/s", lambda p: s(p).point("heel", 1)[1], w.heel_velocity))
            rows.append(row("L at take-off", "WL-D1", "kg m^2/s", self._momentum_kept, *POSITIVE, at="end"))
        return rows

    def _momentum_kept(self, p: Point) -> ca.SX:
        """What is left of the slack between L and stage 1's at take-off, on both sides."""
        slack = ca.fmax(self.limits.momentum_share * ca.fabs(p.p.momentum), self.limits.momentum_slack)
        difference = self.state(p).angular_momentum - p.p.momentum
        return ca.vertcat(slack - difference, slack + difference)

    # launch -----------------------------------------------------------------------------------------------------
    def ground_contact(self) -> list[Term]:
        """The ground only pushes, within the friction cone; the body stays clear of it. All ours."""
        mu, how = self.limits.friction, {"scale": self.mg, "skip": (0, 1)}
        least = self.limits.least_push if self.contact is Contact.FLAT else 0.0

        def push(p):
            return self.wrench(p)[1] - least * self.model.total_mass * p.p.gravity if least else self.wrench(p)[1]

        def cone(p):
            f = self.wrench(p)
            return ca.vertcat(mu * f[1] - f[0], mu * f[1] + f[0])

        up = row("unilateral", "ours", "N", push, *POSITIVE, **how)
        return [*everywhere(up, row("friction", "ours", "N", cone, *POSITIVE, **how)), self.body_clearance()]

    def flat_rows(self) -> list[Term]:
        """Foot flat: the CoP stays within the sole (SL-P2 for the whole body)."""
        behind, how = -self.model.heel[0] - self.limits.cop_margin_m, {"scale": 0.1 * self.mg, "skip": (0, 1)}
        reserve, share, origin = self.limits.cop_reserve_m, RESERVE_SHARE, "ours; SL-P2 for the whole body"

        def cop(p):
            f = self.wrench(p)
            rows = ca.vertcat(f[2], behind * f[1] - f[2])  # CoP behind the toe, ahead of the heel
            if not reserve:
                return rows
            return rows - reserve * f[1] * ca.fmax(0, ca.fmin(1, ca.fmin(p.s / share[0], (1 - p.s) / share[1])))

        return everywhere(row("CoP in the sole", origin, "N m", cop, *POSITIVE, **how))

    def toe_rows(self) -> list[Term]:
        """Heel up: the CoP is at the toe; at take-off no wrench is left, and the CoM has its vertical speed."""
        size, origin, f = 0.1 * self.mg, "SL-E3, E4, E6 for the whole body", self.wrench

        def speed(p):
            return self.state(p).com_velocity[1] - p.p.takeoff_speed

        return [
            *everywhere(row("CoP at the toe", "ours: heel up", "N m", lambda p: f(p)[2], scale=size, skip=(0, 1))),
            row("zero wrench at take-off", origin, "N", f, at="end", scale=size),
            row("vertical take-off speed", "SL-E2, WL-E1", "m/s", speed, at="end"),
        ]

    # flight -----------------------------------------------------------------------------------------------------
    def flight_rows(self) -> list[Term]:
        """Flight: angular momentum stays (WF-D1), the sole clears the ground, the body too, and the touchdown."""
        lim, model = self.limits, self.model

        def momentum_rate(p):
            return self.state(p).angular_momentum_rate

        def clearance(p):
            toe, shape = self.toe(p), (4 * p.s * (1 - p.s)) ** 3
            rows = []
            for share in (0.0, 0.25, 0.5, 0.75, 1.0):
                point = toe + self.state(p).point(model.point_arms(0, share * model.heel))
                rows.append(point[1] - self.ground(p, point[0]) - lim.clearance_m * shape)
            return ca.vertcat(*rows)

        return [
            *everywhere(row("angular momentum", "WF-D1", "N m", momentum_rate, scale=20.0, skip=(1, 0))),
            row("sole clearance", "ours", "m", clearance, *POSITIVE, scale=0.1, skip=(1, 1)),
            self.body_clearance(),
            *self.opening_rows(),
            *self.touchdown_rows(),
            *self.capture_rows(),
        ]

    def opening_rows(self) -> list[Term]:
        """If asked, joints open a tuck so slowly that they could do so later and faster; it sets in gradually."""
        if self.limits.opening_speed_share >= self.limits.speed_share:
            return []
        most = self.limits.opening_speed_share * self.model.speed

        def rates(p):
            begun = ca.fmax(0, ca.fmin(1, 10 * (p.s - 1 + LATE_SHARE)))
            return begun * self.state(p).joint_rates

        return [row("opening speed", "ours, for flips", "rad/s", rates, -most, most, scale=10.0, skip=(1, 0))]

    def touchdown_rows(self) -> list[Term]:
        """Touchdown: place, posture and rates of the landing."""
        lim, s, stroke, foot = (
            self.limits,
            self.state,
            self.limits.touchdown_ankle_stroke,
            self.limits.touchdown_foot_rate,
        )
        rate, trunk = lim.touchdown_joint_rate, lim.touchdown_trunk_rate

        def end(name, equation, unit, of, lower=0.0, upper=0.0):
            return row(f"{name} at touchdown", equation, unit, of, lower, upper, at="end")

        def place(p):
            return self.toe(p) - ca.vertcat(p.p.distance, p.p.platform)

        rows = [
            row("touchdown place", "WL-E1 and SL-E1: jump length; ours: height", "m", place, at="end"),
            end("foot flat", "ours", "rad", lambda p: s(p).angles[0] - p.p.rotation),
            end("knee", "ours: stroke", "rad", lambda p: s(p).joints[1], *lim.touchdown_knee),
        ]
        if stroke is not None:
            least, why = self.model.lower[2] + stroke, "ours, for flips: stroke"
            rows.append(end("ankle", why, "rad", lambda p: s(p).joints[2], least, np.inf))
        rows += [
            end("trunk", "ours", "rad", lambda p: s(p).angles[3] - p.p.rotation, *lim.touchdown_trunk),
            end("joint rates", "WF-E1, relaxed", "rad/s", lambda p: s(p).joint_rates, -rate, rate),
            end("trunk rate", "ours", "rad/s", lambda p: s(p).rates[3], -trunk, trunk),
        ]
        if foot is not None:
            why = "ours: toe and heel meet the ground together"
            rows.append(end("foot rate", why, "rad/s", lambda p: s(p).rates[0], -foot, foot))
        return rows

    def capture_rows(self) -> list[Term]:
        """Where the soles meet the ground, so that the robot can be caught; of a flip by its direction."""
        lim, model, s = self.limits, self.model, self.state
        sole, momentum, toes = model.point_arms(0, model.sole_center), lim.capture_moment, lim.capture_beyond_toes_m

        def window(p):
            ahead = s(p).point(sole)[0] - s(p).com[0]
            return ahead - lim.capture_offset_m - lim.capture_slope_s * p.c.vel_x

        def speed(p):
            return p.c.vel_x, p.c.vel_z - p.p.gravity * p.time

        def by_momentum(p):
            arm, v = s(p).com - s(p).point(sole), speed(p)
            return s(p).angular_momentum + model.total_mass * (arm[1] * v[0] - arm[0] * v[1])

        def beyond_toes(p):
            arm, v = s(p).com - s(p).point(model.point_arms(0, 0.0)), speed(p)
            left = s(p).angular_momentum / model.total_mass + arm[1] * v[0] - arm[0] * v[1]
            return arm[0] + left / ca.sqrt(p.p.gravity * arm[1]) + lim.capture_beyond_slope_s * p.p.takeoff_speed

        def one_way(of, sign, bounds):  # in flips of the other direction the row is a constant inside its bounds
            return lambda p: ca.if_else(sign * p.p.rotation > 0, of(p), sum(bounds) / 2)

        def end(name, flips, unit, of, bounds, scale):
            return row(name, f"ours{flips}; replaces WF-E2", unit, of, *bounds, at="end", scale=scale)

        if momentum is None:
            return [end("capture window", "", "m", window, lim.capture_window_m, 0.1)]
        ahead, back = one_way(by_momentum, 1, momentum), one_way(beyond_toes, -1, toes)
        return [
            end("capture by momentum", ", for flips forward", "kg m^2/s", ahead, momentum, 10.0),
            end("capture beyond the toes", ", for flips backward", "m", back, toes, 0.1),
        ]
