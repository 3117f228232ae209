"""Edges where the ground steps up or down: at a platform, or between the places of a schedule."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.errors import InfeasibleError, InputError
from jumplab.robot import Robot
from jumplab.robot.stance import leg_length
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import SIDES, Contacts
from jumplab.stages.whole_body.settings import Limits
from jumplab.task import JumpTask

# of a leg, from the toes to an edge: onto 0.19 m a jump of the G1 costs twice as much from half of
# this way; there, 0.2 m are the highest that was found, 0.59 m from here
CROUCH = 0.3


@dataclass(frozen=True)
class Surface:
    """Ground that steps up or down.

    Attributes
    ----------
    height_m : of the part beyond the edge.
    edge_m : where the edge is, ahead of the world's origin.
    along_rad : the way in which it is ahead.
    room_m : by how much the upper part could reach further before it met a sole.
    over : (from, to, top) of a block that lies on it, ahead of the world's origin [m].
    """

    height_m: float = 0.0
    edge_m: float = 0.0
    along_rad: float = 0.0
    room_m: float = 0.0
    over: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def between(
        cls, leaving: float, arriving: float, height: float, limits: Limits, along_rad: float = 0.0
    ) -> Surface:
        """The one between toes that leave and heels that arrive, so far ahead of the origin [m];
        the part beyond is ``height`` [m] above the other.

        It steps up a little before the heels, or down a little ahead of the toes.
        """
        gap = limits.edge_before_heel_m
        edge = leaving + gap if height < 0 else arriving - gap
        return cls(height, edge, along_rad, max(0.0, arriving - leaving - gap))

    def below(self, points: np.ndarray) -> np.ndarray:
        """Height of the ground below points (..., 3) [m]."""
        ahead = points[..., :2] @ self.along
        first, last, top = self.over
        level = np.where(ahead > self.edge_m, self.height_m, 0.0)
        return np.where((first < ahead) & (ahead < last), top, level)

    @property
    def along(self) -> np.ndarray:
        """Unit vector (2,) of the way in which the edge is ahead."""
        return np.array([np.cos(self.along_rad), np.sin(self.along_rad)])

    def reaching(self, more_m: float) -> float:
        """Place of the edge [m] if the upper part reached further, by ``more_m`` at most."""
        return float(self.edge_m - np.sign(self.height_m) * min(more_m, self.room_m))


def platform_edge_m(task: JumpTask, robot: Robot, limits: Limits = Limits()) -> float:
    """Place where the ground steps up or down in a jump straight ahead, from the toes' first place
    [m].

    A platform begins a little before the landing heel; when the robot jumps down, the launching
    surface ends a little ahead of its toe.
    """
    heel = task.distance_m - (robot.foot.toe - robot.foot.heel)
    return Surface.between(0.0, heel, task.platform_m, limits).edge_m


def clear_of_edge_m(robot: Robot, limits: Limits = Limits()) -> float:
    """Distance of a platform from which on its edge is far enough for a crouch, in which shanks
    lean over the toes [m], to whole centimetres.
    """
    least = robot.foot.toe - robot.foot.heel + limits.edge_before_heel_m
    return float(np.ceil(100 * (least + CROUCH * leg_length(robot))) / 100)


def surface_of_jump(body: Body, limits: Limits, task: JumpTask) -> Surface:
    """The ground of a jump to a target, with the soles in their places of the stance [m].

    Raises :class:`InfeasibleError` for a platform so near that a sole would stand across its edge.
    """
    foot = body.robot.foot
    turn = pin.rpy.rpyToMatrix(0.0, 0.0, task.yaw_rad)[:2, :2]
    along = Surface(along_rad=task.along_rad).along
    corners = (body.places[:, None] + foot.corners - foot.tip).reshape(-1, 3)[:, :2]
    way = np.array([task.distance_m, task.side_m])
    leaving = float((corners @ along).max())
    arriving = float(((way + corners @ turn.T) @ along).min())
    apart = arriving - leaving - limits.edge_before_heel_m
    if task.platform_m and apart < -1e-9:  # rounding
        length = float(np.hypot(*way))
        least = float(np.ceil(100 * (length - apart) - 1e-6) / 100)
        raise InfeasibleError(
            f"platform = {task.platform_m:g} m at a distance of {length:g} m: the two surfaces "
            f"would meet under a sole of {body.robot.name}; the distance must be at least "
            f"{least:.2f} m",
            number="distance_m",
            bound=least,
        )
    return Surface.between(leaving, arriving, task.platform_m, limits, task.along_rad)


def surface_of_schedule(body: Body, limits: Limits, contacts: Contacts, task: JumpTask) -> Surface:
    """The ground of a schedule, between its places on either height, or of the target that it is
    for [m].

    Raises :class:`InfeasibleError` if no edge fits between them, and :class:`InputError` if a foot
    would come down on the schedule's block; the sentence names the phase.
    """
    height, first = contacts.surface
    n_initial = len(contacts.first)
    if contacts.aimed:
        height = task.platform_m
        numbers = range(n_initial, len(contacts.landings))
        first = sum(not contacts.is_aimed(i) for i in numbers)
    before = [0.0, *(p.ahead_m for p in contacts.places[:first])]
    after = [p.ahead_m for p in contacts.places[first:]]
    if contacts.aimed:
        after = [before[-1] + task.distance_m]
    toes = float(body.places[:, 0].mean())
    length = 2 * body.half_m
    if contacts.over:
        begin, end, top = contacts.over
        places = [*contacts.first, *contacts.places]
        for i, (place, (phase, side)) in enumerate(zip(places, contacts.landings, strict=True)):
            heel, toe = place.ahead_m - length, place.ahead_m
            if heel < end and begin < toe and not contacts.is_aimed(i):
                raise InputError(
                    f"phase {contacts.phases[phase].name!r}: the {SIDES[side]} foot would come "
                    f"down from {heel:.2f} to {toe:.2f} m, on the block from {begin:.2f} to "
                    f"{end:.2f} m; make its ahead_m at most {begin:.2f} m, or at least "
                    f"{end + length:.2f} m"
                )
        return Surface(over=(toes + begin, toes + end, top))
    if height == 0:
        return Surface()
    leaving = toes + max(before)
    arriving = toes + min(after) - length
    room = 2 * limits.edge_before_heel_m
    if arriving - leaving < room:
        phase, _ = contacts.landings[n_initial + first]
        number = "distance_m" if contacts.aimed else "ahead_m"
        from_here = before[-1] if contacts.aimed else 0.0
        bound = float(np.ceil(100 * (max(before) + room + length - from_here) - 1e-6) / 100)
        raise InfeasibleError(
            f"phase {contacts.phases[phase].name!r}: feet come down on a surface {height:g} m "
            f"higher that would begin {arriving - leaving:.2f} m ahead of the toes before it, must "
            f"be at least {room:.2f} m; make {number} at least {bound:.2f} m",
            number=number,
            bound=bound,
        )
    return Surface.between(leaving, arriving, height, limits)
