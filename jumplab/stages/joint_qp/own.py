"""Own rows of stage 2: what a term sees of a step, and how its expression becomes rows of the step's QP.

>>> still = jl.Term("still hands", "ours", "m/s^2", "node", lambda p: p.point("left_hand").acceleration, weight=1e-3)
>>> low = jl.Term("knee", "ours", "N m", "node", lambda p: p.torques.knee, lower=-150, upper=150)
>>> plan = stages.joint_qp.map_to_joints(srmp, robot, terms={"flight": [still], "launch": [low]})

Every step has its own QP, which sees no later step. So a cost with a larger weight is smaller in every step from the
same state, but over the roll-out only while no joint is braked before its stop: dearer arms, say, swing on freely, meet
the stop faster, and are braked harder there than if an earlier step had slowed them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, quoted
from jumplab.models.full import FullBody, FullTerms, skew
from jumplab.models.names import ByJoint
from jumplab.ocp import Term
from jumplab.ocp.changes import ends

SIDES = ("left", "right")


class Affine:
    """Quantities that are affine in a step's unknowns x: ``matrix @ x + offset``.

    ``+`` and ``-`` with another one or with numbers, ``*`` and ``/`` by numbers, ``M @``, ``[...]`` and :meth:`stack`.

    Attributes
    ----------
    matrix, offset : (m, size of x), (m,).
    """

    __array_ufunc__ = None  # arrays leave + - * @ to this class
    __slots__ = ("matrix", "offset")

    def __init__(self, matrix: np.ndarray, offset: np.ndarray):
        self.matrix, self.offset = np.atleast_2d(matrix), np.atleast_1d(offset)

    @classmethod
    def stack(cls, *parts: Affine) -> Affine:
        """One below the other."""
        return cls(np.concatenate([x.matrix for x in parts]), np.concatenate([x.offset for x in parts]))

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
            raise TypeError("two quantities that depend on the accelerations were multiplied; a QP's rows are affine")
        factor = np.asarray(factor, float)
        return Affine(self.matrix * factor[..., None], self.offset * factor)

    def __rmatmul__(self, left: Any) -> Affine:
        return Affine(np.asarray(left, float) @ self.matrix, np.asarray(left, float) @ self.offset)

    def __neg__(self) -> Affine:
        return Affine(-self.matrix, -self.offset)

    def __sub__(self, other: Any) -> Affine:
        return self + (-other if isinstance(other, Affine) else -np.asarray(other, float))

    def __rsub__(self, other: Any) -> Affine:
        return -self + other

    def __truediv__(self, number: Any) -> Affine:
        return self * (1 / np.asarray(number, float))

    __radd__, __rmul__ = __add__, __mul__


@dataclass(frozen=True)
class Place:
    """A point of the robot, world axes: position (3,) [m], velocity (3,) [m/s], acceleration (3 rows) [m/s^2]."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: Affine


