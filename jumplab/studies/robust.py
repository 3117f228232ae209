"""A plan that allows for robots other than the planned one: sampled robots make the same motion,
and shall be caught.

Each of them takes off with a momentum of its own and drifts in attitude until its soles meet the
ground. Where it then comes to rest is its capture point; the further that is from the middle of the
soles, the sooner it falls.

A flip ends as the tuck lets it, which opens sooner or later in flight, see
:class:`jumplab.control.flight.Flight`. Its plan allows for other robots by an opening that may come
later still.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from jumplab.arguments import checked
from jumplab.errors import InputError
from jumplab.models.spatial import SpatialModel, cross
from jumplab.ocp import Term
from jumplab.robot import Robot
from jumplab.sim import Perturbation, Ranges
from jumplab.stages.changes import LAST, named, sorted_out
from jumplab.stages.whole_body import Limits
from jumplab.stages.whole_body.body import Body
from jumplab.task import JumpTask

SAMPLES = 6  # draws, each with its opposite: to first order their mean is the planned robot
# [1/m^2] robots that come to rest 4 cm off the middle of the soles cost 3 % of a jump of 1 m
WEIGHT = 500.0
FRICTION_SHARE = 0.9  # of the least friction: the planner counts on 0.42, where robots have 0.5
# by which legs that give way take up the fall later than an impact would: pushed robots showed it
BRAKE_S = 0.035
# of the speed limits; with less, knees straighten to wind up for more momentum, and launches fail
OPENING_SHARE = 0.4
# of the torques: an opening at 1.6 times the pace takes 0.9 of them
OPENING_TORQUE_SHARE = 0.35
# [rad] left to the ankles' stop at touchdown: robots that fly backwards need it, with their feet
# behind them. Of 40 perturbed backflips of a G1 36 stand in PyBullet, 33 with the usual 0.12
ANKLE_STROKE_RAD = 0.3
# of robots that do not move in the plane alone: perturbed backflips of a G1 are caught with -0.09
# to 0.13 m^2/s about the soles over the mass, and fall mostly below
CAPTURE_EVEN = -0.03, -0.01, 0.03, 0.07
# the same of a flip: toes that slip as they leave cost momentum, and with it the turn
FLIP_FRICTION_SHARE = 0.76
INSTEAD_OF = "capture window"  # of the planned robot alone
MOVING = "mass", "com_m", "inertia", "payload_kg"  # what makes sampled robots differ
LIMITING = "friction", "torque_loss", "speed_loss"  # what the planned one may use less of


@checked
def robust_changes(
    task: JumpTask, robot: Robot, ranges: Ranges, changes: Mapping[str, Any]
) -> dict[str, Any]:
    """``changes`` of a :class:`jumplab.Planner` with those of a robust plan, which allow for
    ``ranges``.

    In place of the capture window stands the cost of :func:`capture_term` over sampled robots; a
    flip keeps its own rows for that (of robots that move in space with :data:`CAPTURE_EVEN`), opens
    its tuck with :data:`OPENING_SHARE` of the joints' speeds and :data:`OPENING_TORQUE_SHARE` of
    their torques, keeps :data:`ANKLE_STROKE_RAD` of its ankles' way, and leaves the torque that
    heavier links and weaker motors take. Friction, torque and speed are used up to the least that
    ``ranges`` leave. Other differences (delay, ground, shoves, sensors, posture; motors of jumps)
    are not seen: they do not depend on the plan's masses or limits. Own limits win.

    Raises :class:`InputError` if ``ranges`` have nothing that a plan can allow for.
    """
    nothing = Ranges.none()
    if all(getattr(ranges, name) == getattr(nothing, name) for name in (*MOVING, *LIMITING)):
        raise InputError(
            f"robust: none of these ranges changes a plan; it allows for "
            f"{', '.join((*MOVING, *LIMITING))}"
        )
    # refuses what is no such thing
    sorted_out(changes.get("terms"), changes.get("weights"), changes.get("off", ()))
    usual = Limits()
    limits = {
        "friction": min(usual.friction, FRICTION_SHARE * ranges.friction[0]),
        "torque_share": usual.torque_share * (1 - ranges.torque_loss[1]),
        "speed_share": usual.speed_share * (1 - ranges.speed_loss[1]),
        "opening_speed_share": usual.opening_speed_share,
        "opening_torque_share": usual.opening_torque_share,
    }
    if task.rotation_rad:
        # a trunk that its waist cannot hold takes the turn with it
        heavier = (1 + ranges.mass) / (1 - ranges.motor_gain)
        limits["friction"] = min(usual.friction, FLIP_FRICTION_SHARE * ranges.friction[0])
        limits["torque_share"] /= heavier
        limits["opening_speed_share"] = OPENING_SHARE
        limits["opening_torque_share"] = OPENING_TORQUE_SHARE
        limits["touchdown_ankle_stroke"] = ANKLE_STROKE_RAD
        if not robot.planar:
            limits["capture_even"] = CAPTURE_EVEN
    robust = {**changes, "limits": limits | named(Limits, changes.get("limits"))}
    if task.rotation_rad:
        return robust
    terms = dict(changes.get("terms") or {})
    usual_terms = terms.get(LAST, ())
    axes = (0,) if task.in_plane and robot.planar else (0, 1)
    capture = capture_term(robot, ranges, axes)
    terms[LAST] = [*([usual_terms] if isinstance(usual_terms, Term) else usual_terms), capture]
    left_out = [*changes.get("off", ()), f"{LAST}/{INSTEAD_OF}"]
    return {**robust, "terms": terms, "off": left_out}


def capture_term(robot: Robot, ranges: Ranges, axes: tuple[int, ...]) -> Term:
    """The mean square of the distance from the middle of the soles to where sampled robots come to
    rest [m^2].

    A cost at "problem" of stage 3, ours: E[xi^2] = mean^2 + variance of the capture point xi, over
    2 :data:`SAMPLES` robots, the same ones for every plan; ``axes`` are 0 for x, 1 for y of the
    start.
    """
    models = sampled(robot, ranges)
    body = Body(robot)

    def points(ends: Mapping[str, SimpleNamespace]) -> ca.SX:
        return ca.vertcat(
            *(capture_point(model, body, ends)[list(axes)] for model in models)
        ) / np.sqrt(len(models))

    return Term(
        "capture of sampled robots", "ours: scenarios", "m", "problem", points, weight=WEIGHT
    )


def sampled(robot: Robot, ranges: Ranges) -> list[SpatialModel]:
    """Models of drawn robots and of their opposites (2 :data:`SAMPLES`); of the planned one, if
    none of their masses differs.
    """
    only = replace(Ranges.none(), **{name: getattr(ranges, name) for name in MOVING})
    if only == Ranges.none():
        return [SpatialModel(robot.model)]
    drawn = [Perturbation.draw(robot, seed, only) for seed in range(SAMPLES)]
    return [SpatialModel(each.robot(robot).model) for one in drawn for each in (one, opposite(one))]


def opposite(drawn: Perturbation) -> Perturbation:
    """The robot that differs as much the other way; a payload is as heavy, and where it was."""
    masses, inertias = (
        {name: 2 - x for name, x in factors.items()} for factors in (drawn.mass, drawn.inertia)
    )
    return replace(
        drawn,
        mass=masses,
        inertia=inertias,
        com={n: tuple(-x for x in c) for n, c in drawn.com.items()},
    )


def capture_point(model: SpatialModel, body: Body, ends: Mapping[str, SimpleNamespace]) -> ca.SX:
    """Point where another robot that makes this motion comes to rest (2,), from the middle of its
    soles [m].

    Its joints move as planned, and its feet with them until take-off: there it has the momentum
    that its own masses give. In flight that stays, and the body turns by I^-1 (L - L of the joints
    and the trunk as planned), taken as growing evenly from nothing. The impact, :data:`BRAKE_S`
    later, keeps the angular momentum about the soles; what is left of it leads a pendulum of the
    CoM's height z to x + v / sqrt(g / z).
    """
    takeoff = ends["toe"].end
    end = ends["flight"].end
    there = takeoff.moved(model)
    here = end.moved(model)
    flight_s = end.duration
    gravity = end.p.gravity
    L = there.angular_momentum
    v = there.com_velocity - ca.vertcat(0, 0, gravity * flight_s)
    soles = sum(here.point(k, local) for k, local in zip(body.feet, body.middles, strict=True)) / 2
    arm = here.com - soles
    arm += cross(ca.solve(here.inertia, L - here.angular_momentum) * flight_s / 2, arm)
    late = arm + BRAKE_S * ca.vertcat(v[:2], 0)
    about = L / model.mass + cross(late, v)
    z = arm[2]
    return arm[:2] + ca.vertcat(about[1], -about[0]) / z * ca.sqrt(z / gravity)
