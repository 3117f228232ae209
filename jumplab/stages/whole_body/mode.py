"""A mode of contact: which feet carry, and the coordinates, forces and torques that go with it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from jumplab.robot.contact import pyramid
from jumplab.robot.locked import LockedJoint
from jumplab.robot.motors import MotorLimits
from jumplab.robot.reduction import EXACT_M
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import SIDES, modes_of
from jumplab.stages.whole_body.coordinates import BASE, Coordinates, whole
from jumplab.stages.whole_body.settings import Limits, Weights


@dataclass(eq=False, repr=False)
class Mode:
    """Numbers of one mode of contact.

    Attributes
    ----------
    feet : that carry, as of :class:`.ContactPhase`.
    free : the coordinates that move, all if None.
    modes : side -> "flat" or "toe" of them; none in flight.
    coordinates : of a phase in this mode: the chart, then the pitch of each foot on its toes.
    states : force along each edge of each sole point's friction pyramid in the axes of the
        foothold, then torques.
    edges : (k, 3) of those pyramids, with a vertical force of one.
    points : (k, 3) of each sole where forces act, seen from the middle of the toe edge [m]; the
        toes' first.
    sides : those of the modes that have rows and forces of their own; in an even motion the left
        foot stands for both.
    integrated : coordinates that do not follow from feet in place or from flight.
    held, locked : that have to carry something, see :func:`held_joints`.
    """

    body: Body
    limits: Limits
    weights: Weights
    feet: str
    free: Coordinates | None = None

    def __post_init__(self):
        body = self.body
        self.modes = modes_of(self.feet)
        self.robot = body.robot
        self.model = body.model
        self.free = free = self.free or whole(body)
        self.flying = not self.modes
        self.nv = free.size
        self.sides = [side for side in self.modes if side in free.sides]
        self.raised = [side for side in self.sides if self.modes[side] == "toe"]
        pitches = (f"pitch of {SIDES[side]} foot" for side in self.raised)
        self.coordinates = (*free.free_names, *pitches)
        self.edges = pyramid(self.limits.friction)[: 2 if free.plane else 4]
        self.points = {side: self._sole_points(self.modes[side]) for side in self.sides}
        names = [
            f"force {k} of {SIDES[side]} foot"
            for side in self.sides
            for k in range(len(self.edges) * len(self.points[side]))
        ]
        self.n_forces = len(names)
        self.states = (*names, *(f"torque of {body.joint_names[k]}" for k in free.joints))
        self.short = body.short and not free.even
        follows = set(range(BASE)) if self.flying else set()
        follows.update(k for side in self.sides for k in body.legs[side])
        if body.short and len(self.modes) == 2:
            follows |= {1, 3, 4}
        gone = {self.model.names[k] for k in follows}
        self.integrated = tuple(x for x in self.coordinates if x not in gone)
        self.held, self.locked = held_joints(body, free)

    @property
    def usable_torques(self) -> np.ndarray:
        """Torques (joints,) that a plan may ask of the motors, less their dry friction [N m]."""
        return self.limits.torque_share * self.body.motors.effort - self.body.motors.friction

    @cached_property
    def motors(self) -> MotorLimits:
        """Of the free joints."""
        return self.body.motors[self.free.joints]

    @property
    def constants(self) -> list[str]:
        """Names of the flight's constants: the CoM's place and velocity as it begins, and L."""
        moved = [f"{kind}_{'xyz'[k]}" for kind in ("com", "vel") for k in self.free.places]
        return [*moved, *(f"L_{'xyz'[k]}" for k in self.free.spins)]

    def _sole_points(self, mode: str) -> np.ndarray:
        half_width = self.robot.foot.half_width
        half_m = self.body.half_m
        wide = half_width - min(self.limits.side_margin_m, 0.4 * half_width)
        length = 2 * half_m - min(self.limits.cop_margin_m, 0.4 * half_m)
        back = (0.0, -length) if mode == "flat" else (0.0,)
        across = (0.0,) if self.free.plane else (wide, -wide)
        return np.array([[x, y, 0.0] for x in back for y in across])

    def spread_forces(self, z: np.ndarray, side: int) -> np.ndarray:
        """Forces (n, .) along the edges of the pyramids of one foot when all coordinates are free,
        of even ones (n, .).

        In the plane a point stands for two, one on each side of the sole; a right foot is the
        mirror image of a left.
        """
        f = z.reshape(len(z), -1, len(self.edges))
        if self.free.plane:
            f = np.repeat(np.concatenate([f / 2, 0 * f], axis=2), 2, axis=1)
        elif side:
            f = f.reshape(len(z), -1, 2, 4)[:, :, ::-1][..., [0, 1, 3, 2]]
        return f.reshape(len(z), -1)

    def moving(self, x: ca.SX) -> ca.SX:
        """Entries (.,), of derivatives ``x`` of the coordinates, for rotations: attitude of the
        base, and the joints of both sides that are not held.
        """
        angles = [k for k in self.free.free if 3 <= k < BASE]
        joints = BASE + np.flatnonzero(np.abs(self.free.spread[BASE:]).any(axis=1))
        return self.free.chart(x, 1)[[*angles, *joints.tolist()]]


def held_joints(body: Body, free: Coordinates) -> tuple[list[int], list[LockedJoint]]:
    """Joints of the left half that are held in such a motion, as indices, and those of the
    published robot that never move; both have to carry something."""
    held = [
        k - 1
        for k in (body.model.left_half if free.plane and not body.robot.planar else ())
        if body.model.across[k] is None and k - 1 not in free.joints
    ]
    return held, [x for x in body.robot.locked if not (free.even and _idle(x))]


def _idle(joint: LockedJoint) -> bool:
    """Whether a joint has nothing to hold in an even motion, or its mirror image holds as much."""
    beside = joint.place[1]
    return beside < -EXACT_M or (beside < EXACT_M and abs(joint.axis[1]) < EXACT_M)
