"""Stage 3: whole-body launch and flight of the five-link robot (Sec. V of the paper), and the direct planner.

One nonlinear program over three phases: flat foot, toe (heel up), flight. Coordinates are the absolute angles of foot,
shank, thigh, trunk and arm, rooted at the toe: in launch the toe is the origin, so contact needs no equation; in flight
the CoM is the parabola and the toe follows from it, so only dL/dt = 0 remains. Term names carry the paper's equations;
what the paper leaves out is marked "ours".
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from jumplab.models.planar import PlanarState
from jumplab.robot import Robot
from jumplab.terms import Bound, Phase, Point, Problem, Term

LINKS = ("foot", "shank", "thigh", "trunk", "arm")


@dataclass(frozen=True)
class Limits:
    """What a plan may use of the robot and the ground; all our choice, since the paper prints no bound."""

    torque_share: float = 0.85  # of the peak torque: margin for model error and for feedback
    speed_share: float = 0.90  # of the speed limit
    friction: float = 0.45  # below the lowest friction that the trials simulate (0.5)
    cop_margin_m: float = 0.01  # inside the sole's edges while the foot is flat
    range_margin_rad: float = 0.03  # to the joint stops
    hand_clearance_m: float = 0.05  # above the ground in launch
    clearance_m: float = 0.03  # of toe and heel over the ground in mid-flight
    heel_up_rad: float = 0.9  # foot pitch at most during toe-off
    flat_s: tuple[float, float] = (0.25, 0.90)  # duration of the flat-foot phase
    toe_s: tuple[float, float] = (0.06, 0.15)  # duration of the toe phase
    touchdown_joint_rate: float = 2.0  # [rad/s] each: the landing starts from near rest
    touchdown_trunk_rate: float = 1.0  # [rad/s]
    touchdown_knee: tuple[float, float] = (0.7, 1.4)  # [rad]: stroke left to absorb the fall
    touchdown_trunk: tuple[float, float] = (0.0, 0.30)  # [rad]
    capture_offset_m: float = 0.02  # sole centre ahead of the CoM at touchdown: offset + slope v_x (measured)
    capture_slope_s: float = 0.13
    capture_window_m: tuple[float, float] = (-0.02, 0.02)


@dataclass(frozen=True)
class Weights:
    """Cost weights, integrated over time; all our choice. Units: [1] / [unit of the term]^2 / [s]."""

    joint_acceleration: float = 4e-3  # [1] / [rad/s^2]^2 / [s]
    jerk: float = 4e-7  # [1] / [rad/s^3]^2 / [s]
    torque: float = 1e-4  # [1] / [N m]^2 / [s]
    track_velocity: float = 20.0  # [1] / [m/s]^2 / [s]
    track_inertia: float = 2.0  # [1] / [kg m^2]^2 / [s]
    track_inertia_rate: float = 0.02  # [1] / [kg m^2/s]^2 / [s]
    track_momentum: float = 2.0  # [1] / [kg m^2/s]^2 / [s]
    heel_velocity: float = 0.5  # [1] / [m/s]^2 / [s]
    ankle_rate: float = 0.02  # [1] / [rad/s]^2 / [s]
    track_duration: float = 50.0  # [1] / [s]^2


@dataclass(frozen=True)
class Mesh:
    """Intervals per phase."""

    flat: int = 25
    toe: int = 20
    flight: int = 30


SCALES = {"q": 1.0, "v": 10.0, "a": 100.0, "j": 2000.0}


class _Builder:
    """Expressions shared by the terms; pure, no numbers but the robot's and the limits'."""

    def __init__(self, robot: Robot, limits: Limits, weights: Weights):
        self.model, self.limits, self.weights = robot.sagittal, limits, weights
        self.mg = self.model.total_mass * 9.8

    # model on a point -------------------------------------------------------------------------------------------
    def state(self, p: Point) -> PlanarState:
        if "state" not in p.memo:
            angles, rates, accels = p.q, p.v, p.a
            if p.q.numel() == 4:  # flat foot
                angles, rates, accels = (ca.vertcat(0, x) for x in (angles, rates, accels))
            p.memo["state"] = PlanarState(self.model, angles, rates, accels, p.p.gravity)
        return p.memo["state"]

    def wrench(self, p: Point):
        if "wrench" not in p.memo:
            p.memo["wrench"] = self.state(p).ground_wrench()
        return p.memo["wrench"]

    def toe_acceleration(self, p: Point):
        acc = self.state(p).com_acceleration
        return (-acc[0], -p.p.gravity - acc[1])

    def torques(self, p: Point, flying: bool):
        if "torques" not in p.memo:
            toe = self.toe_acceleration(p) if flying else (0.0, 0.0)
            p.memo["torques"] = self.state(p).torques(toe)
        return p.memo["torques"]

    def ballistic_com(self, p: Point):
        t = p.time
        return ca.vertcat(p.c.com_x + p.c.vel_x * t, p.c.com_z + p.c.vel_z * t - p.p.gravity * t * t / 2)

    def ballistic_velocity(self, p: Point):
        return ca.vertcat(p.c.vel_x, p.c.vel_z - p.p.gravity * p.time)

    def toe(self, p: Point):
        return self.ballistic_com(p) - self.state(p).com

    def ground(self, p: Point, x):
        """Height of the surface below x: a step of the platform's height at the edge, smoothed over 3 cm."""
        return p.p.platform * (1 + ca.tanh((x - p.p.edge) / 0.015)) / 2

    # terms ------------------------------------------------------------------------------------------------------
    def limits_of_joints(self, flying: bool) -> list[Term]:
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
        return rows

    def smoothness(self, flying: bool) -> list[Term]:
        w = self.weights

        def accelerations(p):
            s = self.state(p)
            a = s.accels
            return ca.vertcat(a[2] - a[3], a[1] - a[2], a[0] - a[1], a[4] - a[3], a[3])

        return [
            Term("joint acceleration", "WL-J2, WF-J2", "rad/s^2", "node", accelerations, weight=w.joint_acceleration),
            Term("jerk", "WL-J2, WF-J2", "rad/s^3", "mid", lambda p: p.j, weight=w.jerk),
            Term("torque", "ours: effort", "N m", "node", lambda p: self.torques(p, flying), weight=w.torque),
        ]

    def ground_contact(self) -> list[Term]:
        mu, mg = self.limits.friction, self.mg

        def cone(p):
            f = self.wrench(p)
            return ca.vertcat(mu * f[1] - f[0], mu * f[1] + f[0])

        rows = []
        for at in ("node", "mid"):
            suffix = "" if at == "node" else " (mid)"
            last = (0, 1) if at == "node" else (0, 0)
            rows += [
                Term(f"unilateral{suffix}", "ours", "N", at, lambda p: self.wrench(p)[1], lower=0.0, upper=np.inf,
                     scale=mg, skip=last),
                Term(f"friction{suffix}", "ours", "N", at, cone, lower=0.0, upper=np.inf, scale=mg, skip=last),
            ]  # fmt: skip
        hand = self.limits.hand_clearance_m
        rows.append(Term("hand clearance", "ours", "m", "node", lambda p: self.state(p).point("hand")[1], lower=hand,
                         upper=np.inf, scale=0.1))  # fmt: skip
        return rows

    def flat_rows(self) -> list[Term]:
        heel, margin, mg = self.model.heel[0], self.limits.cop_margin_m, self.mg

        def cop(p):
            f = self.wrench(p)
            return ca.vertcat(f[2] - margin * f[1], (-heel - margin) * f[1] - f[2])

        rows = []
        for at in ("node", "mid"):
            suffix = "" if at == "node" else " (mid)"
            last = (0, 1) if at == "node" else (0, 0)
            rows.append(Term(f"CoP in the sole{suffix}", "ours; SL-P2 for the whole body", "N m", at, cop, lower=0.0,
                             upper=np.inf, scale=0.1 * mg, skip=last))  # fmt: skip
        return rows

    def toe_rows(self) -> list[Term]:
        mg = self.mg
        return [
            Term("CoP at the toe", "ours: heel up", "N m", "node", lambda p: self.wrench(p)[2], scale=0.1 * mg,
                 skip=(0, 1)),
            Term("CoP at the toe (mid)", "ours: heel up", "N m", "mid", lambda p: self.wrench(p)[2], scale=0.1 * mg),
            Term("zero wrench at take-off", "SL-E3, E4, E6 for the whole body", "N", "end", self.wrench, scale=0.1 * mg),
            Term("vertical take-off speed", "SL-E2, WL-E1", "m/s", "end",
                 lambda p: self.state(p).com_velocity[1] - p.p.takeoff_speed),
        ]  # fmt: skip

    def flight_rows(self) -> list[Term]:
        lim, model = self.limits, self.model

        def l_rate(p):
            return self.state(p).angular_momentum_rate

        def clearance(p):
            toe, shape = self.toe(p), (4 * p.s * (1 - p.s)) ** 3
            rows = []
            for share in (0.0, 0.5, 1.0):
                point = toe + self.state(p).point(model.point_arms(0, share * model.heel))
                rows.append(point[1] - self.ground(p, point[0]) - lim.clearance_m * shape)
            return ca.vertcat(*rows)

        rows = [
            Term("angular momentum", "WF-D1", "N m", "node", l_rate, scale=20.0, skip=(1, 0)),
            Term("angular momentum (mid)", "WF-D1", "N m", "mid", l_rate, scale=20.0),
            Term("sole clearance", "ours", "m", "node", clearance, lower=0.0, upper=np.inf, scale=0.1, skip=(1, 1)),
        ]
        return rows + self.touchdown_rows()

    def touchdown_rows(self) -> list[Term]:
        lim, model = self.limits, self.model
        sole = model.point_arms(0, model.sole_center)

        def capture(p):
            ahead = self.state(p).point(sole)[0] - self.state(p).com[0]
            return ahead - lim.capture_offset_m - lim.capture_slope_s * p.c.vel_x

        rate, trunk = lim.touchdown_joint_rate, lim.touchdown_trunk_rate
        return [
            Term("touchdown place", "WL-E1 and SL-E1: jump length; ours: height", "m", "end",
                 lambda p: self.toe(p) - ca.vertcat(p.p.distance, p.p.platform)),
            Term("foot flat at touchdown", "ours", "rad", "end", lambda p: self.state(p).angles[0]),
            Term("knee at touchdown", "ours: stroke", "rad", "end", lambda p: self.state(p).joints[1],
                 lower=lim.touchdown_knee[0], upper=lim.touchdown_knee[1]),
            Term("trunk at touchdown", "ours", "rad", "end", lambda p: self.state(p).angles[3] - p.p.rotation,
                 lower=lim.touchdown_trunk[0], upper=lim.touchdown_trunk[1]),
            Term("joint rates at touchdown", "WF-E1, relaxed", "rad/s", "end", lambda p: self.state(p).joint_rates,
                 lower=-rate, upper=rate),
            Term("trunk rate at touchdown", "ours", "rad/s", "end", lambda p: self.state(p).rates[3], lower=-trunk,
                 upper=trunk),
            Term("capture window", "ours; replaces WF-E2", "m", "end", capture, lower=lim.capture_window_m[0],
                 upper=lim.capture_window_m[1], scale=0.1),
        ]  # fmt: skip


