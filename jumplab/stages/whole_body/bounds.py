"""Bounds that no motion of a robot exceeds in a jump from a stand: by contact, reach and power,
derived in ``notebooks/15_records``.

They know nothing of a plan but its target, the friction, and how long the robot may push off.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from jumplab.errors import InfeasibleError
from jumplab.robot.contact import on_feet
from jumplab.robot.stance import stance_configuration
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.settings import Limits
from jumplab.task import JumpTask

CELLS = 40  # of the CoM's heights at take-off and at touchdown, between 0 and the reach
WEIGHINGS = np.linspace(0.1, 6.0, 60)[:, None, None]  # lambda [1/s] of the bound on a speed
ROUNDING_M = 1e-6
WAYS = {"distance_m": np.array([1.0, 0.0]), "side_m": np.array([0.0, 1.0])}


def most(body: Body, limits: Limits, task: JumpTask, what: str) -> float:
    """The largest ``what`` ("height_m", "distance_m", "platform_m" or "side_m") of a target [m]
    that any motion could reach, the rest of it as in ``task``; inf where there is no bound.
    """
    reach, start = reach_and_start(body)
    if what in WAYS:
        return _travel(body, limits, task, WAYS[what])
    if what == "height_m":
        work = _power(body, limits) * push_s(limits)
        return work / (body.model.mass * task.gravity) + float(start[2])
    return reach + task.height_m if what == "platform_m" else math.inf


def refuse_impossible(body: Body, limits: Limits, task: JumpTask) -> None:
    """Refuse (:class:`InfeasibleError`) a target that is beyond a bound which holds for every
    motion.
    """
    way = np.array([task.distance_m, task.side_m])
    length = float(np.hypot(*way))
    asked = [
        (number, word, getattr(task, number), most(body, limits, task, number))
        for number, word in (("height_m", "rise"), ("platform_m", "platform"))
    ]
    if length:
        number = "distance_m" if task.distance_m else "side_m"
        asked.append((number, "travel", length, _travel(body, limits, task, way / length)))
    for number, word, x, bound in asked:
        if x > bound + ROUNDING_M:
            rise = "" if number == "height_m" else f" with a rise of {task.height_m:g} m"
            raise InfeasibleError(
                f"a {word} of {x:g} m{rise} is impossible for robot {body.robot.name}: none of its "
                f"motions exceeds {bound:.2f} m, by reach and power, friction {limits.friction:g} "
                f"and a push of at most {push_s(limits):.3g} s",
                number=number,
                bound=bound,
            )


def push_s(limits: Limits) -> float:
    """Longest push-off of a jump from a stand [s]."""
    return limits.flat_s[1] + limits.toe_s[1]


def _travel(body: Body, limits: Limits, task: JumpTask, along: np.ndarray) -> float:
    """The most by which the soles could come ``along`` (2,), a unit vector seen from above [m]."""
    reach, start = reach_and_start(body)
    g = task.gravity
    edges = np.linspace(0.0, reach, CELLS + 1)
    # cells (weighings, z at take-off, z at touchdown): each with what of it is worst
    low = edges[:-1, None]
    landing = edges[:-1]
    fall = task.takeoff_speed**2 + 2 * g * (edges[1:, None] - landing - task.platform_m)
    flight_s = (task.takeoff_speed + np.sqrt(np.maximum(fall, 0.0))) / g
    lean = np.sqrt(reach**2 - low**2)
    late = WEIGHINGS * push_s(limits) - 1
    held = (1 + late * np.abs(late)) / (2 * WEIGHINGS)
    up = task.takeoff_speed + WEIGHINGS * (2 * reach - low - start[2])
    speed = limits.friction * (up + g * held) + WEIGHINGS * (lean - start[:2] @ along)
    way = lean + speed * flight_s + np.sqrt(reach**2 - landing**2)
    turned = 2 * abs(math.sin(task.yaw_rad / 2)) * body.half_m
    return float(np.where(fall < 0, -np.inf, way).max(axis=(1, 2)).min()) + turned


def _power(body: Body, limits: Limits) -> float:
    """The most that all motors give at once [W]."""
    motors = body.motors
    rate = np.maximum(motors.corner_speed, motors.no_load_speed / 2)
    rate = np.minimum(rate, limits.speed_share * motors.speed)
    return float(limits.torque_share * (motors.range(rate)[1] * rate).sum())


def reach_and_start(body: Body) -> tuple[float, np.ndarray]:
    """Largest distance of the CoM from the toes' edges [m], and its place (3,) in the first stance
    as seen from there [m]; each link counts from its own foot, those between the legs from both.
    """
    if "reach" not in body.made:
        tree = body.robot.model
        tips = on_feet(body.robot, body.robot.foot.tip)
        sides = [_distances(tree, x.joint, x.placement.translation) for x in tips]
        legs = [np.isin(range(1, tree.njoints), tree.supports[x.joint]) for x in tips]
        mass = np.array([x.mass for x in list(tree.inertias)[1:]])
        share = mass / mass.sum() * (1 + np.subtract(legs, legs[::-1], dtype=float)) / 2
        com = pin.centerOfMass(tree, tree.createData(), stance_configuration(body.robot))
        body.made["reach"] = float((share * sides).sum()), com - share.sum(axis=1) @ body.places
    return body.made["reach"]


def _distances(tree: pin.Model, foot: int, tip: np.ndarray) -> np.ndarray:
    """Largest distances of the CoM of each body (bodies,) from a point of the ``foot``, its ``tip``
    (3,): the way through all joints between them, whatever their angles [m].
    """
    out = np.zeros(tree.njoints)
    left = [(foot, tip, 0.0, 0)]
    while left:  # where the way comes into a body, how long it is, and from where
        body, entry, way, before = left.pop()
        out[body] = way + np.linalg.norm(tree.inertias[body].lever - entry)
        origins = tree.jointPlacements
        beside = [(tree.parents[body], np.zeros(3), origins[body].translation)]
        beside += [(k, origins[k].translation, np.zeros(3)) for k in tree.children[body]]
        for other, here, there in beside:
            if other not in (0, before):
                left.append((other, there, way + np.linalg.norm(here - entry), body))
    return out[1:]
