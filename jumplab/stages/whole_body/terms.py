"""The named costs and constraints of stage 3, as functions of one instant; pure, nothing here solves."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from jumplab.models.planar import PlanarState
from jumplab.ocp.problem import Point, Term
from jumplab.robot import Robot
from jumplab.stages.whole_body.settings import Limits, Weights
from jumplab.task import GRAVITY

JERK_SCALE = 2000.0  # [rad/s^3] our choice: as in SCALES of the problem
RESERVE_SHARE = 0.1, 0.15  # our choice: of the flat-foot phase, over which the CoP's reserve comes and goes


class WholeBodyTerms:
    """Expressions shared by the terms; pure, no numbers but the robot's and the limits'."""

    def __init__(self, robot: Robot, limits: Limits, weights: Weights):
        self.model, self.limits, self.weights = robot.sagittal, limits, weights
        self.mg = self.model.total_mass * GRAVITY

    # model on a point -------------------------------------------------------------------------------------------
    def state(self, p: Point) -> PlanarState:
        """The five links at this point, rooted at the toe; made once per point."""
        if "state" not in p.memo:
            angles, rates, accels = p.q, p.v, p.a
            if p.q.numel() == 4:  # flat foot
                angles, rates, accels = (ca.vertcat(0, x) for x in (angles, rates, accels))
            p.memo["state"] = PlanarState(self.model, angles, rates, accels, p.p.gravity)
        return p.memo["state"]

    def wrench(self, p: Point) -> ca.SX:
        """The ground's wrench (3,): F_x, F_z [N], moment about the toe [N m]; made once per point."""
        if "wrench" not in p.memo:
            p.memo["wrench"] = self.state(p).ground_wrench()
        return p.memo["wrench"]

    def torques(self, p: Point, flying: bool) -> ca.SX:
        """Joint torques (4,) of both sides together [N m]; made once per point."""
        if "torques" not in p.memo:
            p.memo["torques"] = self.state(p).torques(None if flying else (0.0, 0.0))
        return p.memo["torques"]

    def ballistic_com(self, p: Point) -> ca.SX:
        """Place of the CoM (2,) on its parabola [m]."""
        t = p.time
        return ca.vertcat(p.c.com_x + p.c.vel_x * t, p.c.com_z + p.c.vel_z * t - p.p.gravity * t * t / 2)

    def ballistic_velocity(self, p: Point) -> ca.SX:
        """Velocity of the CoM (2,) on its parabola [m/s]."""
        return ca.vertcat(p.c.vel_x, p.c.vel_z - p.p.gravity * p.time)

    def toe(self, p: Point) -> ca.SX:
        """Place of the toe (2,) in flight [m]: the parabola less the CoM from the toe."""
        return self.ballistic_com(p) - self.state(p).com

    def ground(self, p: Point, x: ca.SX) -> ca.SX:
        """Height of the surface below x: a step of the platform's height at the edge, smoothed."""
        return p.p.platform * (1 + ca.tanh((x - p.p.edge) / self.limits.edge_smoothing_m)) / 2

    # terms ------------------------------------------------------------------------------------------------------
    def limits_of_joints(self, flying: bool) -> list[Term]:
        """Range, speed, torque, and torque against speed of every joint; all ours."""
        m, lim = self.model, self.limits
        speed = lim.speed_share * m.speed
        slope = m.effort / (m.speed - m.corner_speed) * lim.torque_share
        top = slope * m.speed

        def envelope(p):
            tau, rate = self.torques(p, flying), self.state(p).joint_rates
            return ca.vertcat(tau + ca.DM(slope) * rate, -tau - ca.DM(slope) * rate)

        margin = lim.range_margin_rad
        peak = lim.torque_share * m.effort
        rows = [
            Term("joint range", "ours: stops", "rad", "node", lambda p: self.state(p).joints, lower=m.lower + margin,
                 upper=m.upper - margin),
            Term("joint speed", "ours: limit", "rad/s", "node", lambda p: self.state(p).joint_rates, lower=-speed,
                 upper=speed, scale=10.0),
        ]  # fmt: skip
        for at in ("node", "mid"):
            suffix = "" if at == "node" else " (mid)"
            rows.append(Term(f"joint torque{suffix}", "ours: limit", "N m", at, lambda p: self.torques(p, flying),
                             lower=-peak, upper=peak, scale=100.0))  # fmt: skip
        rows.append(Term("torque-speed", "ours: motor line", "N m", "node", envelope, lower=-np.inf,
                         upper=np.concatenate([top, top]), scale=100.0))  # fmt: skip
        if lim.envelope_between:
            rows.append(replace(rows[-1], name="torque-speed (mid)", at="mid"))
        return rows

    @staticmethod
    def relative(x: ca.SX) -> ca.SX:
        """Hip, knee, ankle, shoulder and trunk (5,) from absolute links' accelerations or jerks, (5,) or (4,)."""
        x = ca.vertcat(0, x) if x.shape[0] == 4 else x
        return ca.vertcat(x[2] - x[3], x[1] - x[2], x[0] - x[1], x[4] - x[3], x[3])

    def jerk_steps(self) -> list[Term]:
        """Jerks of joints and trunk, carried on in the states z, do not jump farther than they may."""
        most = self.limits.jerk_step

        def carried(left, right, step):
            return right.z - self.relative(left.j)

        def jump(left, right, step):
            return self.relative(left.j) - left.z

        return [
            Term("jerk carried on", "ours: flips", "rad/s^3", "interval", carried, scale=JERK_SCALE, identity=True),
            Term("jerk step", "ours: flips", "rad/s^3", "interval", jump, lower=-most, upper=most, scale=JERK_SCALE),
        ]

    def smoothness(self, flying: bool) -> list[Term]:
        """Costs on joint accelerations and jerk (WL-J2, WF-J2), and ours on torques."""
        w = self.weights

        def accelerations(p):
            return self.relative(self.state(p).accels)

        return [
            Term("joint acceleration", "WL-J2, WF-J2", "rad/s^2", "node", accelerations, weight=w.joint_acceleration),
            Term("jerk", "WL-J2, WF-J2", "rad/s^3", "mid", lambda p: p.j, weight=w.jerk),
            Term("torque", "ours: effort", "N m", "node", lambda p: self.torques(p, flying), weight=w.torque),
        ]

    def ground_contact(self) -> list[Term]:
        """The ground only pushes, within the friction cone; the body stays clear of it. All ours."""
        mu, mg, least = self.limits.friction, self.mg, self.limits.least_push

        def push(p):
            flat = p.q.numel() == 4
            return self.wrench(p)[1] - least * mg if least and flat else self.wrench(p)[1]

        def cone(p):
            f = self.wrench(p)
            return ca.vertcat(mu * f[1] - f[0], mu * f[1] + f[0])

        rows = []
        for at in ("node", "mid"):
            suffix = "" if at == "node" else " (mid)"
            last = (0, 1) if at == "node" else (0, 0)
            rows += [
                Term(f"unilateral{suffix}", "ours", "N", at, push, lower=0.0, upper=np.inf,
                     scale=mg, skip=last),
                Term(f"friction{suffix}", "ours", "N", at, cone, lower=0.0, upper=np.inf, scale=mg, skip=last),
            ]  # fmt: skip
        return [*rows, self.body_clearance(False)]

    def body_clearance(self, flying: bool) -> Term:
        """Hand, mid-arm and knee (in a flip, hip and shoulder too) stay away from ground and platform's edge."""
        lim = self.limits
        names = lim.flight_clear if flying else ("hand", "mid-arm", "knee")
        least = lim.flight_clearance_m if flying else lim.hand_clearance_m

        def heights(p):
            toe = self.toe(p) if flying else ca.SX.zeros(2)
            points = [toe + self.state(p).point(name) for name in names]
            return ca.vertcat(*(x[1] - self.ground(p, x[0] + lim.edge_clearance_m) for x in points))

        return Term("body clearance", "ours", "m", "node", heights, lower=least, upper=np.inf, scale=0.1)

    def flat_rows(self) -> list[Term]:
        """Foot flat: the CoP stays within the sole (SL-P2 for the whole body)."""
        heel, margin, mg = self.model.heel[0], self.limits.cop_margin_m, self.mg
        reserve, share = self.limits.cop_reserve_m, RESERVE_SHARE

        def cop(p):
            f = self.wrench(p)
            rows = ca.vertcat(f[2], (-heel - margin) * f[1] - f[2])  # CoP behind the toe, ahead of the heel
            if not reserve:
                return rows
            return rows - reserve * f[1] * ca.fmax(0, ca.fmin(1, ca.fmin(p.s / share[0], (1 - p.s) / share[1])))

        rows = []
        for at in ("node", "mid"):
            suffix = "" if at == "node" else " (mid)"
            last = (0, 1) if at == "node" else (0, 0)
            rows.append(Term(f"CoP in the sole{suffix}", "ours; SL-P2 for the whole body", "N m", at, cop, lower=0.0,
                             upper=np.inf, scale=0.1 * mg, skip=last))  # fmt: skip
        return rows

    def toe_rows(self) -> list[Term]:
        """Heel up: the CoP is at the toe; at take-off no wrench is left, and the CoM has its vertical speed."""
        mg = self.mg
        return [
            Term("CoP at the toe", "ours: heel up", "N m", "node", lambda p: self.wrench(p)[2], scale=0.1 * mg,
                 skip=(0, 1)),
            Term("CoP at the toe (mid)", "ours: heel up", "N m", "mid", lambda p: self.wrench(p)[2], scale=0.1 * mg),
            Term("zero wrench at take-off", "SL-E3, E4, E6 for the whole body", "N", "end", self.wrench,
                 scale=0.1 * mg),
            Term("vertical take-off speed", "SL-E2, WL-E1", "m/s", "end",
                 lambda p: self.state(p).com_velocity[1] - p.p.takeoff_speed),
        ]  # fmt: skip

    def tracking(self, flying: bool) -> list[Term]:
        """Stage 1's trajectories as references, at the same share of each phase (WL-J1, WL-J3, WF-J1, WF-J2)."""
        w = self.weights
        rows = [
            Term("track inertia", "WF-J1" if flying else "WL-J1", "kg m^2", "node",
                 lambda p: self.state(p).inertia - p.ref.rho, weight=w.track_inertia),
            Term("track inertia rate", "WF-J1" if flying else "WL-J1", "kg m^2/s", "node",
                 lambda p: self.state(p).inertia_rate - p.ref.rho_rate, weight=w.track_inertia_rate),
        ]  # fmt: skip
        if flying:
            rows.append(Term("ankle rate", "WF-J2", "rad/s", "node", lambda p: self.state(p).joint_rates[2],
                             weight=w.ankle_rate))  # fmt: skip
        else:
            rows += [
                Term("track velocity", "WL-J1", "m/s", "node", lambda p: self.state(p).com_velocity - p.ref.velocity,
                     weight=w.track_velocity),
                Term("track momentum", "WL-D1, as a cost on L", "kg m^2/s", "node",
                     lambda p: self.state(p).angular_momentum - p.ref.L, weight=w.track_momentum),
            ]  # fmt: skip
        return rows

    def toe_tracking(self) -> list[Term]:
        """Heel up: references as in :meth:`tracking`, a quiet heel (WL-J3), and stage 1's L at take-off (WL-D1)."""
        w, lim = self.weights, self.limits

        def momentum(p):
            slack = ca.fmax(lim.momentum_share * ca.fabs(p.p.momentum), lim.momentum_slack)
            difference = self.state(p).angular_momentum - p.p.momentum
            return ca.vertcat(slack - difference, slack + difference)

        return [
            *self.tracking(False),
            Term("heel velocity", "WL-J3", "m/s", "node", lambda p: self.state(p).point("heel", 1)[1],
                 weight=w.heel_velocity),
            Term("L at take-off", "WL-D1", "kg m^2/s", "end", momentum, lower=0.0, upper=np.inf),
        ]  # fmt: skip

    def flight_rows(self) -> list[Term]:
        """Flight: angular momentum stays (WF-D1), the sole clears the ground, the body too, and the touchdown."""
        lim, model = self.limits, self.model

        def l_rate(p):
            return self.state(p).angular_momentum_rate

        def clearance(p):
            toe, shape = self.toe(p), (4 * p.s * (1 - p.s)) ** 3
            rows = []
            for share in (0.0, 0.25, 0.5, 0.75, 1.0):
                point = toe + self.state(p).point(model.point_arms(0, share * model.heel))
                rows.append(point[1] - self.ground(p, point[0]) - lim.clearance_m * shape)
            return ca.vertcat(*rows)

        rows = [
            Term("angular momentum", "WF-D1", "N m", "node", l_rate, scale=20.0, skip=(1, 0)),
            Term("angular momentum (mid)", "WF-D1", "N m", "mid", l_rate, scale=20.0),
            Term("sole clearance", "ours", "m", "node", clearance, lower=0.0, upper=np.inf, scale=0.1, skip=(1, 1)),
        ]
        return [*rows, self.body_clearance(True), *self.touchdown_rows()]

    def touchdown_rows(self) -> list[Term]:
        """Touchdown: place, posture and rates of the landing, and the window in which the robot can be caught."""
        lim, model = self.limits, self.model
        rate, trunk = lim.touchdown_joint_rate, lim.touchdown_trunk_rate
        return [
            Term("touchdown place", "WL-E1 and SL-E1: jump length; ours: height", "m", "end",
                 lambda p: self.toe(p) - ca.vertcat(p.p.distance, p.p.platform)),
            Term("foot flat at touchdown", "ours", "rad", "end", lambda p: self.state(p).angles[0] - p.p.rotation),
            Term("knee at touchdown", "ours: stroke", "rad", "end", lambda p: self.state(p).joints[1],
                 lower=lim.touchdown_knee[0], upper=lim.touchdown_knee[1]),
            *([] if lim.touchdown_ankle_stroke is None else [
                Term("ankle at touchdown", "ours, for flips: stroke", "rad", "end", lambda p: self.state(p).joints[2],
                     lower=model.lower[2] + lim.touchdown_ankle_stroke, upper=np.inf)]),
            Term("trunk at touchdown", "ours", "rad", "end", lambda p: self.state(p).angles[3] - p.p.rotation,
                 lower=lim.touchdown_trunk[0], upper=lim.touchdown_trunk[1]),
            Term("joint rates at touchdown", "WF-E1, relaxed", "rad/s", "end", lambda p: self.state(p).joint_rates,
                 lower=-rate, upper=rate),
            Term("trunk rate at touchdown", "ours", "rad/s", "end", lambda p: self.state(p).rates[3], lower=-trunk,
                 upper=trunk),
            *([] if lim.touchdown_foot_rate is None else [
                Term("foot rate at touchdown", "ours: toe and heel meet the ground together", "rad/s", "end",
                     lambda p: self.state(p).rates[0], lower=-lim.touchdown_foot_rate, upper=lim.touchdown_foot_rate)]),
            *self.capture_rows(),
        ]  # fmt: skip

    def capture_rows(self) -> list[Term]:
        """Where the soles meet the ground, so that the robot can be caught; of a flip by its direction."""
        lim, model = self.limits, self.model
        sole = model.point_arms(0, model.sole_center)

        def capture(p):
            ahead = self.state(p).point(sole)[0] - self.state(p).com[0]
            return ahead - lim.capture_offset_m - lim.capture_slope_s * p.c.vel_x

        def moment(p):
            arm, speed = self.state(p).com - self.state(p).point(sole), self.ballistic_velocity(p)
            return self.state(p).angular_momentum + model.total_mass * (arm[1] * speed[0] - arm[0] * speed[1])

        def beyond_toes(p):
            arm, speed = self.state(p).com - self.state(p).point(model.point_arms(0, 0.0)), self.ballistic_velocity(p)
            left = self.state(p).angular_momentum / model.total_mass + arm[1] * speed[0] - arm[0] * speed[1]
            point = arm[0] + left / ca.sqrt(p.p.gravity * arm[1])
            return point + lim.capture_beyond_slope_s * p.p.takeoff_speed

        window, toes = lim.capture_moment, lim.capture_beyond_toes_m

        def one_way(row, sign, middle):  # in flips of the other direction the row is a constant inside its bounds
            return lambda p: ca.if_else(sign * p.p.rotation > 0, row(p), middle)

        if window is None:
            return [Term("capture window", "ours; replaces WF-E2", "m", "end", capture,
                         lower=lim.capture_window_m[0], upper=lim.capture_window_m[1], scale=0.1)]  # fmt: skip
        return [
            Term("capture by momentum", "ours, for flips forward; replaces WF-E2", "kg m^2/s", "end",
                 one_way(moment, 1, sum(window) / 2), lower=window[0], upper=window[1], scale=10.0),
            Term("capture beyond the toes", "ours, for flips backward; replaces WF-E2", "m", "end",
                 one_way(beyond_toes, -1, sum(toes) / 2), lower=toes[0], upper=toes[1], scale=0.1),
        ]  # fmt: skip