class StepPoint:
    """What an own term of stage 2 sees: the robot in the middle of a step, whose accelerations are unknown.

    Numbers are known at that instant, :class:`Affine` quantities depend on the unknowns: theta'' and, in launch, the
    feet's wrenches. Places are in world axes, x forward, z up; joint angles are positive about +y.

    Parameters
    ----------
    body : the robot.  first : index of theta'' in x.  terms : its quantities.  time : since the phase began [s].
    """

    def __init__(self, body: FullBody, first: int, terms: FullTerms, time: float):
        self._body, self._first, self._terms, self.time = body, first, terms, float(time)
        self._data: Any = None

    def __getattr__(self, name: str) -> Any:
        names = [n for n in dir(type(self)) if not n.startswith("_")] + ["time"]
        if not self._first:
            names.remove("wrench")
        raise AttributeError(f"a point of this phase has no {quoted(name)}; it has {', '.join(sorted(names))}")

    def _of(self, jacobian: np.ndarray, drift: Any, forces: Any = 0.0) -> Affine:
        """``jacobian`` theta'' + drift + ``forces`` F."""
        jacobian = np.atleast_2d(jacobian)
        left = np.broadcast_to(forces, (len(jacobian), self._first))
        return Affine(np.concatenate([left, jacobian], 1), np.atleast_1d(drift))

    @property
    def joints(self) -> ByJoint:
        """Joint angles [rad]: numbers."""
        return ByJoint(self._body.robot, self._terms.q[7:])

    @property
    def joint_rates(self) -> ByJoint:
        """Joint rates [rad/s]: numbers."""
        return ByJoint(self._body.robot, self._terms.v[6:])

    @property
    def joint_accelerations(self) -> ByJoint:
        """Joint accelerations [rad/s^2]: affine."""
        return ByJoint(self._body.robot, self.accelerations[6:])

    @property
    def torques(self) -> ByJoint:
        """Joint torques, M theta'' + H - J^T F, of each side by itself [N m]: affine."""
        x = self._terms
        forces = -x.J[:, 6:].T if self._first else 0.0
        return ByJoint(self._body.robot, self._of(x.M[6:], x.H[6:], forces))

    @property
    def accelerations(self) -> Affine:
        """theta'' (nv rows): of the base, linear then angular in its own axes, then of the joints [m/s^2, rad/s^2]."""
        return self._of(np.eye(self._body.nv), np.zeros(self._body.nv))

    @property
    def com(self) -> np.ndarray:
        """Centre of mass (3,) [m]."""
        return self._terms.com

    @property
    def com_velocity(self) -> np.ndarray:
        """Its velocity (3,) [m/s]."""
        return self._terms.com_velocity

    @property
    def com_acceleration(self) -> Affine:
        """Its acceleration, A_c theta'' + B_c (3 rows) [m/s^2]."""
        return self._of(self._terms.A_c, self._terms.B_c)

    @property
    def L(self) -> float:
        """Angular momentum about the CoM, about +y [kg m^2/s]."""
        return float(self._terms.momentum[4])

    @property
    def L_rate(self) -> Affine:
        """Its rate (1 row) [N m]."""
        return self._of(self._terms.A_h[4], self._terms.B_h[4])

    @property
    def inertia(self) -> float:
        """Pitch inertia about the CoM, rho [kg m^2]."""
        return float(self._terms.rho)

    @property
    def inertia_rate(self) -> float:
        """Its rate [kg m^2/s]."""
        return float(self._terms.rho_rate)

    @property
    def inertia_acceleration(self) -> Affine:
        """Its second derivative, J_rho theta'' + drift (1 row) [kg m^2/s^2]."""
        return self._of(self._terms.J_rho, self._terms.drift_rho)

    @property
    def wrench(self) -> Affine:
        """Launch only: force and moment at the left and the right tiptoe, world axes (12 rows) [N, N m]."""
        if not self._first:
            return self.__getattr__("wrench")
        return Affine(np.eye(self._first, self._first + self._body.nv), np.zeros(self._first))

    def point(self, name: str) -> Place:
        """A point by name: "left_toe", "left_heel", "left_sole", "left_hand", the right ones, or a frame of the URDF.

        Raises :class:`InputError` with the names that exist.
        """
        joint, offset = self._anchor(name)
        model, terms = self._body.model, self._terms
        if self._data is None:  # of its own: the body's scratch data belongs to who made the terms
            self._data = model.createData()
            pin.computeJointJacobians(model, self._data, terms.q)
            pin.forwardKinematics(model, self._data, terms.q, terms.v, np.zeros(model.nv))
        data, axes = self._data, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        arm = data.oMi[joint].rotation @ offset
        J = pin.getJointJacobian(model, data, joint, axes)
        spin = pin.getVelocity(model, data, joint, axes).angular
        turn = pin.getAcceleration(model, data, joint, axes).angular
        drift = pin.getClassicalAcceleration(model, data, joint, axes).linear
        drift = drift + np.cross(turn, arm) + np.cross(spin, np.cross(spin, arm))
        linear = J[:3] - skew(arm) @ J[3:]
        return Place(data.oMi[joint].translation + arm, linear @ terms.v, self._of(linear, drift))

    def _anchor(self, name: str) -> tuple[int, np.ndarray]:
        """Joint that carries a point, and where it is in that joint's frame (3,)."""
        body, model = self._body, self._body.model
        known = {frame.name: (frame.parentJoint, frame.placement.translation) for frame in model.frames[1:]}
        for i, side in enumerate(SIDES):
            for place, offset in zip(("toe", "heel", "sole"), body.foot_points[i], strict=True):
                known[f"{side}_{place}"] = body.foot_joints[i], offset
            if pair := body.robot.joints["shoulder_pitch"]:
                shoulder, (x, z) = model.getJointId(pair[i]), body.robot.sagittal.points["hand"][1]
                neutral = model.createData()
                pin.forwardKinematics(model, neutral, pin.neutral(model))
                known.setdefault(f"{side}_hand", (shoulder, neutral.oMi[shoulder].rotation.T @ [x, 0.0, z]))
        if name not in known:
            raise InputError(f"the robot has no point {quoted(name)}; it has {', '.join(sorted(known))}")
        return known[name]


