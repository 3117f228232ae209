"""The QPs of launch and flight, step by step: what each step asks for, and its program."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pinocchio as pin

from jumplab.models.full import FullBody, FullTerms
from jumplab.ocp import Phase
from jumplab.ocp.qp import Qp
from jumplab.ocp.solution import quintic
from jumplab.robot import SAGITTAL_JOINTS
from jumplab.stages.joint_qp.point import StepPoint
from jumplab.stages.joint_qp.settings import Gain, Options
from jumplab.stages.joint_qp.terms import FIRST, rows_of
from jumplab.stages.srmp.planner import SrmpFlight, SrmpStance

# a quarter of a flight; longer, and the rates of take-off carry the legs far off
FOOT_BLEND_S = 0.15
INERTIA_BLEND_S = 0.08  # arms and trunk are quicker than legs; shorter, they are at their limits


@dataclass(frozen=True)
class Track:
    """Trajectory of stage 1 at the nodes of n steps: value and rate (n + 1, ...)."""

    t: np.ndarray  # (n + 1,) [s]
    value: np.ndarray
    rate: np.ndarray

    @property
    def feed(self) -> np.ndarray:
        """Mean acceleration (n, ...) of each step: alone it reproduces the rates at the nodes."""
        steps = np.diff(self.t).reshape((-1,) + (1,) * (self.rate.ndim - 1))
        return np.diff(self.rate, axis=0) / steps

    def command(self, k: int, value: np.ndarray, rate: np.ndarray, gain: Gain) -> np.ndarray:
        """Acceleration (...,) to ask for over step ``k``, from value and rate (...,) at its start:
        feed-forward + PD.
        """
        return self.feed[k] + gain.back(value - self.value[k], rate - self.rate[k])

    def from_state(self, value: np.ndarray, rate: np.ndarray, blend_s: float) -> Track:
        """The same, but beginning at a given value and rate (...,) and joining it smoothly after
        ``blend_s``: a quintic carries the offset down to zero.

        SRMP's pivot stays on the ground while the robot's heel may be up at take-off, so the two
        can meet only in the air.
        """
        none = np.zeros_like(value)
        ends = [(value - self.value[0], none), (rate - self.rate[0], none), (none, none)]
        end = min(blend_s, self.t[-1])
        offset, drift, _ = quintic(ends, end, np.minimum(self.t, end).reshape(-1, *[1] * none.ndim))
        return Track(self.t, self.value + offset, self.rate + drift)


def in_space(x: np.ndarray) -> np.ndarray:
    """(n, 2) x, z as (n, 3) with y = 0."""
    return np.insert(x, 1, 0.0, axis=1)


class PhaseQp:
    """Common part of the QPs of launch and flight. Pure: nothing here solves or remembers a state.

    Parameters
    ----------
    body : nine-link quantities.  options : gains, weights, limits.  phase : its terms.
    t : (n + 1,) times of the nodes [s].
    nominal : (nq,) posture to lean towards; joints brake with the inertia that they have in it.

    Attributes
    ----------
    steps : (n,) lengths of the steps [s].  S : (k, nv) symmetry rows.
    first : column of x at which theta'' begins.
    """

    def __init__(
        self,
        body: FullBody,
        options: Options,
        phase: Phase,
        t: np.ndarray,
        nominal: np.ndarray,
    ):
        self.body = body
        self.options = options
        self.phase = phase
        self.first = FIRST[phase.name]
        self.t = t
        self.steps = np.diff(t)
        self.nominal = nominal
        self.S = body.symmetry_rows(phase.name)
        inertia = np.diag(body.terms(nominal, np.zeros(body.nv)).M)[6:]
        self._brake = options.limits.stop_share * body.motors.effort / inertia  # [rad/s^2]

    def qp(self, quantities: FullTerms, target: SimpleNamespace) -> Qp:
        """The program of one step: the robot in its middle, and what it asks for."""
        p = StepPoint(self.body, self.first, quantities, target.time, target)
        qp = Qp(self.first + self.body.nv)
        for term in self.phase.terms:
            rows = rows_of(term, f"term {term.name!r} of 'joint qp/{self.phase.name}'", p)
            if term.is_cost:
                qp.cost(term.name, rows.matrix, -rows.offset, term.weight, rows.labels)
                continue
            low, high = (x(p) if callable(x) else np.asarray(x) for x in (term.lower, term.upper))
            if np.array_equal(low, high):
                qp.equality(term.name, rows.matrix, low - rows.offset, rows.labels)
            else:
                qp.limit(term.name, rows.matrix, low - rows.offset, high - rows.offset, rows.labels)
        return qp

    def joint_range(
        self, angles: np.ndarray, rates: np.ndarray, step_s: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest joint acceleration (n,) [rad/s^2] that keeps speed and range after one
        step, from angles (n,) [rad] and rates (n,) [rad/s].

        A joint may approach its stop at most at ``stop_rate`` times the angle left, and only as
        fast as it can brake.
        """
        limits = self.options.limits
        motors = self.body.motors
        ahead = angles + rates * step_s
        left = np.stack([ahead - motors.lower, motors.upper - ahead]) - limits.range_margin_rad
        left = np.maximum(left, 0.0)
        approach = np.minimum(limits.stop_rate * left, np.sqrt(2 * self._brake * left))
        back, forth = np.minimum(motors.speed, approach)
        return (-back - rates) / step_s, (forth - rates) / step_s

    def _asked(self, k: int, now: FullTerms, **more) -> SimpleNamespace:
        """Aims of both phases, from the quantities at the start of step ``k``, and ``more``.

        time : middle of the step, since the phase began [s].
        joints, trunk : accelerations towards the posture (nv - 6,), (3,) [rad/s^2].
        symmetry : right side (k,) of the symmetry rows, zero but for the drift control.
        acceleration_range : least and greatest of the joints (nv - 6,), see :meth:`joint_range`.
        """
        gain = self.options.gains
        wish = pin.Quaternion(self.nominal[3:7])
        left = (wish.conjugate() * pin.Quaternion(now.q[3:7])).coeffs()  # vector, scalar
        turned = 2 * np.sign(left[3] or 1.0) * left[:3]  # q and -q are the same orientation
        return SimpleNamespace(
            time=float(self.t[k] + self.steps[k] / 2),
            joints=gain.posture.back(now.q[7:] - self.nominal[7:], now.v[6:]),
            trunk=gain.trunk.back(turned, now.v[3:6]),
            symmetry=gain.contact.back(self.S[:, 6:] @ now.q[7:], self.S @ now.v),
            acceleration_range=self.joint_range(now.q[7:], now.v[6:], self.steps[k]),
            **more,
        )

    def _floor(self, height: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Least vertical acceleration (n,) [m/s^2] of points at heights (n,) [m] with speeds (n,)
        [m/s]; -inf where they are far from the ground.
        """
        floor = self.options.gains.ground.back(height, speed)
        return np.where(height < self.options.limits.near_ground_m, floor, -np.inf)


class LaunchQp(PhaseQp):
    """Targets and programs of the launch (JL-*, Sec. IV-A).

    Parameters
    ----------
    body, options, phase : as in the base class.
    reference : stage 1's launch at the nodes.  toe_s : length of its toe phase [s].
    q0 : (nq,) configuration at the start, soles flat.

    Attributes
    ----------
    com, momentum, inertia : what is followed; the CoM (3,) from the pivot, L as a rate.
    on_toes : (n,) steps with the heel up.  inertia_weights : (n,) of the inertia's term.
    toe0 : (2, 3) tiptoes at the start [m].  pivot : (3,) middle between the soles [m].
    """

    def __init__(
        self,
        body: FullBody,
        options: Options,
        phase: Phase,
        reference: SrmpStance,
        toe_s: float,
        q0: np.ndarray,
    ):
        t = reference.t
        super().__init__(body, options, phase, t, swung_arms(body, q0, options.arm_rad))
        start = body.terms(q0, np.zeros(body.nv))
        self.toe0 = start.tip.place
        self.pivot = start.sole.place.mean(0)
        self.com = Track(t, in_space(reference.com), in_space(reference.com_velocity))
        # L is a rate of nothing that is followed: its "value" has no gain
        self.momentum = Track(t, np.zeros_like(t), reference.L)
        self.inertia = Track(t, reference.rho, reference.rho_rate)
        self.on_toes = t[:-1] >= t[-1] - toe_s - 1e-9
        # the flat feet's, fading geometrically to the toes' before heels rise
        w = options.launch
        left = np.clip((t[-1] - toe_s - t[:-1]) / w.inertia_fade_s, 0.0, 1.0)
        self.inertia_weights = w.inertia_toe * (w.inertia / w.inertia_toe) ** left

    def target(self, k: int, now: FullTerms) -> SimpleNamespace:
        """Feed-forward + PD of step ``k`` from the quantities at its start.

        Besides what both phases ask for: ``com_acceleration`` c''_ref (3,) [m/s^2],
        ``momentum_rate`` (3,) of the centroidal angular momentum [N m], ``inertia_accel`` rho''_ref
        [kg m^2/s^2] and ``inertia_weight`` of its term, ``toe_acceleration`` p''_foot of the
        tiptoes (2, 6), zero but for the drift control, ``heel_floor`` (2,) least vertical
        acceleration of the heels [m/s^2], ``on_toes`` whether heels are up, ``base_force`` (6,).
        """
        gain = self.options.gains
        turn = -gain.momentum.damping * now.momentum[3:]
        turn[1] = self.momentum.command(k, 0.0, now.momentum[4], gain.momentum)
        side = now.tip.turn[:, :, 1]  # the feet's lateral axes show how they roll and yaw
        moved = [now.tip.place - self.toe0, side[:, 2], now.foot_pitch, -side[:, 0]]
        place = now.com - self.pivot
        return self._asked(
            k,
            now,
            com_acceleration=self.com.command(k, place, now.com_velocity, gain.com),
            momentum_rate=turn,
            inertia_accel=self.inertia.command(k, now.rho, now.rho_rate, gain.inertia),
            inertia_weight=self.inertia_weights[k],
            toe_acceleration=gain.contact.back(np.column_stack(moved), now.tip.velocity),
            # on flat feet the foot's own row holds the heels
            heel_floor=self.heel_floor(now) if self.on_toes[k] else np.full(2, -np.inf),
            on_toes=self.on_toes[k],
            base_force=np.zeros(6),
        )

    def heel_floor(self, now: FullTerms) -> np.ndarray:
        """Least vertical acceleration of raised heels (2,) [m/s^2]."""
        return self._floor(now.heel.place[:, 2] - self.toe0[:, 2], now.heel.velocity[:, 2])


class FlightQp(PhaseQp):
    """Targets and programs of the flight (JF-*, Sec. IV-B).

    Parameters
    ----------
    body, options, phase : as in the base class.
    reference : stage 1's flight at the nodes.
    nominal : (nq,) posture that the joints lean towards.
    start : quantities at take-off; the references begin there and soon join stage 1's.
    ground : height of the launching surface [m].

    Attributes
    ----------
    inertia, foot : what is followed; the soles (2, 3) from the CoM.
    """

    def __init__(
        self,
        body: FullBody,
        options: Options,
        phase: Phase,
        reference: SrmpFlight,
        nominal: np.ndarray,
        start: FullTerms,
        ground: float,
    ):
        t = reference.t
        super().__init__(body, options, phase, t, nominal)
        self.ground = ground
        self.start = start
        inertia = Track(t, reference.rho, reference.rho_rate)
        self.inertia = inertia.from_state(start.rho, start.rho_rate, INERTIA_BLEND_S)
        foot = in_space(reference.foot_com)[:, None].repeat(2, axis=1)
        foot[:, :, 1] = start.foot_com[:, 1]  # the feet keep their distance
        both = Track(t, foot, in_space(reference.foot_com_rate)[:, None].repeat(2, axis=1))
        self.foot = both.from_state(start.foot_com, start.J_rd @ start.v, FOOT_BLEND_S)

    def target(self, k: int, now: FullTerms) -> SimpleNamespace:
        """Feed-forward + PD of step ``k`` from the quantities at its start.

        Besides what both phases ask for: ``foot_accel`` p''_rd (2, 3) of the soles relative to the
        CoM [m/s^2], ``foot_pitch`` (2,) of the feet towards level [rad/s^2], ``inertia_accel``
        rho''_ref [kg m^2/s^2], ``floor`` (4,) least vertical acceleration of left toe, left heel,
        right toe, right heel [m/s^2], ``base_force`` (6,) that cancels numerical drift of the
        momentum, physically zero [N, N m].
        """
        gain = self.options.gains
        rate = now.J_rd @ now.v
        target = self._asked(
            k,
            now,
            foot_accel=self.foot.command(k, now.foot_com, rate, gain.foot),
            foot_pitch=gain.foot_level.back(now.foot_pitch, now.tip.velocity[:, 4]),
            inertia_accel=self.inertia.command(k, now.rho, now.rho_rate, gain.inertia),
            floor=np.full(4, -np.inf),
            base_force=self._drift(k, now),
        )
        if self.t[k] <= self.t[-1] / 2:  # coming down, the surface is the landing's business
            height = now.vertical("place") - self.ground
            target.floor = self._floor(height, now.vertical("velocity"))
        return target

    def _drift(self, k: int, now: FullTerms) -> np.ndarray:
        """Force on the base that pulls CoM and momentum back to their ballistic values: what
        integration lost.
        """
        t = self.t[k]
        gain = self.options.gains.momentum_drift
        fall = np.array([0.0, 0.0, -self.body.gravity])
        velocity = self.start.com_velocity
        place_error = now.com - (self.start.com + velocity * t + fall * t * t / 2)
        force = self.body.mass * gain.back(place_error, now.com_velocity - (velocity + fall * t))
        moment = -gain.damping * (now.momentum[3:] - self.start.momentum[3:])
        turn = now.base_rotation.T
        arm = now.com - now.q[:3]
        return np.concatenate([turn @ force, turn @ (moment + np.cross(arm, force))])


def swung_arms(body: FullBody, q0: np.ndarray, arm_rad: float) -> np.ndarray:
    """The posture (nq,) that the joints lean towards: ``q0`` (nq,) with the shoulders at
    ``arm_rad`` about +y.
    """
    q = q0.copy()
    for name, row, sign in body.robot.role_signs():
        if SAGITTAL_JOINTS[row] == "shoulder":
            q[body.model.idx_qs[body.model.getJointId(name)]] = arm_rad * sign
    return q
