"""The one QP shape of stage 2, its named rows, and the rows that both phases share."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from jumplab.models.full import FullBody, FullMotion, FullTerms, skew
from jumplab.stages.joint_qp.own import OwnRows, StepPoint
from jumplab.stages.joint_qp.settings import Limits, Options

OFF_TORQUE, OFF_SPEED = 1e5, 1e3  # [N m], [rad/s] bounds of a row that is switched off, beyond all motion
AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Layout:
    """Names of the rows: block name -> (matrix "A", "E", "G" or "R", slice), and by matrix one label per row."""

    blocks: dict[str, tuple[str, slice]]
    labels: dict[str, tuple[str, ...]]

    @classmethod
    def of(cls, **matrices: list) -> Layout:
        """From matrix -> list of (block name, row labels)."""
        blocks, labels = {}, {}
        for matrix, rows in matrices.items():
            own: list[str] = []
            for name, ends in rows:
                ends = tuple(ends)
                blocks[name] = (matrix, slice(len(own), len(own) + len(ends)))
                own += [f"{name} {end}".strip() for end in ends]
            labels[matrix] = tuple(own)
        return cls(blocks, labels)

    def at(self, name: str) -> slice:
        """Rows of a block."""
        return self.blocks[name][1]


@dataclass(frozen=True, slots=True)
class StepQp:
    """min 1/2 |A x - b|^2  subject to  E x = e,  G x <= h,  lower <= R x <= upper.

    x is X = [F_ext^js (12); theta'' (nv)] in launch and theta'' (nv) in flight; A and b carry the square roots of the
    weights. ``layout`` names every row.
    """

    A: np.ndarray
    b: np.ndarray
    E: np.ndarray
    e: np.ndarray
    G: np.ndarray
    h: np.ndarray
    R: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    layout: Layout = field(repr=False)

    def objective(self, x: np.ndarray) -> float:
        """Value of the cost at ``x``."""
        r = self.A @ x - self.b
        return float(r @ r) / 2

    def violations(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """How far ``x`` breaks each row of E, G and R, in the row's own unit (0 where it does not)."""
        box = self.R @ x
        return {
            "E": np.abs(self.E @ x - self.e),
            "G": np.maximum(self.G @ x - self.h, 0.0),
            "R": np.maximum(np.maximum(box - self.upper, self.lower - box), 0.0),
        }