class OwnRows:
    """Own terms of one phase as blocks of its QP: costs in A, equalities in E, each finite bound of the others in G.

    Parameters
    ----------
    phase : its name.  terms : of this phase, none with weight 0.  point : :class:`StepPoint` of (FullTerms, time).
    start : quantities at which every term is looked at, before anything is solved.
    """

    def __init__(self, phase: str, terms: Sequence[Term], point: Callable[..., StepPoint], start: FullTerms):
        self.phase, self.terms, self._point = phase, tuple(terms), point
        self.blocks: dict[str, list[tuple[str, Iterable[str]]]] = {"A": [], "E": [], "G": []}
        seen, self._sides = point(start, 0.0) if terms else None, {}
        for term in self.terms:
            size = len(self._rows(term, seen))
            low, high = ends(self._who(term), term, size)
            matrix = "A" if term.is_cost else "E" if np.array_equal(low, high) else "G"
            self._sides[term.name] = matrix, low, high, np.isfinite(low), np.isfinite(high)
            names = [str(k) for k in range(size)]
            if matrix == "G":
                names = [f"{k} low" for k in np.flatnonzero(np.isfinite(low))]
                names += [f"{k} high" for k in np.flatnonzero(np.isfinite(high))]
            self.blocks[matrix].append((term.name, names))

    def fill(self, matrices: dict[str, tuple[np.ndarray, np.ndarray]], layout: Any, terms: FullTerms, t: float) -> None:
        """Write the rows into A, b and E, e and G, h (by "A", "E" and "G") of a step with these quantities."""
        seen = self._point(terms, t) if self.terms else None
        for term in self.terms:
            matrix, low, high, below, above = self._sides[term.name]
            x, (left, right), at = self._rows(term, seen), matrices[matrix], layout.at(term.name)
            if matrix == "G":
                left[at] = np.concatenate([-x.matrix[below], x.matrix[above]])
                right[at] = np.concatenate([(x.offset - low)[below], (high - x.offset)[above]])
            else:
                root = np.sqrt(term.weight) if term.is_cost else 1.0
                left[at], right[at] = root * x.matrix, root * ((0.0 if term.is_cost else low) - x.offset)

    def _who(self, term: Term) -> str:
        return f"term {term.name!r} of 'joint qp/{self.phase}'"

    def _rows(self, term: Term, seen: StepPoint) -> Affine:
        """The expression's rows; refuses what is no :class:`Affine` or not finite."""
        try:
            x = term.expression(seen)
        except (AttributeError, InputError, IndexError, TypeError, ValueError) as e:
            raise InputError(f"{self._who(term)}: its expression fails ({e})") from e
        if not isinstance(x, Affine) or x.matrix.ndim != 2 or x.offset.shape != (len(x.matrix),) or not len(x):
            raise InputError(
                f"{self._who(term)}: its expression is {type(x).__name__}, must be rows that depend on the "
                f"accelerations, such as p.joint_accelerations.knee"
            )
        if not (np.all(np.isfinite(x.matrix)) and np.all(np.isfinite(x.offset))):
            raise InputError(f"{self._who(term)}: its expression is not finite at t = {seen.time:.3f} s")
        return x
