"""Quantities of a step that a term of stage 2 can use: numbers, and expressions that are affine in
the step's unknowns.

>>> still = jl.Term("still hands", "ours", "m/s^2", "node",
...                 lambda p: p.point("left_hand").acceleration, weight=1e-3)
>>> low = jl.Term("knee", "ours", "N m", "node", lambda p: p.torques.knee, lower=-150, upper=150)
>>> planner = jl.Planner(robot, terms={"joint qp/flight": [still], "joint qp/launch": [low]})

Every step has its own QP, which sees no later step. So a cost with a larger weight is smaller in
every step from the same state, but over the roll-out only while no joint is braked before its stop:
arms with a larger weight, say, swing on freely, meet the stop faster, and are braked harder there
than if an earlier step had slowed them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, quoted
from jumplab.models.full import FullBody, FullTerms
from jumplab.models.names import ByJoint
from jumplab.robot.contact import moving, point_motion


class Affine:
    """Quantities that are affine in a step's unknowns x: ``matrix @ x + offset``.

    ``+`` and ``-`` with another one or with numbers, ``*`` and ``/`` by numbers, ``M @``,
    ``[...]``.

    Attributes
    ----------
    matrix, offset : (m, size of x), (m,).  labels : names of the rows in sentences.
    """

    __array_ufunc__ = None  # arrays leave + - * @ to this class
    __slots__ = ("labels", "matrix", "offset")

    def __init__(self, matrix: np.ndarray, offset: np.ndarray, labels: Iterable[str] = ()):
        self.matrix = np.atleast_2d(matrix)
        self.offset = np.atleast_1d(offset)
        self.labels = tuple(labels)

    def named(self, labels: Iterable[str]) -> Affine:
        """The same with names of its rows."""
        return Affine(self.matrix, self.offset, labels)

    def __len__(self) -> int:
        return len(self.offset)

    def __getitem__(self, rows: Any) -> Affine:
        return Affine(self.matrix[rows], self.offset[rows])

    def __add__(self, other: Any) -> Affine:
        if isinstance(other, Affine):
            return Affine(self.matrix + other.matrix, self.offset + other.offset)
        offset = self.offset + np.asarray(other, float)
        return Affine(np.broadcast_to(self.matrix, (len(offset), self.matrix.shape[1])), offset)

    def __mul__(self, factor: Any) -> Affine:
        if isinstance(factor, Affine):
            raise TypeError(
                "two quantities that depend on the accelerations were multiplied; "
                "a QP's rows are affine"
            )
        factor = np.asarray(factor, float)
        return Affine(self.matrix * factor[..., None], self.offset * factor)

    def __rmatmul__(self, left: Any) -> Affine:
        return Affine(np.asarray(left, float) @ self.matrix, np.asarray(left, float) @ self.offset)

    def __neg__(self) -> Affine:
        return self * -1.0

    def __sub__(self, other: Any) -> Affine:
        return self + (-other if isinstance(other, Affine) else -np.asarray(other, float))

    def __rsub__(self, other: Any) -> Affine:
        return -self + other

    def __truediv__(self, number: Any) -> Affine:
        return self * (1 / np.asarray(number, float))

    __radd__ = __add__
    __rmul__ = __mul__


@dataclass(frozen=True)
class Place:
    """A point of the robot, world axes: position (3,) [m], velocity (3,) [m/s], acceleration (3
    rows) [m/s^2].
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: Affine


