"""The flight QP (JF-*, Sec. IV-B): unknowns theta'' (nv)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumplab.models.full import FullBody, FullMotion, FullTerms, skew
from jumplab.stages.joint_qp.own import SIDES
from jumplab.stages.joint_qp.problem import AXES, JointRows, PhaseQp, State, StepQp
from jumplab.stages.joint_qp.reference import FOOT_BLEND_S, INERTIA_BLEND_S, FlightReference, Track
from jumplab.stages.joint_qp.settings import Options


@dataclass(frozen=True)
class FlightTarget:
    """What one flight step asks for; accelerations in [m/s^2, rad/s^2]."""

    foot_accel: np.ndarray  # p''_rd of the soles relative to the CoM (2, 3), feed-forward + PD
    inertia_accel: float  # rho''_ref [kg m^2/s^2], feed-forward + PD
    base_force: np.ndarray  # on the base (6,), cancels numerical drift of the momentum [N, N m]; physically zero
    foot_pitch: np.ndarray  # of the feet towards level (2,)
    floor: np.ndarray  # least vertical acceleration of left toe, left heel, right toe, right heel (4,); -inf where off
    joints: np.ndarray  # towards the posture (nv - 6,)
    trunk: np.ndarray  # the same (3,)
    symmetry: np.ndarray  # right side of the symmetry rows (k,), zero but for the drift control
    began: float  # start of the step, since the flight began [s]


class FlightQp(PhaseQp):
    """Targets and matrices of the flight, step by step. Pure: nothing here solves or remembers a state.

    Parameters
    ----------
    body, nominal, reference, options : as in the base class.
    start : quantities at take-off; the references begin there and soon join stage 1's.
    ground : height of the launching surface [m].
    """

    name, first, pairs = "flight", 0, ("hip", "knee", "ankle", "shoulder")

    def __init__(
        self, body: FullBody, nominal, start: FullMotion, reference: FlightReference, options: Options, ground: float
    ):
        cost = [("foot", [f"{s} {a}" for s in SIDES for a in "xyz"]), ("foot level", SIDES)]
        cost += [("joints", body.robot.joint_names), ("trunk turn", "xyz")]
        cost += [("acceleration", map(str, range(body.nv))), ("inertia", ["rho"])]
        points = [("ground", [f"{s} {p}" for s in SIDES for p in ("toe", "heel")])]
        rows = {"A": cost, "E": [("base dynamics", AXES)], "G": points}
        self._set_up(body, reference, options, nominal, options.flight, **rows)
        self.joints, self.ground = JointRows(body, nominal, options.limits), ground
        self.step = float(self.steps[0])  # all alike
        self.com0, self.momentum0 = start.com, start.momentum
        self.inertia = reference.inertia.from_state(self.t, start.rho, start.rho_rate, INERTIA_BLEND_S)
        wide = np.zeros((2, 3))
        wide[:, 1] = start.foot_com[:, 1]  # the feet keep their distance
        foot = reference.foot
        both = Track(foot.value[:, None] + wide, *(x[:, None].repeat(2, 1) for x in (foot.rate, foot.feed)))
        self.foot = both.from_state(self.t, start.foot_com, start.foot_com_rate, FOOT_BLEND_S)

    def target(self, k: int, terms: FullMotion) -> FlightTarget:
        """Feed-forward + PD of step ``k`` from the quantities at its start."""
        gain = self.options.gains
        foot = self.foot.command(k, terms.foot_com, terms.foot_com_rate, gain.foot)
        rho = self.inertia.command(k, terms.rho, terms.rho_rate, gain.inertia)
        turn, turn_rate = self.reference.turn[k], (self.reference.turn[k + 1] - self.reference.turn[k]) / self.step
        off_level = np.angle(np.exp(1j * (turn - terms.foot_pitch)))  # the short way round
        level = gain.foot_level.stiffness * off_level + gain.foot_level.damping * (turn_rate - terms.foot_spin[:, 1])
        joints, trunk = self._towards(terms, turned(self.nominal, turn))
        trunk[1] += gain.trunk.damping * turn_rate
        own = foot, rho, self._drift(k, terms), level, self._floor(k, terms)
        return FlightTarget(*own, joints, trunk, self._mirror(terms), float(self.t[k]))

    def _drift(self, k: int, terms: FullMotion) -> np.ndarray:
        """Force on the base that pulls CoM and momentum back to their ballistic values: what integration lost."""
        body, t, c = self.body, self.t[k], self.options.gains.momentum_drift
        fall = np.array([0.0, 0.0, -body.gravity])
        velocity = self.momentum0[:3] / body.mass
        place_error = terms.com - (self.com0 + velocity * t + fall * t * t / 2)
        speed_error = terms.com_velocity - (velocity + fall * t)
        force = -body.mass * (c.stiffness * place_error + c.damping * speed_error)
        moment = -c.damping * (terms.momentum[3:] - self.momentum0[3:])
        turn = terms.base_rotation
        arm = skew(terms.com - terms.q[:3])
        return np.concatenate([turn.T @ force, turn.T @ (moment + arm @ force)])

    def _floor(self, k: int, terms: FullMotion) -> np.ndarray:
        gain, near = self.options.gains.ground, self.options.limits.near_ground_m
        if self.t[k] > self.t[-1] / 2:  # coming down: the surface there is the landing's business
            return np.full(4, -np.inf)
        height = np.stack([terms.toe[:, 2], terms.heel[:, 2]], 1).ravel() - self.ground
        speed = np.stack([terms.toe_velocity[:, 2], terms.heel_velocity[:, 2]], 1).ravel()
        return np.where(height < near, -gain.stiffness * height - gain.damping * speed, -np.inf)

    def matrices(self, terms: FullTerms, target: FlightTarget, start: State) -> StepQp:
        """The QP of one step: ``terms`` in its middle, ``target`` and ``start`` from its start."""
        lay, w = self.layout, self.options.flight
        A, E, G, _, b, e, h = parts = self._begun(target)
        root = np.sqrt(w.foot)
        A[:6] = root * terms.J_rd.reshape(6, -1)
        b[:6] = root * (target.foot_accel - terms.drift_rd).ravel()
        root = np.sqrt(w.foot_level)
        A[6:8] = root * terms.J_toe[:, 4]
        b[6:8] = root * (target.foot_pitch - terms.drift_toe[:, 4])
        root, at = np.sqrt(w.inertia), lay.at("inertia")
        A[at], b[at] = root * terms.J_rho, root * (target.inertia_accel - terms.drift_rho)
        E[:6], e[:6] = terms.M[:6], target.base_force - terms.H[:6]
        on = np.isfinite(target.floor)
        if on.any():
            vertical = np.stack([terms.J_toe[:, 2], terms.J_heel[:, 2]], 1).reshape(4, -1)
            drift = np.stack([terms.drift_toe[:, 2], terms.drift_heel[:, 2]], 1).ravel()
            G[:4][on], h[:4][on] = -vertical[on], (drift - target.floor)[on]
        return self._finished(parts, terms, start, self.step, target.began)


def turned(q: np.ndarray, angle: float) -> np.ndarray:
    """Configuration (nq,) with its base turned about the world's +y."""
    x, y, z, w = q[3:7]
    s, c = np.sin(angle / 2), np.cos(angle / 2)
    out = q.copy()
    out[3:7] = [c * x + s * z, c * y + s * w, c * z - s * x, c * w - s * y]
    return out
