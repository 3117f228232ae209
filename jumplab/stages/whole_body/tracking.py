"""Terms of a whole-body program that follows stage 1, or a given motion."""

from __future__ import annotations

from collections.abc import Iterable

import casadi as ca
import numpy as np

from jumplab.ocp.problem import Term
from jumplab.robot.reach import rod_of
from jumplab.robot.stance import stance_angles
from jumplab.stages.whole_body.contacts import SIDES
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.mode import Mode


def tracking(m: Mode) -> list[Term]:
    """Stage 1's trajectories as references, at the same share of each phase (WL-J1, WL-J3, WF-J1,
    WF-J2).

    Heel up, the heel stays quiet besides, and L at take-off is stage 1's (WL-D1).
    """
    w = m.weights
    origin = "WF-J1" if m.flying else "WL-J1"
    # [kg m^2] of the stance
    size = m.model.mass * rod_of(m.robot, stance_angles(m.robot))[3] ** 2
    rates = w.track_flight_inertia_rate if m.flying else w.track_inertia_rate

    def follow(name, equation, unit, of, weight):
        return Term(name, equation, unit, "node", of, float(weight))

    def inertia(p):
        return p.rho - p.ref.rho

    def inertia_rate(p):
        return p.rho_rate - p.ref.rho_rate

    def velocity(p):
        return p.com_velocity[[0, 2]] - p.ref.velocity

    def momentum(p):
        return p.L[1] - p.ref.L

    def heel(p):
        return p.point_velocity("left_heel")[2]

    def momentum_kept(p):
        slack = ca.fmax(m.limits.momentum_share * ca.fabs(p.p.momentum), m.limits.momentum_slack)
        difference = p.L[1] - p.p.momentum
        return ca.vertcat(slack - difference, slack + difference)

    rows = [
        follow("track inertia", origin, "kg m^2", inertia, w.track_inertia / size**2),
        follow("track inertia rate", origin, "kg m^2/s", inertia_rate, rates / size**2),
    ]
    if m.flying:
        ankle = follow(
            "ankle rate", "WF-J2", "rad/s", lambda p: p.joint_rates.ankle[0], w.ankle_rate
        )
        return [*rows, ankle]
    spin = "WL-D1, as a cost on L"
    rows += [
        follow("track velocity", origin, "m/s", velocity, w.track_velocity),
        follow("track momentum", spin, "kg m^2/s", momentum, w.track_momentum / size**2),
    ]
    if m.raised:
        rows += [
            follow("heel velocity", "WL-J3", "m/s", heel, w.heel_velocity),
            Term("L at take-off", "WL-D1", "kg m^2/s", "end", momentum_kept, upper=np.inf),
        ]
    return rows


def following(m: Mode, landed: Iterable[int]) -> list[Term]:
    """A given motion as reference, at the same share of each phase: joints, base, how long the
    phase lasts, and where the feet that have ``landed`` stand.
    """
    w = m.weights

    def row(name, unit, at, of, weight):
        return Term(f"follow {name}", "ours: the nearest motion", unit, at, of, float(weight))

    def foothold(side):
        def missed(p):
            place, yaw = p.foothold(side)
            return ca.vertcat(place, yaw) - getattr(p.ref, f"{SIDES[side]}_hold")

        return row(f"{SIDES[side]} foothold", "m, rad", "start", missed, w.follow_foothold)

    def joints(p):
        return p.tree.q[BASE:] - p.ref.chart[BASE:]

    def place(p):
        return p.tree.q[:3] - p.ref.chart[:3]

    def attitude(p):
        return p.attitude - p.ref.chart[3:BASE]

    def duration(p):
        return p.duration / p.ref.lasts - 1

    def takeoff(p):
        return p.flight("vel")[2] - p.p.takeoff_speed

    speed = row("take-off speed", "m/s", "start", takeoff, w.follow_takeoff)
    return [
        *([speed] if m.flying else []),
        row("joints", "rad", "node", joints, w.follow_joints),
        row("base", "m", "node", place, w.follow_base),
        row("attitude", "rad", "node", attitude, w.follow_attitude),
        row("duration", "1", "start", duration, w.follow_duration),
        *(foothold(side) for side in landed),
    ]
