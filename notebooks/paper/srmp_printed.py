"""Stage 1 exactly as the paper prints it: first the launch alone, then the flight from wherever the launch ended.

Kept to be compared with the joint problem of :mod:`jumplab.stages.srmp.problem`, never to plan with. Costs, weights and
end constraints are the same terms; what differs is what Sec. III prints and what it does not: two problems in a row,
boxes instead of the robot's envelope, the CoP as a quotient, no friction, no unilateral force, no leg force.

Nothing in the printed launch ties its final angular momentum to the rotation that the flight needs, so most flights
have no solution. ``window=True`` adds what is missing at the launch's end and nothing else: the momentum is one that
some inertia within the range can turn into the needed rotation, and the inertia's motion can still be stopped.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from jumplab.errors import InputError, SolverError
from jumplab.models.srmp import COORDINATES, SrmpState
from jumplab.ocp.nlp import Nlp, PhaseGuess, Solution
from jumplab.ocp.problem import Bound, Phase, Point, Problem, Term
from jumplab.robot import Robot
from jumplab.robot.reach import Reach, reach
from jumplab.stages.srmp.planner import naive_guess
from jumplab.stages.srmp.problem import FLIGHT_SCALES, SCALES, flight_terms, launch_terms, rod_at, takeoff_terms
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.task import GRAVITY, JumpTask

PRINTED_COSTS = ("jerk", "CoM velocity", "L rate", "turn", "L range")  # of the launch, SL-J1..J4 and SL-P5
PRINTED_FLIGHT = ("inertia acceleration", "inertia jerk", "rotation")  # SF-J1, SF-D1
LAUNCH_S = (0.3, 1.2)  # [s] printed is only that the time costs something
RATE_BOX = (10.0, 6.0, 15.0, 3.0)  # [1/s] of SL-B1: beyond what any solution here uses
ACCEL_BOX = (150.0, 100.0, 200.0, 50.0)  # [1/s^2] of SL-B1, likewise
FORCE_BOX = (300.0, 4000.0, 300.0, 4000.0)  # [N m, N] of SL-B1 on tau_l, F_phi, tau_pl, F_varphi, likewise
INERTIA_JERK_BOX = 2e4  # [kg m^2/s^3] of SF-B1: reaches the inertia acceleration's box in 30 ms
WINDOW_MARGIN = 0.25  # share of the inertia range kept free on either side, for take-off and for the mean
WINDOW_RATE = 10.0  # [kg m^2/s] stopped at the flight's acceleration box within a tenth of the range
WINDOW_ACCEL = 200.0  # [kg m^2/s^2] a third of the flight's box
PARAMETERS = dict(start=4, distance=1, takeoff_speed=1, flight_time=1, rotation=1, gravity=1)
FLIGHT_PARAMETERS = dict(start=4, L=1, flight_time=1, rotation=1)
SYMMETRIC = Term(  # for the joint problem: about the pivot it lands too far ahead, and falls
    "symmetric landing", "SF-E1 (about the pivot)", "rad", "problem",
    lambda e: e["flight"].end.z[0] + e["toe"].end.q[0] - e["flight"].end.p.rotation,
)  # fmt: skip


@dataclass(frozen=True)
class PrintedResult:
    """Result of the sequence for one target.

    Attributes
    ----------
    task : the target.
    launch, flight : the solutions, or None; the flight is not tried if the launch failed.
    launch_status, flight_status : what the solver said; "not tried".
    friction_used : greatest |F_x / F_z| of the launch where the ground carries a tenth of the weight or more [1].
    lowest_force_n : least vertical ground force of the launch before take-off [N]; negative pulls on the ground.
    envelope_excess : greatest distance of the launch's inertia outside rho(phi) of the robot [kg m^2], 0 if inside.
    """

    task: JumpTask
    launch: Solution | None
    flight: Solution | None
    launch_status: str
    flight_status: str
    friction_used: float = float("nan")
    lowest_force_n: float = float("nan")
    envelope_excess: float = float("nan")

    @property
    def solved(self) -> bool:
        """True if launch and flight both have a solution."""
        return self.launch is not None and self.flight is not None


@dataclass(frozen=True)
class SuccessCount:
    """Number of ``targets`` with a launch, and of those with a flight as well."""

    targets: int
    launches: int
    flights: int


def _pick(terms: Iterable[Term], names: tuple[str, ...]) -> list[Term]:
    return [t for t in terms if t.name in names]


def _launch_only_terms(mass: float, envelope: Reach) -> list[Term]:
    """Printed constraints that the joint problem states otherwise: SL-P2, SL-P4, SL-B1 on F, SL-E1."""

    def cop(p: Point):
        com, acc = p.com, p.com_acceleration
        return com[0] - (mass * com[1] * acc[0] + p.L_rate) / (mass * (acc[1] + p.p.gravity))

    def forces(p: Point):
        rows = (p.pivot_torque, p.rod_force, p.L_rate, p.barbell_force)
        return [row / box for row, box in zip(rows, FORCE_BOX, strict=True)]

    def length(p: Point):
        return 2 * p.com[0] + p.com_velocity[0] * p.p.flight_time - p.p.distance

    heel, toe = envelope.cop
    low, high = envelope.inertia
    return [
        Term("CoP", "SL-P2, as printed; 0/0 at the last node", "m", "node", cop, lower=heel, upper=toe, scale=0.1,
             skip=(0, 1)),
        Term("inertia range", "SL-P4, SL-E5", "kg m^2", "node", lambda p: p.inertia, lower=low,
             upper=high),
        Term("force box", "SL-B1", "1", "node", forces, lower=-1.0, upper=1.0),
        Term("jump length", "SL-E1", "m", "end", length),
    ]  # fmt: skip


def _window_terms(envelope: Reach, s: SrmpSettings) -> list[Term]:
    """Terms that the printed launch lacks: at take-off the flight must still be possible."""
    low, high = _inner(envelope.inertia, WINDOW_MARGIN)

    def rotation(p: Point):
        turn = p.p.rotation - 2 * p.q[0]
        return p.L * p.p.flight_time - p.c.mean_inertia * turn

    return [
        Term("momentum window", "ours: mean inertia times SF-E1's rotation", "kg m^2", "end", rotation),
        Term("inertia at take-off", "ours", "kg m^2", "end", lambda p: p.inertia, lower=low,
             upper=high),
        Term("inertia rate at take-off", "ours", "kg m^2/s", "end", lambda p: p.inertia_rate,
             lower=-WINDOW_RATE, upper=WINDOW_RATE, scale=10.0),
        Term("inertia acceleration at take-off", "ours", "kg m^2/s^2", "end",
             lambda p: p.inertia_accel, lower=-WINDOW_ACCEL, upper=WINDOW_ACCEL, scale=100.0),
    ]  # fmt: skip


def _inner(bounds: tuple[float, float], share: float) -> tuple[float, float]:
    margin = share * (bounds[1] - bounds[0])
    return bounds[0] + margin, bounds[1] - margin


def build_printed_launch(robot: Robot, settings: SrmpSettings, envelope: Reach, window: bool = False) -> Problem:
    """SL-*: the launch problem alone (Sec. III-A); with ``window`` also what the flight needs of its end."""
    mass = robot.sagittal.total_mass
    low, high = envelope.length
    box_low = [settings.takeoff_lean[0], low, -2.5, 0.1]  # as in the joint problem
    box_high = [settings.takeoff_lean[1], high, 2.5, 1.0]
    start = Bound("start posture", "SL-P3; ours: the stance", "rad, m", "q", _start, _start, "start")
    bounds = (
        start,
        Bound("at rest", "ours", "1/s", "v", 0.0, 0.0, "start"),
        Bound("at rest (acceleration)", "ours", "1/s^2", "a", 0.0, 0.0, "start"),
        Bound("state box", "SL-B1", "rad, m", "q", box_low, box_high, "inner"),
        Bound("rate box", "SL-B1", "1/s", "v", -np.array(RATE_BOX), RATE_BOX),
        Bound("acceleration box", "SL-B1", "1/s^2", "a", -np.array(ACCEL_BOX), ACCEL_BOX),
    )
    time = Term("launch time", "SL-J5", "s", "end", lambda p: p.duration, weight=settings.w_time)
    terms = [*_pick(launch_terms(mass, envelope, settings), PRINTED_COSTS), *_launch_only_terms(mass, envelope),
             *(t for t in takeoff_terms(mass, envelope, settings) if t.name != "take-off length"), time]  # fmt: skip
    constants = {}
    if window:
        terms += _window_terms(envelope, settings)
        constants["mean_inertia"] = (*_inner(envelope.inertia, WINDOW_MARGIN), 1.0)
    phase = Phase("launch", COORDINATES, sum(settings.intervals[:2]), LAUNCH_S, tuple(terms), bounds,
                  constants=constants, scales=SCALES, view=partial(rod_at, mass))  # fmt: skip
    return Problem("printed launch", (phase,), (), dict(PARAMETERS))


def _start(parameters):
    return parameters["start"]


def build_printed_flight(settings: SrmpSettings, envelope: Reach) -> Problem:
    """SF-*: the flight problem alone (Sec. III-B), its start (theta, rho, rho', rho'') and L given."""

    def momentum(parameters):
        return parameters["L"]

    def duration(parameters):
        return parameters["flight_time"]

    symmetric = Term("symmetric landing", "SF-E1", "rad", "end", lambda p: p.z[0] + p.p.start[0] - p.p.rotation)
    bounds = (
        Bound("inertia range", "SF-B1", "kg m^2", "q", *envelope.inertia, "inner"),
        Bound("inertia rate range", "SF-B1", "kg m^2/s", "v", -settings.inertia_rate, settings.inertia_rate, "inner"),
        Bound("inertia acceleration range", "SF-B1", "kg m^2/s^2", "a", -settings.inertia_accel,
              settings.inertia_accel, "inner"),
        Bound("inertia jerk range", "SF-B1", "kg m^2/s^3", "j", -INERTIA_JERK_BOX, INERTIA_JERK_BOX),
        *(Bound(f"{name} link", equation, unit, on, _component(i), _component(i), "start")
          for i, (name, equation, unit, on) in enumerate((
              ("lean", "SF-L1", "rad", "z"), ("inertia", "SF-L2", "kg m^2", "q"),
              ("inertia rate", "SF-L3", "kg m^2/s", "v"), ("inertia acceleration", "SF-L4", "kg m^2/s^2", "a")))),
    )  # fmt: skip
    phase = Phase("flight", ("inertia",), settings.intervals[2], (duration, duration),
                  (*_pick(flight_terms(settings), PRINTED_FLIGHT), symmetric), bounds, states=("theta",),
                  constants={"L": (momentum, momentum, 10.0)}, scales=FLIGHT_SCALES)  # fmt: skip
    return Problem("printed flight", (phase,), (), dict(FLIGHT_PARAMETERS))


def _component(i: int):
    return lambda parameters: parameters["start"][i]


class PrintedSequence:
    """The printed launch and flight problems for one robot: built once, solved for any target.

    Parameters
    ----------
    robot : gives mass, stance, sole and the ranges of leg length and inertia.
    settings : weights and boxes, as for the joint problem.
    window : add the conditions at take-off without which few flights exist.
    """

    def __init__(self, robot: Robot, settings: SrmpSettings = SrmpSettings(), *, window: bool = False):
        self.settings, self.reach, self.window = settings, reach(robot), window
        self._mass = robot.sagittal.total_mass
        self._launch = Nlp(build_printed_launch(robot, settings, self.reach, window))
        self._flight = Nlp(build_printed_flight(settings, self.reach))

    def plan(self, task: JumpTask) -> PrintedResult:
        """Try launch, then flight; failure is part of the result, not an error.

        Raises
        ------
        InputError
            If the task lands higher or lower than it starts: the printed t_f = 2 v / g has no platform.
        """
        if task.platform_m:
            raise InputError(
                f"platform = {task.platform_m:g} m: the printed t_f = 2 v/g knows only level ground; ask for 0 m, or "
                f"use the joint problem"
            )
        t_f = task.flight_time()
        data = dict(start=self.reach.start, distance=task.distance_m, takeoff_speed=task.takeoff_speed, flight_time=t_f,
                    rotation=task.rotation_rad, gravity=task.gravity)  # fmt: skip
        try:
            launch = self._launch.solve(data, {"launch": self._launch_guess(task)})
        except SolverError as failed:
            return PrintedResult(task, None, None, failed.status, "not tried")
        result = PrintedResult(task, launch, None, launch.statistics.status, "", *self._audit(launch, task.gravity))
        end = launch.phases["launch"]
        state = _numbers(self._mass, end.q[-1], end.v[-1], end.a[-1], task.gravity)
        links = [end.q[-1, 0], state["rho"], state["rho_rate"], state["rho_accel"]]
        try:
            flight = self._flight.solve(dict(start=links, L=state["L"], flight_time=t_f, rotation=task.rotation_rad),
                                        {"flight": self._flight_guess(task, links, state["L"])})  # fmt: skip
        except SolverError as failed:
            return replace(result, flight_status=failed.status)
        return replace(result, flight=flight, flight_status=flight.statistics.status)

    def _launch_guess(self, task: JumpTask) -> PhaseGuess:
        parts = naive_guess(task, self.reach, self.settings)
        flat, toe = parts["flat"], parts["toe"]
        at = np.concatenate([np.linspace(0, flat.duration, len(flat.q)),
                             flat.duration + np.linspace(0, toe.duration, len(toe.q))])  # fmt: skip
        t = np.linspace(0, at[-1], sum(self.settings.intervals[:2]) + 1)
        q = np.stack([np.interp(t, at, column) for column in np.concatenate([flat.q, toe.q]).T], -1)
        return PhaseGuess(at[-1], q, 0 * q, 0 * q, constants={"mean_inertia": float(np.mean(self.reach.inertia))})

    def _flight_guess(self, task: JumpTask, links, momentum: float) -> PhaseGuess:
        s = np.linspace(0, 1, self.settings.intervals[2] + 1)[:, None]
        theta = links[0] + s * (task.rotation_rad - 2 * links[0])
        return PhaseGuess(task.flight_time(), np.full_like(s, links[1]), 0 * s, 0 * s, theta, {"L": momentum})

    def _audit(self, launch: Solution, gravity: float) -> tuple[float, float, float]:
        """Friction used, lowest vertical force and excess over rho(phi): what the printed problem does not ask."""
        phase = launch.phases["launch"]
        rows = [_numbers(self._mass, *x, gravity) for x in zip(phase.q, phase.v, phase.a, strict=True)]
        f_x, f_z, rho = (np.array([r[k] for r in rows]) for k in ("F_x", "F_z", "rho"))
        firm = f_z > 0.1 * self._mass * GRAVITY
        low, high = (np.polyval(f, phase.q[:, 1]) for f in (self.reach.inertia_low_fit, self.reach.inertia_high_fit))
        excess = float(np.max(np.maximum(low - rho, rho - high)))
        return float(np.max(np.abs(f_x[firm]) / f_z[firm])), float(f_z[:-1].min()), max(excess, 0.0)


def _numbers(mass: float, q, v, a, gravity: float) -> dict[str, float]:
    """SRMP quantities of one node as numbers."""
    s = SrmpState(mass, q, v, a, gravity)
    f_x, f_z = (float(x) for x in s.ground_force.full().ravel())
    return dict(rho=float(s.inertia), rho_rate=float(s.inertia_rate), rho_accel=float(s.inertia_accel),
                L=float(s.L), F_x=f_x, F_z=f_z)  # fmt: skip


def count_successes(sequence: PrintedSequence, targets: Iterable[JumpTask]) -> SuccessCount:
    """Try every target and count launches and flights that were solved."""
    results = [sequence.plan(task) for task in targets]
    return SuccessCount(len(results), sum(r.launch is not None for r in results), sum(r.solved for r in results))
