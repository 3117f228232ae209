"""A robot as the whole-body program sees it: the same numbers in every phase."""

from __future__ import annotations

from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.models.spatial import SpatialModel
from jumplab.robot import SAGITTAL_JOINTS, Robot
from jumplab.robot.contact import on_feet
from jumplab.robot.legs import leg_columns
from jumplab.robot.reduction import even_masses
from jumplab.robot.stance import knees, leg_length, stance_configuration
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.shapes import Box
from jumplab.task import GRAVITY

# of half the length of a shank's box, where a platform's edge may meet it
SHANK_SHARES = -0.8, -0.4, 0.0, 0.4, 0.8
LOCKED = 0.1  # of the determinant of a leg's Jacobian in the stance
LOCK_STEP_RAD = 0.02  # between the angles that are looked at
Spot = tuple[int, np.ndarray]  # a body, and a place in its frame (3,) [m]


class Body:
    """Tree, soles, knees, motors and shapes of a robot.

    The world's origin lies in the middle of the soles in their first place, x forward, z up.

    Attributes
    ----------
    model : the tree.  mg : weight on Earth [N].  stance : chart (6 + joints,) in which the robot
        waits.
    feet : bodies of the left and the right foot.  axes : (3, 3) of the soles in them.
    tips, middles : (3,) middle of the toe edge and of the sole, in them [m].
    corners : (2, 4, 3) of the soles, in them: toe left, toe right, heel left, heel right.
    places : (2, 3) middles of the toe edges in the stance [m].
    legs : columns of the chart that follow from a foot that stands, see :func:`leg_columns`.
    ankle_m : height of the feet's joints in the stance [m].  half_m : half a sole's length [m].
    ahead_m : by how much the CoM is ahead of the middle of the soles in the stance [m].
    """

    def __init__(self, robot: Robot):
        foot = robot.foot
        self.robot = robot
        self.made: dict[tuple, Any] = {}  # what others make of it, once
        self.model = SpatialModel(robot.model)
        self.mg = self.model.mass * GRAVITY
        self.half_m = (foot.toe - foot.heel) / 2
        tips = on_feet(robot, foot.tip)
        self.feet = [x.joint - 1 for x in tips]
        self.axes = [self.model.bodies[x.joint - 1].own.T @ x.placement.rotation for x in tips]
        self.tips = self._on_feet(foot.tip)
        self.middles = self._on_feet(foot.center)
        corners = [self._on_feet(x) for x in foot.corners[::-1]]
        self.corners = np.array(corners).swapaxes(0, 1)
        self.knees = knees(robot)
        self.legs = [columns.tolist() for columns in leg_columns(robot)]
        self.motors = robot.limits
        configuration = stance_configuration(robot)
        self.stance = self.model.of_pinocchio(configuration[None])[0]
        data = robot.model.createData()
        self.ahead_m = float(pin.centerOfMass(robot.model, data, configuration)[0])
        self.places = np.array([x.place(data).translation for x in tips])
        self.ankle_m = float(data.oMi[tips[0].joint].translation[2])

    def _on_feet(self, point: np.ndarray) -> list[np.ndarray]:
        """A point of the foot links' frames (3,), in the bodies of both feet."""
        anchors = on_feet(self.robot, point)
        return [self.model.local(x.joint, x.placement.translation) for x in anchors]

    def ranges(
        self, margin_rad: float, least_rad: float, most_rad: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper angles of the joints (joints,), by a margin off their stops, with knees
        bent by ``least_rad`` to ``most_rad``.
        """
        low = self.motors.lower + margin_rad
        high = self.motors.upper - margin_rad
        for k, sign, angle in self.knees:
            bent = sorted((sign * (least_rad - angle), sign * (most_rad - angle)))
            low[k] = max(low[k], bent[0])
            high[k] = min(high[k], bent[1])
        return low, high

    @cached_property
    def unlocked(self) -> tuple[np.ndarray, np.ndarray]:
        """Angles (joints,) [rad] between which each joint of a leg, the others as in the stance,
        leaves its foot all six ways to move: the determinant of the leg's Jacobian stays above
        :data:`LOCKED` of that in the stance.

        Infinite for joints that do not lock their leg (a hip's pitch between axes of yaw and roll
        does, where the thigh is level), for knees, which have a range of their own, and for
        :attr:`short` legs.
        """
        tree = self.robot.model
        data = tree.createData()
        low = np.full(tree.nv - BASE, -np.inf)
        high = -low
        q = stance_configuration(self.robot)
        for foot, leg, (knee, *_) in zip(self.feet, self.legs, self.knees, strict=True):
            for k in (column - BASE for column in leg if not self.short):
                angles = np.arange(self.motors.lower[k], self.motors.upper[k], LOCK_STEP_RAD)
                moved = np.tile(q, (len(angles), 1))
                moved[:, 7 + k] = angles
                slopes = [pin.computeJointJacobian(tree, data, x, foot + 1)[:, leg] for x in moved]
                ways = np.linalg.det(slopes)
                locked = angles[ways / np.interp(q[7 + k], angles, ways) < LOCKED]
                if k != knee:
                    low[k] = max(locked[locked < q[7 + k]], default=-np.inf)
                    high[k] = min(locked[locked > q[7 + k]], default=np.inf)
        return low, high

    @cached_property
    def squat_rad(self) -> float:
        """Flexion of the knees to which the hips' stops let the robot squat: hips turn by half of
        what the knees do, from the stance.
        """
        bent = min(sign * self.stance[BASE + k] + angle for k, sign, angle in self.knees)
        columns, signs = np.array(self.hips).T
        columns = columns.astype(int)
        stops = signs * [x[columns - BASE] for x in (self.motors.lower, self.motors.upper)]
        return float(bent + 2 * (signs * self.stance[columns] - stops.min(axis=0)).min())

    @cached_property
    def leg_m(self) -> float:
        """Length l of the legs in the stance [m]."""
        return leg_length(self.robot)

    @property
    def spin_size(self) -> float:
        """Natural size of angular momenta m l sqrt(g l) [kg m^2/s]."""
        return float(self.model.mass * self.leg_m * np.sqrt(GRAVITY * self.leg_m))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.model.names[BASE:]

    def chain(self, body: int) -> list[int]:
        """Bodies from one up to the base (which is left out)."""
        return [joint - 1 for joint in self.robot.model.supports[body + 1] if joint > 1][::-1]

    def _turning(self, joint: str) -> list[tuple[int, float]]:
        """Column of the chart of a sagittal ``joint`` on each side, and its sign about +y."""
        turning = [x for x in self.robot.role_signs() if SAGITTAL_JOINTS[x[1]] == joint]
        return [(BASE + self.joint_names.index(name), sign) for name, _, sign in turning]

    @cached_property
    def hips(self) -> list[tuple[int, float]]:
        """Columns of the chart of the hips' pitch, with the sign that makes backward positive."""
        return self._turning("hip")

    @cached_property
    def shoulders(self) -> list[tuple[int, float]]:
        """The same of the joints that swing the arms, if there are any."""
        return self._turning("shoulder")

    @cached_property
    def upper(self) -> list[int]:
        """Columns of the chart of the joints above a waist that have no role, and the waist's own;
        of a robot without a waist, none.
        """
        if not any(self.model.across[1:]):
            return []
        roles = {name for pair in self.robot.joints.values() for name in pair}
        legs = {body for foot in self.feet for body in self.chain(foot)}
        names = enumerate(self.joint_names, 1)
        return [BASE - 1 + k for k, name in names if k not in legs and name not in roles]

    @property
    def waist(self) -> list[int]:
        """Those in the middle of the robot."""
        return [k for k in self.upper if self.model.across[k - BASE + 1] is not None]

    @property
    def short(self) -> bool:
        """Whether a leg has fewer than six joints: both feet on the ground then hold yaw and roll
        of the base.
        """
        return min(len(x) for x in self.legs) < 6

    @cached_property
    def mirrored(self) -> bool:
        """Whether left and right are built alike, and every joint has its mirror image."""
        pairs = self.model.pairs
        all_paired = len({i for pair in pairs for i in pair[:2]}) == self.model.joints
        return all_paired and even_masses(self.robot.model, pairs)

    @cached_property
    def geometry(self) -> pin.GeometryModel:
        """Collision shapes of the links; its pairs are the :attr:`candidates`."""
        kind = pin.GeometryType.COLLISION
        geometry = pin.buildGeomFromUrdfString(self.robot.model, self.robot.urdf, kind)
        bodies = [shape.parentJoint - 1 for shape in geometry.geometryObjects]
        above = [b.parent for b in self.model.bodies]
        for i, k in combinations(range(len(bodies)), 2):
            a = bodies[i]
            b = bodies[k]
            if a not in (b, above[b]) and b != above[a]:
                geometry.addCollisionPair(pin.CollisionPair(i, k))
        return geometry

    @property
    def candidates(self) -> list[tuple[int, int]]:
        """Pairs of links that are no neighbours, as indices of :attr:`shapes`."""
        return [(pair.first, pair.second) for pair in self.geometry.collisionPairs]

    @cached_property
    def shapes(self) -> list[Box]:
        """Boxes around the collision shapes [m], in the same order."""
        out = []
        for shape in self.geometry.geometryObjects:
            shape.geometry.computeLocalAABB()
            low = shape.geometry.aabb_local.min_
            high = shape.geometry.aabb_local.max_
            body = shape.parentJoint - 1
            centre = self.model.local(body + 1, shape.placement.act((low + high) / 2))
            axes = self.model.bodies[body].own.T @ shape.placement.rotation
            out.append(Box(shape.name, body, centre, axes, (high - low) / 2))
        return out

    def _shapes_of(self, bodies: set[int]) -> list[tuple[Box, np.ndarray]]:
        """Boxes of some bodies, each with the way from its middle to its far end (3,) [m]."""
        boxes = (x for x in self.shapes if x.body in bodies)
        return [(x, x.axes[:, np.argmax(x.half)] * x.half.max()) for x in boxes]

    @cached_property
    def _shins(self) -> list[int]:
        """The bodies of both shanks: that of the knee, or of a second joint of it, if it has a
        shape.
        """
        shaped = {x.body for x in self.shapes}
        out = []
        for foot, (k, _, _) in zip(self.feet, self.knees, strict=True):
            up = self.chain(foot)
            below = up[1 : up.index(1 + k)]
            out.append(next((body for body in below if body in shaped), 1 + k))
        return out

    @cached_property
    def _shanks(self) -> list[tuple[Box, np.ndarray]]:
        return self._shapes_of({*self._shins})

    @cached_property
    def shank_m(self) -> float:
        """Half the thickness of the shank [m]: with a level shank its face is that much lower than
        the knee.
        """
        return float(max((min(box.half) for box, _ in self._shanks), default=0.0))

    @cached_property
    def shank_points(self) -> list[Spot]:
        """Places along the middle of the boxes of the shanks."""
        return [
            (x.body, x.centre + share * way) for x, way in self._shanks for share in SHANK_SHARES
        ]

    @cached_property
    def trunk_boxes(self) -> list[Box]:
        """Boxes of the bodies that neither end a limb nor are of a leg."""
        legs = {body for foot in self.feet for body in self.chain(foot)} - {0}
        inner = {b.parent for b in self.model.bodies} - legs
        return [x for x in self.shapes if x.body in inner]

    @cached_property
    def limb_points(self) -> list[Spot]:
        """Knees, and the far ends of the bodies that end a limb but are no feet."""
        points = [(body, np.zeros(3)) for body in self._shins]
        ends = set(range(len(self.model.bodies))) - {b.parent for b in self.model.bodies}
        for box, way in self._shapes_of(ends - set(self.feet)):
            points.append((box.body, box.centre + (way if way @ box.centre > 0 else -way)))
        return points