def _continuity(left: str, right: str) -> Term:
    def jump(ends):
        a, b = ends[left].end, ends[right].start
        rows = []
        for x, y, scale in ((a.q, b.q, 1.0), (a.v, b.v, 10.0), (a.a, b.a, 100.0)):
            if x.numel() == 4:
                x = ca.vertcat(0, x)
            rows.append((x - y) / scale)
        return ca.vertcat(*rows)

    return Term(f"{left} to {right}", "WF-L1..L3", "scaled", "problem", jump)


def build_problem(robot: Robot, mesh: Mesh = Mesh(), limits: Limits = Limits(), weights: Weights = Weights()) -> Problem:
    """The direct whole-body problem: flat foot, toe, flight, in one NLP."""
    b = _Builder(robot, limits, weights)

    def takeoff(ends):
        end, c = ends["toe"].end, ends["flight"].start.c
        s = b.state(end)
        return ca.vertcat(s.com[0] - c.com_x, s.com[1] - c.com_z, s.com_velocity[0] - c.vel_x, s.com_velocity[1] - c.vel_z)

    stance = lambda p: p["stance"][1:]  # noqa: E731
    angle_box = Bound("link angles", "ours: box", "rad", "q", -8.0, 8.0)
    flat = Phase("flat", LINKS[1:], mesh.flat, limits.flat_s,
                 tuple(b.smoothness(False) + b.limits_of_joints(False) + b.ground_contact() + b.flat_rows()),
                 (Bound("stance", "ours: reading of the start", "rad", "q", stance, stance, "start"),
                  Bound("at rest", "ours", "rad/s", "v", 0.0, 0.0, "start"),
                  Bound("at rest (acceleration)", "ours", "rad/s^2", "a", 0.0, 0.0, "start")), scales=SCALES)  # fmt: skip
    heel_up = Bound("heel not below ground", "WL-K2", "rad", "q", [0.0, -8, -8, -8, -8], [limits.heel_up_rad, 8, 8, 8, 8])
    toe = Phase("toe", LINKS, mesh.toe, limits.toe_s,
                tuple(b.smoothness(False) + b.limits_of_joints(False) + b.ground_contact() + b.toe_rows()),
                (heel_up,), scales=SCALES)  # fmt: skip
    constants = {"com_x": (-1.0, 1.0, 1.0), "com_z": (0.0, 2.0, 1.0), "vel_x": (-5.0, 5.0, 1.0), "vel_z": (0.0, 6.0, 1.0)}
    flight = Phase("flight", LINKS, mesh.flight, (0.05, 1.5),
                   tuple(b.smoothness(True) + b.limits_of_joints(True) + b.flight_rows()), (angle_box,),
                   constants=constants, scales=SCALES)  # fmt: skip
    joints = (_continuity("flat", "toe"), _continuity("toe", "flight"),
              Term("ballistic CoM", "WF-D1", "m, m/s", "problem", takeoff))  # fmt: skip
    parameters = dict(stance=5, distance=1, platform=1, edge=1, takeoff_speed=1, rotation=1, gravity=1)
    return Problem("whole body", (flat, toe, flight), joints, parameters)
