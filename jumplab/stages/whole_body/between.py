"""Use of the limits by a tape, also between the nodes of the plan that it was made from."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.legs import size
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.ground import Surface
from jumplab.stages.whole_body.tape import FLAT, SHORTEST_S, feet_of
from jumplab.stages.whole_body.terms import SOLE_SHARES

# the audit's limits; forces, rates, accelerations and the clearance grow with the robot
FRICTION = 0.5  # of each foot
LOADED_N = 10.0  # the ratio is taken to this force at least
RATE_GAP = 0.01  # [rad/s] of angles over one step, against the mean of the rates at its ends
ACCELERATION_GAP = 4.0  # [rad/s^2] the same of rates against accelerations
RANGE_GAP = 1e-3  # [rad] beyond a stop
PRESSURE_GAP = 2e-3  # [m] of the CoP beyond the sole
PRESSED_N = 50.0  # on a foot, from which on its CoP is looked at
CLEAR_M = 0.02  # of the soles over the ground in mid-flight
MIDDLE = (0.3, 0.7)  # the shares of a flight between which that is
SUNK_M = 1e-3  # of a sole in the ground or in a platform
EDGE_M = 0.01  # of a shank from an edge
EVERY = 4  # of so many samples one is looked at for it


def used_between(
    tape: Tape, robot: Robot, surface: Surface = Surface(), body: Body | None = None
) -> float:
    """Largest share [1] that the tape uses of a limit, see :func:`shares_between`."""
    return max(shares_between(tape, robot, surface, body).values())


def shares_between(
    tape: Tape, robot: Robot, surface: Surface = Surface(), body: Body | None = None
) -> dict[str, float]:
    """Largest shares [1] that the tape uses of the limits of motors, stops, ground, and of gaps
    between angles, rates and accelerations, by their names.

    The limits are those of the audit; up to 1 the tape holds them, also between the nodes. Soles
    that in the middle of a flight are as low as they may be use all of their height, on the surface
    twice of it; so do shanks of the ``body`` at an edge.
    """
    motors = robot.limits
    of = size(robot).of
    angles = tape.q[:, 7:]
    rates = tape.v[:, 6:]
    least, most = motors.range(rates)
    origin, turn = feet_of(robot, tape.q)
    along = np.linalg.norm(tape.f[..., :2], axis=-1)
    shares = {
        "torque": 1 + np.maximum(tape.tau - most, least - tape.tau) / motors.effort,
        "joint speed": np.abs(rates) / motors.speed,
        "joint range": np.maximum(motors.lower - angles, angles - motors.upper) / RANGE_GAP,
        "friction": along / (FRICTION * np.maximum(tape.f[..., 2], of(LOADED_N, "N"))),
        "CoP in the sole": _pressed_outside(tape, robot, turn) / PRESSURE_GAP,
        "rates": _gap(tape.t, angles, rates) / of(RATE_GAP, "rad/s"),
        "accelerations": _gap(tape.t, rates, tape.a[:, 6:]) / of(ACCELERATION_GAP, "rad/s^2"),
        "height of the soles": _low(tape, robot, surface, origin, turn),
    }
    if body is not None and surface.height_m:
        shares["shanks at the edge"] = _at_edge(tape, body, surface)
    return {name: float(np.nan_to_num(x.max(), nan=np.inf)) for name, x in shares.items()}


def _gap(t: np.ndarray, values: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """By how much differences of ``values`` (n, k) miss the mean of the ``rates`` (n, k)."""
    step = np.diff(t)[:, None]
    moves = step[:, 0] > SHORTEST_S  # the instant of take-off is there twice
    missed = np.diff(values, axis=0)[moves] / step[moves] - (rates[1:] + rates[:-1])[moves] / 2
    return np.abs(missed)


def _pressed_outside(tape: Tape, robot: Robot, turn: np.ndarray) -> np.ndarray:
    """Distance by which the CoP of each foot that carries is outside its sole, on its toes beside
    their edge (n, 2) [m].

    ``turn`` (n, 2, 3, 3) are attitudes of the feet.
    """
    foot = robot.foot
    force = tape.f[..., :3]
    load = np.where(force[..., 2] > size(robot).of(PRESSED_N, "N"), force[..., 2], np.nan)
    moment = tape.f[..., 3:] - np.cross(turn @ foot.tip, force)
    # x + iy, from the middle of the toe edge, in the axes of the foot's heading
    ahead = turn[..., 0, 0] + 1j * turn[..., 1, 0]
    cop = (1j * (moment[..., 0] / load) - moment[..., 1] / load) * np.abs(ahead) / ahead
    length = np.where(tape.contacts == FLAT, foot.toe - foot.heel, 0.0)
    beside = np.abs(cop.imag) - foot.half_width
    outside = np.max([cop.real, -cop.real - length, beside], axis=0)
    return np.where(np.isnan(load), -np.inf, outside)


def _low(
    tape: Tape, robot: Robot, surface: Surface, origin: np.ndarray, turn: np.ndarray
) -> np.ndarray:
    """Share (n, 2) of what soles in the air may be too low, in the middle of a flight under
    :data:`CLEAR_M`, and at a touchdown off the ground.

    ``origin`` (n, 2, 3) [m] and ``turn`` (n, 2, 3, 3) are places and attitudes of the feet.
    """
    clear = size(robot).of(CLEAR_M, "m")
    heels, toes = np.split(robot.foot.corners, 2)
    sole = np.concatenate([heels + share * (toes - heels) for share in SOLE_SHARES])
    points = origin[:, :, None] + np.einsum("nkij,pj->nkpi", turn, sole)
    heights = points[..., 2] - surface.below(points)
    height = heights.min(axis=2)
    shares = np.where(tape.contacts > 0, -np.inf, -height / SUNK_M)
    for rows in tape.flights:
        t = tape.t[rows] - tape.t[rows.start]
        middle = (t >= MIDDLE[0] * t[-1]) & (t <= MIDDLE[1] * t[-1])
        shares[rows] = np.where(middle[:, None], 2 - height[rows] / clear, -height[rows] / SUNK_M)
    if not tape.contacts[-1].any():  # it ends as both soles meet the ground
        shares[-1] = np.abs(heights[-1]).max(axis=-1) / SUNK_M
    return shares


def _at_edge(tape: Tape, body: Body, surface: Surface) -> np.ndarray:
    """Share (n, points) of what the shanks may be near the edge where the ground steps."""
    tree = body.robot.model
    data = tree.createData()
    least = size(body.robot).of(EDGE_M, "m")
    top = max(surface.height_m, 0.0)
    places = []
    for q in tape.q[::EVERY]:
        pin.forwardKinematics(tree, data, q)
        places.append([data.oMi[1 + k].act(place) for k, place in body.shank_points])
    points = np.array(places)
    before = points[..., :2] @ surface.along - surface.edge_m  # of the block's side
    before *= -np.sign(surface.height_m)
    away = np.hypot(np.maximum(before, 0.0), np.maximum(points[..., 2] - top, 0.0))
    return 2 - (away - body.shank_m) / least