@dataclass(frozen=True, slots=True)
class State:
    """Configuration (nq,), rates (nv,) at the start of a step, and accelerations (nv,): the last known, or a guess."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


class JointRows:
    """Rows on the joints that both phases share: torque, and speed and range as bounds on the acceleration."""

    def __init__(self, body: FullBody, nominal: np.ndarray, limits: Limits):
        self.limits = limits
        actuators = [body.robot.actuators[name] for name in body.robot.joint_names]
        keys = "lower", "upper", "speed", "effort", "corner_speed", "no_load_speed"
        column = {k: np.array([a[k] for a in actuators]) for k in keys}
        margin = limits.range_margin_rad or 0.0
        inertia = np.diag(body.terms(nominal, np.zeros(body.nv)).M)[6:]
        self.brake = limits.stop_share * column["effort"] / inertia  # [rad/s^2]
        self.lower, self.upper = column["lower"] + margin, column["upper"] - margin
        off = np.full(len(actuators), OFF_SPEED)
        self.speed = off if limits.speed_share is None else column["speed"] * limits.speed_share
        self.effort = column["effort"] * (limits.torque_share or 1.0)
        self.free_speed, self.corner = column["no_load_speed"], column["corner_speed"]

    def torque(self, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest torque (n,) available at joint rates: full to the corner speed, then a line to zero at the
        no-load speed."""
        if self.limits.torque_share is None:
            return np.full(len(rates), -OFF_TORQUE), np.full(len(rates), OFF_TORQUE)
        left = (self.free_speed - np.abs(rates)) / (self.free_speed - self.corner)
        driving = self.effort * np.minimum(np.maximum(left, 0.0), 1.0)
        return np.where(rates < 0, -driving, -self.effort), np.where(rates > 0, driving, self.effort)

    def acceleration(self, angles: np.ndarray, rates: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest joint acceleration (n,) that keeps speed and range after one step.

        A joint may approach its stop at most at ``stop_rate`` times the angle left, and only as fast as it can brake.
        """
        low, high = -self.speed, self.speed
        if self.limits.range_margin_rad is not None:
            ahead = angles + rates * step
            low = np.maximum(low, -self._approach(ahead - self.lower))
            high = np.minimum(high, self._approach(self.upper - ahead))
        return (low - rates) / step, (high - rates) / step

    def _approach(self, left: np.ndarray) -> np.ndarray:
        """Highest speed (n,) towards a stop at distances ``left``."""
        left = np.maximum(left, 0.0)
        return np.minimum(self.limits.stop_rate * left, np.sqrt(2 * self.brake * left))

    def fill(self, R: np.ndarray, terms: FullTerms, start: State, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Write the torque rows M theta'' + H - J^T F into R (2 n, size of x); lowest and highest value of all rows.

        The rows below, of the accelerations, are ones and never change.
        """
        n, first = len(self.speed), R.shape[1] - len(terms.v)
        R[:n, first:] = terms.M[6:]
        if first:
            R[:n, :first] = -terms.J[:, 6:].T
        torque, acceleration = self.torque(terms.v[6:]), self.acceleration(start.q[7:], start.v[6:], step)
        low, high = (np.concatenate([x - terms.H[6:], y]) for x, y in zip(torque, acceleration, strict=True))
        return low, high


class PhaseQp:
    """What the QPs of launch and flight share: rows on the joints, posture, symmetry, and all that never changes.

    Attributes
    ----------
    body : nine-link quantities.  reference : stage 1's phase.  options : gains, weights, limits.
    nominal : (nq,) posture to lean towards.  t, steps : (n + 1,) times of the nodes, (n,) lengths of the steps [s].
    joints : rows on the joints.  S : (k, nv) symmetry rows.  layout : names of the rows.
    """

    name: str
    first: int  # column of x at which theta'' begins
    pairs: tuple[str, ...]  # groups of joints that are mirrored

    def _set_up(self, body: FullBody, reference, options: Options, nominal: np.ndarray, weights, **rows: list):
        """Take over what is given; ``rows`` are A, E and G as in :meth:`Layout.of`, E without the symmetry."""
        self.body, self.reference, self.options, self.nominal = body, reference, options, nominal
        self.t, self.steps, self.S = reference.t, np.diff(reference.t), body.symmetry_rows(self.pairs)
        names, self._weights = body.robot.joint_names, weights
        rows["E"] = [*rows["E"], ("symmetry", body.pair_names(self.pairs))]
        seen = body.terms(nominal, np.zeros(body.nv))
        self.own = OwnRows(self.name, options.own(self.name), partial(StepPoint, body, self.first), seen)
        rows = {matrix: [*own, *self.own.blocks[matrix]] for matrix, own in rows.items()}
        self.layout = lay = Layout.of(**rows, R=[("torque", names), ("speed and range", names)])
        first, nv = self.first, body.nv
        self._fixed = A, E, _, R = [np.zeros((len(lay.labels[k]), first + nv)) for k in "AEGR"]
        A[lay.at("joints"), first + 6 :] = np.sqrt(weights.posture) * np.eye(nv - 6)
        A[lay.at("trunk turn"), first + 3 : first + 6] = np.sqrt(weights.trunk) * np.eye(3)
        A[lay.at("acceleration"), first:] = np.sqrt(weights.acceleration) * np.eye(nv)
        off = [name.split("/") for name in options.off]
        self._off = [lay.blocks[name] for phase, name in off if phase == self.name and name in lay.blocks]
        E[lay.at("symmetry"), first:], R[nv - 6 :, first + 6 :] = self.S, np.eye(nv - 6)

    def _begun(self, target: Any) -> list[np.ndarray]:
        """A, E, G, R, b, e and h with everything filled in but the phase's own rows."""
        A, E, G, R = (x.copy() for x in self._fixed)
        b, e, h = np.zeros(len(A)), np.zeros(len(E)), np.zeros(len(G))
        b[self.layout.at("joints")] = np.sqrt(self._weights.posture) * target.joints
        b[self.layout.at("trunk turn")] = np.sqrt(self._weights.trunk) * target.trunk
        e[self.layout.at("symmetry")] = target.symmetry
        return [A, E, G, R, b, e, h]

    def _finished(self, parts: list[np.ndarray], terms: FullTerms, start: State, step: float, began: float) -> StepQp:
        """The step's QP from A, E, G, R, b, e and h: own rows and the joints' filled in, others switched off."""
        A, E, G, R, b, e, h = parts
        low, high = self.joints.fill(R, terms, start, step)
        sides = {"A": (A, b), "E": (E, e), "G": (G, h), "R": (R, low, high)}
        self.own.fill(sides, self.layout, terms, began + step / 2)
        for matrix, rows in self._off:
            for x in sides[matrix]:
                x[rows] = 0.0  # a row of zeros: 0 = 0, 0 <= 0
        return StepQp(A, b, E, e, G, h, R, low, high, self.layout)

    def _mirror(self, terms: FullMotion) -> np.ndarray:
        """Right side of the symmetry rows (k,): zero but for the drift control."""
        c = self.options.gains.contact
        return -c.stiffness * (self.S[:, 6:] @ terms.q[7:]) - c.damping * (self.S @ terms.v)

    def _towards(self, terms: FullMotion, nominal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """PD accelerations of the joints (nv - 6,) towards ``nominal`` (nq,), and of the trunk (3,), in base axes."""
        posture, trunk = self.options.gains.posture, self.options.gains.trunk
        joints = posture.stiffness * (nominal[7:] - terms.q[7:]) - posture.damping * terms.v[6:]
        vector, scalar, wish, wish_scalar = terms.q[3:6], terms.q[6], nominal[3:6], nominal[6]
        turn = wish_scalar * vector - scalar * wish - skew(wish) @ vector  # of the quaternion from nominal to q
        near = 1.0 if wish_scalar * scalar + wish @ vector >= 0 else -1.0  # q and -q are the same orientation
        return joints, -trunk.stiffness * 2 * near * turn - trunk.damping * terms.v[3:6]
