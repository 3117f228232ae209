"""What a straight push by stage 1's pendulum can reach, by closed forms: its limits, and a forecast for the robot.

The whole robot swings arms and trunk besides and was seen to jump farther: the direct method tries what these forms
refuse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from jumplab.errors import InfeasibleError
from jumplab.robot import Robot
from jumplab.robot.reach import Reach
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.task import MAX_HEIGHT_M, JumpTask

# verdict ------------------------------------------------------------------------------------------
SWING_GAIN = 1.06  # [1] the rod's swing adds to a straight push; stage 1 was seen up to 5.6 % beyond it
DIP_M_S = 1.0  # downward speed in the crouch that a push may start from; 0.64 was seen to matter
STROKE_POINTS = 200  # the push's quadrature is exact to 1e-3 m/s
PLATFORM_POINTS = 400  # steps of a few millimetres
GRID = (41, 121)  # leans and horizontal speeds that are tried; nearest numbers are exact to 2 %
LOWEST_M = 0.02  # least CoM rise that a task may ask for
STEP_M = 0.01  # targets are told in centimetres


@dataclass(frozen=True)
class Capability:
    """What the closed forms need to know of robot, settings and gravity.

    The greatest speed is max over phi of min(v(phi), share S(phi)), times the swing's gain, where
    m v dv = (min(F, F (S - v) / ((1 - corner) S)) - m g) dphi  from rest in a deep crouch.
    """

    speed: float  # greatest speed along the leg at take-off [m/s]
    stroke: float  # leg stroke of the push, deepest crouch to longest leg at take-off [m]
    mean_force: float  # average of F over the stroke [N]
    takeoff_length: float  # longest leg at take-off [m]
    mass: float  # [kg]
    gravity: float  # [m/s^2]
    settings: SrmpSettings
    envelope: Reach


def capability(envelope: Reach, gravity: float, settings: SrmpSettings = SrmpSettings()) -> Capability:
    """Integrate the push from the deepest crouch; see :class:`Capability`."""
    longest = min(settings.takeoff_length * envelope.start[1], envelope.length[1])
    phi = np.linspace(envelope.length[0], longest, STROKE_POINTS)
    force, speed = np.polyval(envelope.force_fit, phi), np.polyval(envelope.speed_fit, phi)
    square, step, reached = 0.0, phi[1] - phi[0], np.zeros_like(phi)
    for k in range(1, len(phi)):
        fade = (speed[k] - reached[k - 1]) / ((1 - settings.corner_speed) * speed[k])
        push = force[k] * min(max(fade, 0.0), 1.0) / envelope.mass - gravity
        square = max(square + 2 * step * push, 0.0)
        reached[k] = math.sqrt(square)
    best = float(np.max(np.minimum(reached, settings.speed_share * speed)))
    stroke, mean = float(phi[-1] - phi[0]), float(force.mean())
    return Capability(SWING_GAIN * best, stroke, mean, float(longest), envelope.mass, gravity, settings, envelope)


def needed_force(can: Capability, height_m: float) -> float:
    """Average ground force [N] for a CoM rise of ``height_m``:  m (g + v^2 / (2 stroke)) = m g (1 + h / stroke)."""
    return can.mass * can.gravity * (1 + height_m / can.stroke)


def highest(can: Capability) -> float:
    """Greatest CoM rise [m]:  speed^2 / (2 g), and not more than the average force gives,  stroke (F / m g - 1)."""
    return max(min(_rises(can).values()), 0.0)


def _rises(can: Capability) -> dict[str, float]:
    by_force = can.stroke * (can.mean_force / (can.mass * can.gravity) - 1)
    return {"speed": can.speed**2 / (2 * can.gravity), "force": by_force}


def farthest(can: Capability, task: JumpTask) -> float:
    """Greatest distance [m] in the target's direction at its height and platform, 0 if none.

    For every lean at take-off (CoM at x = phi sin(lean)) and horizontal speed v_x that satisfy

    * extension speed:  v_z cos(lean) + v_x sin(lean) <= speed;
    * falling over the trailing edge X of the sole, plus what the flight's own turn  L = rho_max (lean + touchdown lean)
      / t_f  leaves, plus, only backward, where the last push is on that edge too, the push's lever:
      v_x cos(lean) - v_z sin(lean) <= sqrt(g / phi) (x + |X|) + L / (m phi) + (|X| (v_z + dip) / phi);
    * friction, the CoM starting behind the pivot by |X| at most:  v_x <= mu (v_z + dip) + sqrt(2 mu g (x + |X|)), and
      over the longest launch T  v_x <= mu (v_z + g T),

    the feet travel  x + v_x t_f + a,  with  a = offset + slope v_x  the capture law's lead of the sole, t_f
    the time from z = phi cos(lean) up and down to  z = platform + sqrt(leg^2 - a^2)  with the shortest leg allowed.
    """
    s, g, v_z = can.settings, can.gravity, task.takeoff_speed
    ahead = task.distance_m >= 0
    steepest = s.takeoff_lean[1] if ahead else -s.takeoff_lean[0]
    lean = np.linspace(0.0, steepest, GRID[0])[:, None]
    v_x = np.linspace(0.0, 2 * can.speed, GRID[1])[None, :]
    x, edge = can.takeoff_length * np.sin(lean), _trailing_edge(can, ahead)
    fits = v_z * np.cos(lean) + v_x * np.sin(lean) <= can.speed
    fits &= v_x <= s.friction * (v_z + DIP_M_S) + np.sqrt(2 * s.friction * g * (x + edge))
    fits &= v_x <= s.friction * (v_z + g * (s.flat_s[1] + s.toe_s[1]))
    lead = _lead(can, v_x, ahead)
    drop = can.takeoff_length * np.cos(lean) - task.platform_m - _landing_height(can, task.platform_m, lead)
    left = v_z**2 + 2 * g * drop
    t_f = (v_z + np.sqrt(np.maximum(left, 0.0))) / g
    turn = lean + np.arcsin(np.minimum(lead / can.takeoff_length, 1.0))
    fall = math.sqrt(g / can.takeoff_length) * (x + edge)
    fall = fall + can.envelope.inertia[1] * turn / (t_f * can.mass * can.takeoff_length)
    if not ahead:
        fall = fall + edge * (v_z + DIP_M_S) / can.takeoff_length
    fits &= v_x * np.cos(lean) - v_z * np.sin(lean) <= fall
    return max(float(np.max(np.where(fits & (left >= 0), x + v_x * t_f + lead, 0.0))), 0.0)


def highest_platform(can: Capability, height_m: float, distance_m: float) -> float:
    """Highest surface [m] that a CoM rise of ``height_m`` can land on.

    Apex >= CoM over the bent landing leg:  phi + h >= platform + sqrt(leg(platform)^2 - a^2),  a the lead of the sole
    at a speed of at most  v_x = (l + |X|) / (v_z / g + slope),  since  l = x + v_x t_f + a  with the CoM leaving the
    ground at x not behind the trailing edge X of the sole.
    """
    rise_s, ahead = math.sqrt(2 * height_m / can.gravity), distance_m >= 0
    v_x = (abs(distance_m) + _trailing_edge(can, ahead)) / (rise_s + can.settings.capture_slope_s)
    lead = _lead(can, v_x, ahead)
    grid = np.linspace(0.0, can.takeoff_length + height_m, PLATFORM_POINTS)
    room = can.takeoff_length + height_m - grid - _landing_height(can, grid, lead)
    return float(grid[room >= 0].max(initial=0.0))


def _trailing_edge(can: Capability, ahead: bool) -> float:
    """Distance from the middle of the sole to the edge that is left last behind, heel or toe [m]."""
    return float(-can.envelope.cop[0] if ahead else can.envelope.cop[1])


def _lead(can: Capability, v_x, ahead: bool):
    """Sole ahead of the CoM at touchdown, in the direction of the jump [m], at its greatest."""
    s, sign = can.settings, 1.0 if ahead else -1.0
    edge = s.capture_window_m[1] if ahead else s.capture_window_m[0]
    return np.maximum(sign * (s.capture_offset_m + edge) + s.capture_slope_s * v_x, 0.0)


def _landing_height(can: Capability, platform_m: float, lead):
    """Lowest CoM over the sole at touchdown [m]."""
    s = can.settings
    leg = (s.touchdown_length[0] - s.touchdown_fold_per_m * np.maximum(0.0, platform_m)) * can.envelope.start[1]
    return np.sqrt(np.maximum(leg**2 - np.asarray(lead) ** 2, 0.0))


def least_momentum(can: Capability, task: JumpTask) -> float:
    """Least angular momentum [kg m^2/s] of a flip:  (|rotation| - lean at both ends) rho_min / t_f."""
    s = can.settings
    low, high = can.envelope.inertia
    longest = _airtime(can, task)
    turn = abs(task.rotation_rad) - 2 * max(abs(x) for x in s.takeoff_lean)
    return max(turn, 0.0) * (low + s.inertia_margin * (high - low)) / longest


def _airtime(can: Capability, task: JumpTask) -> float:
    """Longest time in the air [s]: straight leg at take-off, shortest at touchdown."""
    v, g = task.takeoff_speed, can.gravity
    lead = _lead(can, 0.0, True)
    drop = can.takeoff_length - task.platform_m - float(_landing_height(can, task.platform_m, lead))
    return (v + math.sqrt(max(v * v + 2 * g * drop, 0.0))) / g


def check_reachable(task: JumpTask, envelope: Reach, robot: Robot, settings: SrmpSettings = SrmpSettings()) -> None:
    """Refuse a target that no launch of stage 1's pendulum can meet, in words and with the number that it can.

    The conditions, in this order, are those of :func:`highest` (take-off speed, average force over the stroke),
    :func:`highest_platform` (apex over the bent landing leg), :func:`farthest` (extension speed, falling forward,
    friction, time in the air) and :func:`least_momentum` (rotation). Raises :class:`InfeasibleError` with the value
    asked for, the limit, and where it comes from.
    """
    can = capability(envelope, task.gravity, settings)
    for check in (_check_height, _check_platform, _check_distance, _check_rotation):
        check(task, can, robot.name)


def _check_height(task: JumpTask, can: Capability, name: str) -> None:
    limit = highest(can)
    if limit < STEP_M:
        why = f"its legs give {can.mean_force:.0f} N on average for a weight of {can.mass * can.gravity:.0f} N"
        if can.mean_force > can.mass * can.gravity:
            why += f" and reach {can.speed:.2f} m/s"
        raise InfeasibleError(
            f"height = {task.height_m:g} m: a straight push does not lift {name} off the ground, {why} "
            f"({_limiting(can)}); give it stronger joints or less gravity"
        )
    if task.height_m > limit:
        raise InfeasibleError(
            f"height = {task.height_m:g} m: take-off at {task.takeoff_speed:.2f} m/s, on average "
            f"{needed_force(can, task.height_m):.0f} N over {can.stroke:.2f} m of leg stroke; the legs of {name} reach "
            f"{can.speed:.2f} m/s and {can.mean_force:.0f} N ({_limiting(can)}), by a straight push enough for "
            f"{_below(limit)} m",
            number="height_m",
            bound=limit,
        )


def _limiting(can: Capability) -> str:
    """The joint that limits the rise, as a person would name it."""
    rises = _rises(can)
    what = min(rises, key=rises.get)
    return f"limited by the {what} of {can.envelope.weakest[what]}"


def _check_platform(task: JumpTask, can: Capability, name: str) -> None:
    limit = highest_platform(can, task.height_m, task.distance_m)
    if task.platform_m <= limit:
        return
    enough = [h for h in _heights(can, task.height_m) if highest_platform(can, h, task.distance_m) >= task.platform_m]
    higher = f", and for this one at a height of {_above(enough[0])} m" if enough else ""
    raise InfeasibleError(
        f"platform = {task.platform_m:g} m: at a height of {task.height_m:g} m a straight push takes the CoM of {name} "
        f"to {can.takeoff_length + task.height_m:.2f} m, too low to stand there even on legs bent as far as a landing "
        f"allows; that is enough for a platform of {_below(limit)} m{higher}",
        number="platform_m",
        bound=limit,
    )


def _check_distance(task: JumpTask, can: Capability, name: str) -> None:
    limit = farthest(can, task)
    if abs(task.distance_m) <= limit:
        return
    heights = [h for h in _heights(can, LOWEST_M) if task.platform_m <= highest_platform(can, h, task.distance_m)]
    best = max(((farthest(can, _at(task, h)), h) for h in heights), default=(0.0, task.height_m))
    found = best[0] > limit + STEP_M
    more = f"; at a height of {best[1]:.2f} m it is enough for {_below(best[0])} m" if found else ""
    way = "forward" if task.distance_m >= 0 else "backward"
    raise InfeasibleError(
        f"distance = {task.distance_m:g} m: in the time that a height of {task.height_m:g} m leaves in the air, a "
        f"straight push of {name} is enough for {_below(limit)} m {way} (legs {can.speed:.2f} m/s along the lean at "
        f"take-off, friction {can.settings.friction:g}){more}",
        number="distance_m",
        bound=limit,
    )


def _heights(can: Capability, first: float) -> np.ndarray:
    """CoM rises to look for a better number among [m]."""
    return np.arange(first, min(highest(can), MAX_HEIGHT_M), STEP_M)


def _at(task: JumpTask, height_m: float) -> JumpTask:
    return replace(task, height_m=float(height_m))


def _check_rotation(task: JumpTask, can: Capability, name: str) -> None:
    box = can.settings.momentum[1] if task.rotation_rad > 0 else -can.settings.momentum[0]
    needed = least_momentum(can, task)
    if needed <= box:
        return
    heights = [h for h in _heights(can, task.height_m) if least_momentum(can, _at(task, h)) <= box]
    least = _above(heights[0]) if heights else None
    advice = f"heights of less than {least} m leave less time" if heights else "no height leaves time enough"
    raise InfeasibleError(
        f"rotation = {math.degrees(task.rotation_rad):g} deg: {_airtime(can, task):.2f} s in the air need an angular "
        f"momentum of at least {needed:.0f} kg m^2/s even with all limbs drawn in; stage 1 allows {name} {box:g}; "
        f"{advice}",
        number="rotation_rad",
        bound=heights[0] if heights else None,
    )


def _below(limit: float) -> str:
    return f"{math.floor(limit / STEP_M + 1e-9) * STEP_M:.2f}"


def _above(limit: float) -> str:
    return f"{math.ceil(limit / STEP_M - 1e-9) * STEP_M:.2f}"
