"""Stage 3 exactly as the paper prints it: launch, then flight, in the paper's own coordinates (Sec. V).

Kept to be compared with :mod:`jumplab.stages.whole_body.problem`, never to plan with. theta = [x; z; pitch; q_hip;
q_knee; q_ankle; q_shoulder]; (x, z) is the paper's base, the top of the trunk, seen from the middle of the sole's first
place.
Weights are those of ours, so that only the formulation differs. Where the paper is silent the kindest reading is taken:
the boxes hold the robot's joint ranges and speeds, no force pulls at a node, and the search stays near stage 2's
motion; other local solutions of the launch are cheaper, with the foot on end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from jumplab.errors import SolverError
from jumplab.io.tape import RATE_HZ
from jumplab.ocp import changed
from jumplab.ocp.nlp import Nlp, PhaseGuess, Solution
from jumplab.ocp.problem import Bound, Phase, Point, Problem, Term
from jumplab.robot import SAGITTAL_JOINTS, Robot, SagittalModel
from jumplab.robot.files import ROLES
from jumplab.robot.reach import rod_of
from jumplab.robot.sagittal import JOINT_OF_ANGLES
from jumplab.robot.stance import stance_angles
from jumplab.stages.joint_qp import JointPlan, map_to_joints
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body.settings import Weights
from jumplab.task import GRAVITY, JumpTask
from paper.planar import PlanarState, evaluator, symbols

COORDINATES = ("x", "z", "pitch", *SAGITTAL_JOINTS)
# absolute angles of foot, shank, thigh, trunk and arm from theta; rates and accelerations likewise
LINK_OF_THETA = np.hstack([np.zeros((5, 2)), np.rint(np.linalg.inv(np.vstack([np.eye(5)[3], JOINT_OF_ANGLES])))])
MOTION = ("angles", "rates", "accels", "toe", "toe_velocity", "toe_acceleration")
INTERVALS = 30  # our choice, per phase: 29 ms of launch, 21 ms of flight
# the launch has several local solutions, and with "adaptive" a guess changed by 1e-12 ends in another one;
# so it stays with the same one for guesses changed by 0.01
OPTIONS = {"mu_strategy": "monotone"}
BASE_BOX, BASE_RATE_BOX = (3.0, 3.0, 8.0), (10.0, 10.0, 20.0)  # [m, m, rad], [.../s] beyond any jump here
ACCEL_BOX, JERK_BOX, FORCE_BOX_N = 1e3, 1e5, 4000.0  # [1/s^2, 1/s^3, N] far beyond what ours uses
FORCE_WEIGHT = 1e-6  # [1] / [N]^2 / [s] standing costs as much as joint accelerations of 6 rad/s^2
SCALES = {"q": 1.0, "v": 10.0, "a": 100.0, "j": 2000.0, "z": 400.0}  # as ours; z is about the weight
AT_TAKEOFF = "base rows at take-off"  # of the flight, its first node


@dataclass(frozen=True)
class PrintedPlan:
    """Result of the printed problems for one target.

    Attributes
    ----------
    launch, flight : the solutions, or None.
    launch_status, flight_status : what the solver said of the problems as printed; "not tried".
    repaired_status : of the flight without its base rows at take-off, tried if the printed one fails; "" if not. If it
        solves, ``flight`` and ``motion`` hold it.
    motion : 1 kHz samples of what was solved: t (n,) [s], flying (n,), angles, rates, accels (n, 5) of the links, toe,
        toe_velocity, toe_acceleration (n, 2), toe_phase_start [s]; the input of
        :func:`paper.expansion.expand`.
    F_x, F_z, tau_y : (n,) planned ground wrench at the toe [N, N m], linear between nodes, 0 in flight.
    """

    task: JumpTask
    launch: Solution | None = None
    flight: Solution | None = None
    launch_status: str = ""
    flight_status: str = "not tried"
    repaired_status: str = ""
    motion: dict | None = None
    F_x: np.ndarray | None = None
    F_z: np.ndarray | None = None
    tau_y: np.ndarray | None = None


class PaperCoordinates:
    """The one place where the paper's theta and the toe-rooted link angles meet; both ways, with derivatives."""

    def __init__(self, model: SagittalModel):
        self.model, self.base = model, model.point_arms(3, model.base)
        s = PlanarState(model, *symbols())
        self._base = ca.Function("base", [s.angles, s.rates, s.accels], [s.point(self.base, k) for k in range(3)])

    def _from_toe(self, turns):
        return [x.full().T for x in self._base.map(len(turns[0]))(*(x.T for x in turns))]

    def links(self, theta: np.ndarray, rate: np.ndarray, accel: np.ndarray) -> dict[str, np.ndarray]:
        """(n, 7) each -> angles, rates, accels (n, 5), toe, toe_velocity, toe_acceleration (n, 2)."""
        turns = [x @ LINK_OF_THETA.T for x in (theta, rate, accel)]
        toes = [x[:, :2] - b for x, b in zip((theta, rate, accel), self._from_toe(turns), strict=True)]
        return dict(zip(MOTION, (*turns, *toes), strict=True))

    def theta(self, motion: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The way back: theta, theta', theta'', (n, 7) each."""
        turns, toes = [motion[k] for k in MOTION[:3]], [motion[k] for k in MOTION[3:]]
        return tuple(np.concatenate([t + b, x[:, 3:4], self.model.joint_angles(x)], axis=1)
                     for x, t, b in zip(turns, toes, self._from_toe(turns), strict=True))  # fmt: skip


def _moment(lever, force):
    """Moment about +y of a force at a lever, both (x, z)."""
    return lever[1] * force[0] - lever[0] * force[1]


class PrintedTerms:
    """Expressions of Sec. V at one instant in the paper's coordinates; pure. Inertia is tracked as in ours."""

    def __init__(self, robot: Robot, weights: Weights, flying: bool = False):
        self.model, self.weights, self.flying = robot.sagittal, weights, flying
        self.mg, self.base = self.model.total_mass * GRAVITY, PaperCoordinates(robot.sagittal).base
        self.stance_inertia = self.model.total_mass * rod_of(robot, stance_angles(robot))[3] ** 2  # [kg m^2]

    def state(self, p: Point) -> PlanarState:
        """The five links seen from the toe."""
        if "state" not in p.memo:
            turns = (ca.DM(LINK_OF_THETA) @ x for x in (p.q, p.v, p.a))
            p.memo["state"] = PlanarState(self.model, *turns, p.p.gravity)
        return p.memo["state"]

    def toe(self, p: Point, order: int = 0) -> ca.SX:
        """Tiptoe (2,), its velocity J theta', its acceleration."""
        return (p.q, p.v, p.a)[order][:2] - self.state(p).point(self.base, order)

    def com(self, p: Point, order: int = 0) -> ca.SX:
        """CoM (2,), its velocity, its acceleration."""
        s = self.state(p)
        return self.toe(p, order) + (s.com, s.com_velocity, s.com_acceleration)[order]

    def heel_rate(self, p: Point) -> ca.SX:
        """J_heel theta' in z [m/s]."""
        return self.toe(p, 1)[1] + self.state(p).point("heel", 1)[1]

    def tau_y(self, p: Point) -> ca.SX:
        """WL-D1: the ground's moment at the toe [N m] that gives the reference's dL/dt."""
        return p.ref.L_rate - _moment(self.toe(p) - self.com(p), p.z)

    def base_rows(self, p: Point, flying: bool) -> ca.SX:
        """WL-D3, WF-D1: the first three rows of M theta'' + H - J' F_ext, (3,) [N, N, N m]."""
        inertial = self.model.total_mass * (self.com(p, 2) + ca.vertcat(0, p.p.gravity))
        turning = self.state(p).angular_momentum_rate + _moment(self.com(p) - p.q[:2], inertial)
        if flying:
            return ca.vertcat(inertial, turning)
        return ca.vertcat(inertial - p.z, turning - self.tau_y(p) - _moment(self.toe(p) - p.q[:2], p.z))

    def foot_ahead(self, p: Point) -> ca.SX:
        """p_foot - c in x [m]; p_foot is read as the middle of the sole, stage 1's pivot."""
        s = self.state(p)
        return s.point(self.model.point_arms(0, self.model.sole_center))[0] - s.com[0]

    def _base(self, name: str, flying: bool, at: str, skip=(0, 0)) -> Term:
        size = ca.DM([self.mg, self.mg, 0.1 * self.mg])
        return Term(name, "WF-D1" if flying else "WL-D1..D3", "m g, 0.1 m g", at,
                    lambda p: self.base_rows(p, flying) / size, skip=skip)  # fmt: skip

    def _shared(self) -> list[Term]:
        w, s, smooth, size = self.weights, self.state, "WF-J2" if self.flying else "WL-J2", self.stance_inertia**2
        tracked = "WF-J1" if self.flying else "WL-J1"
        rates = w.track_flight_inertia_rate if self.flying else w.track_inertia_rate
        rows = [
            Term("track inertia", tracked, "kg m^2", "node", lambda p: s(p).inertia - p.ref.rho,
                 weight=float(w.track_inertia / size)),
            Term("track inertia rate", tracked, "kg m^2/s", "node", lambda p: s(p).inertia_rate - p.ref.rho_rate,
                 weight=float(rates / size)),
            # both sides together
            Term("acceleration", smooth, "m/s^2, rad/s^2", "node", lambda p: p.a, weight=2 * w.acceleration),
            Term("jerk", smooth, "m/s^3, rad/s^3", "mid", lambda p: p.j, weight=2 * w.jerk),
        ]  # fmt: skip
        if self.flying:
            rows.append(Term("ankle rate", "WF-J2", "rad/s", "node", lambda p: s(p).joint_rates[2],
                             weight=w.ankle_rate))  # fmt: skip
        return rows

    def launch(self) -> tuple[Term, ...]:
        """WL-*: tracking, smoothness, heel; dynamics, contact, end velocity."""
        moving, w = (1, 0), self.weights  # the start is given
        return (
            *self._shared(),
            Term("track velocity", "WL-J1", "m/s", "node", lambda p: self.com(p, 1) - p.ref.velocity,
                 weight=w.track_velocity),
            Term("ground force", "WL-J2", "N", "node", lambda p: p.z, weight=FORCE_WEIGHT),
            Term("heel velocity", "WL-J3", "m/s", "node", self.heel_rate, weight=w.heel_velocity),
            self._base("base rows", False, "node"),
            Term("tiptoe fixed", "WL-K1", "m/s", "node", lambda p: self.toe(p, 1), skip=moving),
            Term("heel not sinking", "WL-K2", "m/s", "node", self.heel_rate, lower=0.0, upper=np.inf, skip=moving),
            Term("end velocity", "WL-E1", "m/s", "end", lambda p: self.com(p, 1) - p.p.velocity),
        )  # fmt: skip

    def flight(self) -> tuple[Term, ...]:
        """WF-*: tracking, smoothness; dynamics, symmetric end."""
        return (
            *self._shared(),
            self._base(AT_TAKEOFF, True, "start"),
            self._base("base rows", True, "node", (1, 0)),
            Term("symmetric foot", "WF-E2", "m", "end", lambda p: self.foot_ahead(p) + p.p.foot_ahead),
        )


def _given(name: str):
    return lambda parameters: parameters[name]


def build_printed(robot: Robot, weights: Weights = Weights(), intervals: int = INTERVALS) -> tuple[Problem, Problem]:
    """The launch problem and the flight problem of Sec. V, each alone; durations are stage 1's."""
    terms, flown = PrintedTerms(robot, weights), PrintedTerms(robot, weights, True)
    m, fixed = robot.sagittal, (_given("duration"), _given("duration"))
    low, high, rate = -np.array(BASE_BOX), np.array(BASE_BOX), np.array([*BASE_RATE_BOX, *m.speed])
    boxes = (Bound("position box", "WL-S, WF-S", "m, rad", "q", [*low, *m.lower], [*high, *m.upper], "inner"),
             Bound("rate box", "WL-S, WF-S", "m/s, rad/s", "v", -rate, rate, "inner"),
             Bound("acceleration box", "WL-S, WF-S", "1/s^2", "a", -ACCEL_BOX, ACCEL_BOX, "inner"),
             Bound("jerk box", "WL-S, WF-S", "1/s^3", "j", -JERK_BOX, JERK_BOX))  # fmt: skip
    start = (Bound("stance", "ours: no start is printed", "m, rad", "q", _given("theta"), _given("theta"), "start"),
             Bound("at rest", "ours", "1/s", "v", 0.0, 0.0, "start"),
             Bound("at rest (acceleration)", "ours", "1/s^2", "a", 0.0, 0.0, "start"),
             Bound("force box", "WL-S", "N", "z", [-FORCE_BOX_N, 0.0], FORCE_BOX_N))  # fmt: skip
    names = (("theta", "WF-L1", "q"), ("theta'", "WF-L2", "v"), ("theta''", "WF-L3", "a"))
    link = tuple(Bound(f"{n} link", e, "m, rad, s", k, _given(n), _given(n), "start") for n, e, k in names)
    joints = np.array(3 * [np.inf] + 4 * [0.0])
    rest = tuple(Bound(f"joints at rest ({k})", "WF-E1", "rad, s", k, 0.0 - joints, joints, "end") for k in "va")
    launch = Phase("launch", COORDINATES, intervals, fixed, terms.launch(), boxes + start, ("F_x", "F_z"),
                   references={"rho": 1, "rho_rate": 1, "velocity": 2, "L_rate": 1}, scales=SCALES)  # fmt: skip
    flight = Phase("flight", COORDINATES, intervals, fixed, flown.flight(), boxes + link + rest,
                   references={"rho": 1, "rho_rate": 1}, scales=SCALES)  # fmt: skip
    common = dict(theta=7, duration=1, gravity=1)
    linked = {"theta'": 7, "theta''": 7, "foot_ahead": 1}
    return (Problem("printed launch", (launch,), (), common | dict(velocity=2)),
            Problem("printed flight", (flight,), (), common | linked))  # fmt: skip


class PrintedWholeBody:
    """The printed launch and flight problems for one robot: built once, solved for any of stage 1's plans."""

    def __init__(self, robot: Robot, weights: Weights = Weights(), intervals: int = INTERVALS, *,
                 options: Mapping = OPTIONS):  # fmt: skip
        self.robot, self.coordinates = robot, PaperCoordinates(robot.sagittal)
        self.options = options
        self.launch, self.flight = (Nlp(p, options) for p in build_printed(robot, weights, intervals))
        self._share = np.linspace(0, 1, intervals + 1)
        turn, place = np.zeros((1, 5)), np.zeros((1, 2))
        still = (stance_angles(robot)[None], turn, turn, -robot.sagittal.sole_center[None], place, place)
        self._stance = self.coordinates.theta(dict(zip(MOTION, still, strict=True)))[0][0]

    def plan(self, srmp: SrmpPlan, joints: JointPlan | None = None) -> PrintedPlan:
        """Try launch, then flight, from stage 2's guess; a failure of theirs is part of the result, not an error.

        ``joints`` is stage 2's plan, made here if None (raises what stage 2 raises).
        """
        joints = joints or map_to_joints(srmp, self.robot)
        plan, part = PrintedPlan(srmp.task), srmp.launch
        refs = {k: self._at_nodes(part.t, getattr(part, k)).T for k in ("rho", "rho_rate", "L_rate")}
        refs["velocity"] = self._at_nodes(part.t, part.com_velocity).T
        data = dict(theta=self._stance, velocity=part.com_velocity[-1], duration=srmp.launch_s,
                    gravity=srmp.task.gravity)  # fmt: skip
        try:
            launch = self.launch.solve(data, self._guess(joints, "launch"), references={"launch": refs})
        except SolverError as failed:
            return replace(plan, launch_status=failed.status)
        plan = replace(plan, launch=launch, launch_status=launch.statistics.status)
        plan = self._fly(plan, srmp, self._guess(joints, "flight"))
        return self._sampled(plan, refs["L_rate"][0])

    def _at_nodes(self, t, columns):
        at = t[0] + (t[-1] - t[0]) * self._share
        return np.stack([np.interp(at, t, c) for c in np.reshape(columns, (len(t), -1)).T], -1)

    def _guess(self, joints: JointPlan, phase: str) -> dict[str, PhaseGuess]:
        """Stage 2's base link is the paper's base; its left side stands for both."""
        rows, model = joints.rows(phase), self.robot.model
        t, q, v = joints.t[rows], joints.q[rows], joints.v[rows]
        left = {row: (model.getJointId(name), sign) for name, row, sign in reversed(self.robot.role_signs())}
        still = np.zeros(len(t))  # arms that are held
        pitch = np.unwrap(2 * np.arctan2(q[:, 4], q[:, 6]), period=2 * np.pi)
        c, s = np.cos(pitch), np.sin(pitch)
        angles, speeds = ([x[:, index[left[i][0]]] * left[i][1] if i in left else still for i in range(len(ROLES))]
                          for x, index in ((q, model.idx_qs), (v, model.idx_vs)))  # fmt: skip
        theta = [q[:, 0], q[:, 2], pitch, *angles]
        rate = [c * v[:, 0] + s * v[:, 2], c * v[:, 2] - s * v[:, 0], v[:, 4], *speeds]
        theta, rate = (self._at_nodes(t, np.stack(x, -1)) for x in (theta, rate))
        force = self._at_nodes(t, joints.f[rows].sum(axis=1)[:, [0, 2]]) if phase == "launch" else None
        return {phase: PhaseGuess(float(t[-1] - t[0]), theta, rate, None, force)}

    def _fly(self, plan: PrintedPlan, srmp: SrmpPlan, guess) -> PrintedPlan:
        """The flight as printed; if it fails, once more without its base rows at take-off."""
        end = plan.launch.phases["launch"]
        state = [x[-1] for x in (end.q, end.v, end.a)]
        now = planar_numbers(self.robot, self.coordinates.links(*(x[None] for x in state)), srmp.task.gravity)
        data = dict(zip(("theta", "theta'", "theta''"), state, strict=True))
        data |= dict(duration=srmp.flight_s, gravity=srmp.task.gravity, foot_ahead=(now["sole"] - now["com"])[0, 0])
        part, said, flight = srmp.flight, [], None
        refs = {"flight": {k: self._at_nodes(part.t, getattr(part, k)).T for k in ("rho", "rho_rate")}}
        for off in ((), (AT_TAKEOFF,)):
            solver = Nlp(changed(self.flight.problem, off=off), self.options) if off else self.flight
            try:
                flight = solver.solve(data, guess, references=refs)
                said.append(flight.statistics.status)
                break
            except SolverError as failed:
                said.append(failed.status)
        return replace(plan, flight=flight, flight_status=said[0], repaired_status="".join(said[1:]))

    def _sampled(self, plan: PrintedPlan, l_rate) -> PrintedPlan:
        """Sample what was solved at 1 kHz; take-off falls on a sample and appears twice, the last is the touchdown."""
        launch = plan.launch.phases["launch"]
        since = np.arange(-int(np.ceil(launch.duration * RATE_HZ - 1e-9)), 1) / RATE_HZ  # since take-off
        t = np.maximum(launch.duration + since, 0.0)  # up to 1 ms more of standing at the start
        parts, times = [launch.sample(t)], [since]
        if plan.flight:
            flight = plan.flight.phases["flight"]
            times.append(np.append(np.arange(0, flight.duration - 0.25 / RATE_HZ, 1 / RATE_HZ), flight.duration))
            parts.append(flight.sample(times[1]))
        motion = self.coordinates.links(*(np.concatenate(x) for x in zip(*parts, strict=True)))
        flying = np.arange(len(motion["toe"])) >= len(t)
        motion |= dict(t=np.concatenate(times) - since[0], flying=flying, toe_phase_start=np.array(0.0))
        force = np.stack([np.interp(t, launch.t, f) for f in launch.z.T])
        com = planar_numbers(self.robot, motion, plan.task.gravity)["com"][~flying].T
        wrench = (*force, np.interp(t, launch.t, l_rate) + _moment(com, force))  # WL-D1; com is seen from the toe
        f_x, f_z, tau_y = (np.append(x, np.zeros(flying.sum())) for x in wrench)
        return replace(plan, motion=motion, F_x=f_x, F_z=f_z, tau_y=tau_y)


def planar_numbers(robot: Robot, motion: Mapping, gravity: float) -> dict[str, np.ndarray]:
    """Planar quantities (n, size) of a motion, and the force [N] and moment [N m] at the toe that it needs."""
    inputs = zip(("angles", "rates", "accels", "toe"), (*MOTION[:3], "toe_acceleration"), strict=True)
    all_at_once = evaluator(robot.sagittal, gravity).map(len(motion["toe"]))
    out = {k: x.full().T for k, x in all_at_once(**{k: motion[name].T for k, name in inputs}).items()}
    force = robot.sagittal.total_mass * (out["com_acceleration"] + motion["toe_acceleration"] + [0.0, gravity])
    return out | dict(force=force, moment=out["L_rate"][:, 0] + _moment(out["com"].T, force.T))
