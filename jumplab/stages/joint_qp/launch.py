"""The launch QP (JL-*, Sec. IV-A): unknowns X = [F_ext^js (12); theta'' (nv)]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumplab.models.full import FullBody, FullMotion, FullTerms, force_target
from jumplab.robot import SAGITTAL_JOINTS
from jumplab.stages.joint_qp.own import SIDES
from jumplab.stages.joint_qp.problem import AXES, JointRows, PhaseQp, State, StepQp
from jumplab.stages.joint_qp.reference import LaunchReference
from jumplab.stages.joint_qp.settings import Options

WRENCH = 12
FRICTION = tuple(f"friction {way}" for way in ("+x", "-x", "+y", "-y"))
EDGES = ("CoP left of right edge", "CoP right of left edge")
FOOT_ROWS = ("F_z >= 0", *FRICTION, *EDGES, "torsion +", "torsion -", "CoP behind toe", "CoP ahead of heel")


@dataclass(frozen=True)
class LaunchTarget:
    """What one launch step asks for; accelerations in [m/s^2, rad/s^2]."""

    com_acceleration: np.ndarray  # c''_ref (3,), feed-forward + PD
    momentum_rate: np.ndarray  # of the centroidal angular momentum (3,) [N m], L'_ref + feedback in the middle
    inertia_accel: float  # rho''_ref [kg m^2/s^2]
    toe_acceleration: np.ndarray  # p''_foot of the tiptoes (2, 6), linear then angular; zero but for the drift control
    heel_floor: np.ndarray  # least vertical acceleration of the heels (2,); -inf where the row is off
    joints: np.ndarray  # towards the posture (nv - 6,)
    trunk: np.ndarray  # the same (3,)
    symmetry: np.ndarray  # right side of the symmetry rows (k,), zero but for the drift control
    on_toes: bool  # heel up, CoP at the toe
    inertia_weight: float  # of the inertia's term at this step, see LaunchWeights
    step: float  # its length [s]
    began: float  # its start, since the launch began [s]


class LaunchQp(PhaseQp):
    """Targets and matrices of the launch, step by step. Pure: nothing here solves or remembers a state.

    Parameters
    ----------
    body, reference, options : as in the base class.  q0 : (nq,) configuration at the start, soles flat.
    toe_s : length of the toe phase [s]; None starts it where the reference's CoP stays at the toe.

    Attributes
    ----------
    on_toes : (n,) steps with the heel up.  inertia_weights : (n,) weight of the inertia's term by step.
    roots : square roots of the weights of the CoM's rows (3,) and of the momentum's (6,), feet flat and on the toes.
    """

    name, first = "launch", WRENCH
    pairs = ("hip", "shoulder")  # mirrored hips leave flat feet's knees and ankles no choice: more would be dependent

    def __init__(self, body: FullBody, q0, reference: LaunchReference, options: Options, toe_s: float | None):
        def both(rows):
            return [f"{side} {row}" for side in SIDES for row in rows]

        w, foot = options.launch, body.robot.foot
        cost = [(name, "xyz") for name in ("com", "force", "moment")] + [("inertia", ["rho"])]
        cost += [("joints", body.robot.joint_names), ("trunk turn", "xyz")]
        cost += [("wrench", both(["fx", "fy", "fz", "mx", "my", "mz"])), ("acceleration", map(str, range(body.nv)))]
        rows = [("base dynamics", AXES), ("tiptoe", both(["x", "y", "z", "rx", "rz"]))]
        rows += [("foot pitch or toe moment", SIDES)]
        ground = [("ground", both(FOOT_ROWS)), ("heel", SIDES)]
        self._set_up(body, reference, options, swung_arms(body, q0, options.arm_rad), w, A=cost, E=rows, G=ground)
        self._fixed[0][self.layout.at("wrench"), :WRENCH] = np.sqrt(w.wrench) * np.eye(WRENCH)
        self._ground = self._ground_rows(False), self._ground_rows(True)
        self.joints, start = JointRows(body, q0, options.limits), body.terms(q0, np.zeros(body.nv))
        self.toe0, self.pivot = start.toe, start.sole.mean(0)
        self.on_toes = reference.toe_steps((foot.toe - foot.heel) / 2, toe_s)
        self.inertia_weights = self._inertia_weights()
        com = [np.sqrt([ahead, w.com, w.com]) for ahead in (w.com_x, w.com)]
        force = [np.sqrt([ahead, w.force, w.force] + [w.moment] * 3) for ahead in (w.force_x, w.force)]
        self.roots = tuple(zip(com, force, strict=True))

    def _inertia_weights(self) -> np.ndarray:
        """(n,) by step: the flat feet's, fading geometrically to the toes' before the heel rises."""
        w, start = self.options.launch, self.t[:-1]
        heel_off = start[self.on_toes][0] if self.on_toes.any() else self.t[-1]
        left = np.clip((heel_off - start) / w.inertia_fade_s, 0.0, 1.0)
        return np.where(self.on_toes, w.inertia_toe, w.inertia_toe * (w.inertia / w.inertia_toe) ** left)

    def _ground_rows(self, on_toes: bool) -> np.ndarray:
        """(22, 12) unilateral, friction and CoP rows on F; rows that are off stay zero, 0 <= 0."""
        lim, foot = self.options.limits, self.body.robot.foot
        one = np.zeros((len(FOOT_ROWS), 6))  # columns fx fy fz mx my mz, moments about the tiptoe
        if lim.unilateral:
            one[0, 2] = -1.0
        if lim.friction is not None:
            for i, (axis, sign) in enumerate(((0, 1), (0, -1), (1, 1), (1, -1))):
                one[1 + i, axis], one[1 + i, 2] = sign, -lim.friction
            for i, sign in ((7, 1), (8, -1)):
                one[i, 5], one[i, 2] = sign, -lim.friction * foot.half_width
        if lim.cop_margin_m is not None:
            one[5, 3], one[5, 2] = -1.0, -(foot.half_width - lim.cop_margin_m)
            one[6, 3], one[6, 2] = 1.0, -(foot.half_width - lim.cop_margin_m)
            if not on_toes:  # CoP = toe - my / fz
                one[9, 4], one[9, 2] = -1.0, lim.cop_margin_m
                one[10, 4], one[10, 2] = 1.0, -(foot.toe - foot.heel - lim.cop_margin_m)
        return np.kron(np.eye(2), one)

    def target(self, k: int, terms: FullMotion) -> LaunchTarget:
        """Feed-forward + PD of step ``k`` from the quantities at its start."""
        ref, gain = self.reference, self.options.gains
        com = ref.com.command(k, terms.com - self.pivot, terms.com_velocity, gain.com)
        turn = -gain.momentum.damping * terms.momentum[3:]
        turn[1] = ref.momentum.command(k, 0.0, terms.momentum[4], gain.momentum)
        rho = ref.inertia.command(k, terms.rho, terms.rho_rate, gain.inertia)
        error = np.zeros((2, 6))  # of the tiptoes
        error[:, :3] = terms.toe - self.toe0
        side = terms.foot_rotation[:, :, 1]  # the feet's lateral axes
        error[:, 3], error[:, 4], error[:, 5] = side[:, 2], terms.foot_pitch, -side[:, 0]
        speed = np.concatenate([terms.toe_velocity, terms.foot_spin], 1)
        contact = -gain.contact.stiffness * error - gain.contact.damping * speed
        posture = self._towards(terms, self.nominal)
        floor = self._heel_floor(terms, k)
        now = bool(self.on_toes[k]), float(self.inertia_weights[k]), float(self.steps[k]), float(self.t[k])
        return LaunchTarget(com, turn, rho, contact, floor, *posture, self._mirror(terms), *now)

    def _heel_floor(self, terms: FullMotion, k: int) -> np.ndarray:
        """Least vertical acceleration of the heels (2,) [m/s^2]; on flat feet the foot's own row holds them."""
        return self._near_ground(terms) if self.on_toes[k] else np.full(2, -np.inf)

    def _near_ground(self, terms: FullMotion) -> np.ndarray:
        gain, height = self.options.gains.ground, terms.heel[:, 2] - self.toe0[:, 2]
        floor = -gain.stiffness * height - gain.damping * terms.heel_velocity[:, 2]
        return np.where(height < self.options.limits.near_ground_m, floor, -np.inf)

    def matrices(self, terms: FullTerms, target: LaunchTarget, start: State) -> StepQp:
        """The QP of one step: ``terms`` in its middle, ``target`` and ``start`` from its start."""
        A, E, G, _, b, e, h = parts = self._begun(target)
        com, force = self.roots[target.on_toes]
        A[:3, WRENCH:] = com[:, None] * terms.A_c
        b[:3] = com * (target.com_acceleration - terms.B_c)
        A[3:9, :WRENCH] = force[:, None] * terms.A_f
        b[3:9] = force * force_target(self.body.mass, self.body.gravity, target.com_acceleration, target.momentum_rate)
        root = np.sqrt(target.inertia_weight)
        A[9, WRENCH:] = root * terms.J_rho
        b[9] = root * (target.inertia_accel - terms.drift_rho)
        E[:6, :WRENCH], E[:6, WRENCH:], e[:6] = -terms.J[:, :6].T, terms.M[:6], -terms.H[:6]  # base dynamics
        self._contact(E, e, terms, target)
        G[: 2 * len(FOOT_ROWS), :WRENCH] = self._ground[target.on_toes]
        heel = self.layout.at("heel").start
        for side in np.flatnonzero(np.isfinite(target.heel_floor)):
            G[heel + side, WRENCH:] = -terms.J_heel[side, 2]
            h[heel + side] = terms.drift_heel[side, 2] - target.heel_floor[side]
        return self._finished(parts, terms, start, target.step, target.began)

    def _contact(self, E, e, terms, target):
        """Tiptoe rows; then per foot either no pitch acceleration (flat) or no moment about the toe (heel up)."""
        rows, asked = [0, 1, 2, 3, 5], target.toe_acceleration - terms.drift_toe
        E[6:16, WRENCH:] = terms.J_toe[:, rows].reshape(10, -1)
        e[6:16] = asked[:, rows].ravel()
        if target.on_toes:
            E[[16, 17], [4, 10]] = 1.0
        else:
            E[16:18, WRENCH:], e[16:18] = terms.J_toe[:, 4], asked[:, 4]


def swung_arms(body: FullBody, q0: np.ndarray, arm_rad: float) -> np.ndarray:
    """The posture (nq,) that the joints lean towards: ``q0`` with the shoulders at ``arm_rad`` about +y."""
    robot, q = body.robot, q0.copy()
    for name, row, sign in robot.role_signs():
        if SAGITTAL_JOINTS[row] == "shoulder":
            q[body.model.idx_qs[body.model.getJointId(name)]] = arm_rad * sign
    return q