class StepPoint:
    """The robot in the middle of a step, whose accelerations are unknown.

    Numbers are known at that instant, :class:`Affine` quantities depend on the unknowns: theta''
    and, in launch, the feet's wrenches F. Places are in world axes, x forward, z up; joint angles
    are positive about +y.

    Parameters
    ----------
    body : the robot.  first : index of theta'' in x, 12 in launch and 0 in flight.
    quantities : the robot's at that instant.  time : since the phase began [s].
    target : what the step asks for; None where terms are only looked at.

    Attributes
    ----------
    joints, joint_rates : by name, numbers [rad, rad/s].
    joint_accelerations, torques : by name, of each side by itself [rad/s^2, N m].
    com, com_velocity : of the centre of mass, numbers (3,) [m, m/s].
    com_acceleration : A_c theta'' + B_c (3 rows) [m/s^2].
    L, L_rate : angular momentum about the CoM, about +y: number, 1 row [kg m^2/s, N m].
    inertia, inertia_rate : pitch inertia rho about the CoM, numbers [kg m^2, kg m^2/s].
    inertia_acceleration : J_rho theta'' + drift (1 row) [kg m^2/s^2].
    accelerations : theta'' (nv rows): of the base, linear then angular in its own axes, then of the
        joints [m/s^2, rad/s^2].
    forces : M theta'' + H - J^T F (nv rows): what nothing but the joints' motors can give, so zero
        for the base; its force and moment, then the joints' torques [N, N m].
    wrench : launch only: force and moment at the left and the right tiptoe, world axes (12 rows)
        [N, N m].
    """

    def __init__(
        self,
        body: FullBody,
        first: int,
        quantities: FullTerms,
        time: float,
        target: Any = None,
    ):
        x = quantities
        self._hidden = {"body", "quantities", "target"}
        self._first = first
        self.body = body
        self.quantities = x
        self.target = target
        self.time = float(time)
        self.com = x.com
        self.com_velocity = x.com_velocity
        self.L = float(x.momentum[4])
        self.inertia = x.rho
        self.inertia_rate = x.rho_rate
        self.accelerations = self.affine(np.eye(body.nv))
        self.forces = self.affine(x.M, x.H, -x.J.T if first else 0.0)
        self.com_acceleration = self.affine(x.A_c, x.B_c)
        self.L_rate = self.affine(x.A_h[4], x.B_h[4])
        self.inertia_acceleration = self.affine(x.J_rho, x.drift_rho)
        self.joints = ByJoint(body.robot, x.q[7:])
        self.joint_rates = ByJoint(body.robot, x.v[6:])
        self.joint_accelerations = ByJoint(body.robot, self.accelerations[6:])
        self.torques = ByJoint(body.robot, self.forces[6:])
        if first:
            self.wrench = Affine(np.eye(first, first + body.nv), np.zeros(first))

    def __getattr__(self, name: str) -> Any:
        names = (n for n in dir(self) if not n.startswith("_") and n not in self._hidden)
        raise AttributeError(
            f"a point of this phase has no {quoted(name)}; it has {', '.join(sorted(names))}"
        )

    def affine(self, jacobian: np.ndarray, drift: Any = 0.0, forces: Any = 0.0) -> Affine:
        """``jacobian`` (m, nv) theta'' + ``drift`` (m,) + ``forces`` (m, 12) F."""
        jacobian = np.atleast_2d(jacobian)
        left = np.broadcast_to(forces, (len(jacobian), self._first))
        offset = np.broadcast_to(np.asarray(drift, float), len(jacobian))
        return Affine(np.concatenate([left, jacobian], 1), offset)

    def point(self, name: str) -> Place:
        """A point by name: "left_toe", "left_heel", "left_sole", "left_hand", the right ones, or a
        frame of the URDF.

        Raises :class:`InputError` with the names that exist.
        """
        anchors = self.body.anchors
        if name not in anchors:
            raise InputError(
                f"the robot has no point {quoted(name)}; it has {', '.join(sorted(anchors))}"
            )
        x = point_motion(self.body.model, self._data, anchors[name])
        return Place(x.place, x.velocity[:3], self.affine(x.jacobian[:3], x.drift[:3]))

    @cached_property
    def _data(self) -> pin.Data:
        # of its own: the body's scratch data belongs to who made the quantities
        data = self.body.model.createData()
        moving(self.body.model, data, self.quantities.q, self.quantities.v)
        return data
