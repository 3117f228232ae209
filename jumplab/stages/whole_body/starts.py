"""Starts of a solve of the whole-body program: lists of them, each with its patience."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from jumplab.ocp.nlp import RESIDUAL_LIMIT, WARM, warm
from jumplab.ocp.solution import Multipliers, PhaseGuess
from jumplab.stages.whole_body.apart import as_before
from jumplab.stages.whole_body.motions import Motion, guess, mended, ramped, reached, still
from jumplab.stages.whole_body.shapes import Apart

if TYPE_CHECKING:
    from jumplab.stages.srmp import SrmpPlan
    from jumplab.stages.whole_body.program import Program, Solved
    from jumplab.task import JumpTask

# from a first barrier of 1e-4 jumps aside take up to twice the steps, from one of 5e-4 some wander
NEAR = WARM | {"acceptable_iter": 1, "mu_strategy": "monotone", "mu_init": 3e-4}
# with the held Hessian some come below 1e-4 at once and stay above 5e-5 for twenty steps, at one
# cost; a solution is believed below 1e-4
NEAR |= {"acceptable_constr_viol_tol": 9e-5}
# where a motion passes limits between the nodes, it often is not settled: from there on with
# smaller steps of the cost
PATIENT = {"acceptable_iter": 8, "acceptable_obj_change_tol": 5e-4}
# added to the Gauss-Newton Hessian of the scaled variables: it leads there in half the time
HOLD = 0.1
# more of it, for shorter steps where rows would swing about their limits
SHORTER = 0.3
SHORTEST = 1.0


@dataclass(frozen=True)
class Beginning:
    """Values at the nodes; of a solution also its multipliers, and rows for its links that met."""

    guess: Mapping[str, PhaseGuess]
    multipliers: Multipliers | None = None
    apart: tuple[Apart, ...] = ()


@dataclass(frozen=True)
class Attempt:
    """Outcome of one start; of those that are compared also their plans (None of others).

    Attributes
    ----------
    cost : of the program [1].
    crouch_m : how far the base went down before take-off.
    arms_rad : range of the shoulders until then, 0 without arms.
    heels_rad : pitch of the feet as they left the ground.
    """

    start: str
    hessian: str
    iterations: int
    cpu_s: float
    status: str
    cost: float | None = None
    crouch_m: float | None = None
    arms_rad: float | None = None
    heels_rad: float | None = None


@dataclass(frozen=True)
class Asked:
    """Request that is the same for every solve of one target, whatever its program and its start.

    Attributes
    ----------
    stance : chart (6 + joints,) in which the robot waits, the usual one if None.
    srmp : stage 1's plan, where that is followed.
    weights : instead of the terms' own.
    near : a plan for a target close by, or values at the nodes; None if there is none.
    motion : that is given; None if there is none.
    straight : the program of jumps straight ahead; None if there is none.
    attempts : made so far.
    """

    task: JumpTask
    stance: np.ndarray | None = None
    srmp: SrmpPlan | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    near: Solved | Mapping[str, PhaseGuess] | None = None
    motion: Motion | None = None
    straight: Program | None = None
    attempts: list[Attempt] = field(default_factory=list)

    def note(self, start: Start, iterations: int, status: str, cpu_s: float) -> None:
        """Add what came of a ``start``, which took ``cpu_s`` [s]."""
        self.attempts.append(Attempt(start.name, start.hessian, iterations, cpu_s, status))

    @property
    def spent_s(self) -> float:
        """Processor time of all attempts [s]."""
        return sum(attempt.cpu_s for attempt in self.attempts)


@dataclass(frozen=True)
class Start:
    """One way to begin a solve.

    Attributes
    ----------
    name : of what it begins with.
    begin : what that is, in a program and for what is asked.
    held : whether the Hessian is the Gauss-Newton one, held; else the exact one.
    patience : iterations after which it is given up, so that a busy machine finds the same plan;
        their processor time has a bound as well, see :meth:`.Program.solve`.
    options : of ipopt besides the usual ones.
    hold : what is added to the held Hessian [1]: with more of it steps are shorter.
    """

    name: str
    begin: Callable[[Program, Asked], Beginning]
    held: bool
    patience: int
    options: Mapping[str, Any] = field(default_factory=dict)
    hold: float = HOLD

    @property
    def hessian(self) -> str:
        """The Hessian in words."""
        return "held Gauss-Newton" if self.held else "exact"

    @property
    def rough(self) -> bool:
        """Whether it ends before its rows are met, so that another solve has to follow."""
        return self.options.get("acceptable_constr_viol_tol", 0.0) > RESIDUAL_LIMIT


def from_schedule(
    program: Program, asked: Asked, draw: Callable[..., Motion] = reached, **drawn: Any
) -> Beginning:
    """A motion along the schedule, as a function such as :func:`.reached` ``draw``s it."""
    schedule = program.schedule()
    return Beginning(guess(schedule, asked.task, draw(schedule, asked.task, **drawn)))


from_stance = partial(from_schedule, draw=still)  # the stance, carried along


def from_motion(program: Program, asked: Asked) -> Beginning:
    """The motion that is given (``asked.motion``)."""
    return Beginning(guess(program.schedule(), asked.task, asked.motion))


def from_mended(program: Program, asked: Asked) -> Beginning:
    """The same with its feet in their places (see :func:`.mended`)."""
    return from_schedule(program, asked, mended, motion=asked.motion)


def from_neighbour(program: Program, asked: Asked) -> Beginning:
    """A plan for a target close by (``asked.near``); of one in other coordinates its motion."""
    near = asked.near
    if isinstance(near, Mapping):
        return Beginning(near)
    if near.schedule.free.kind == program.free.kind:
        return from_solved(program, near)
    size = len(program.free.names)
    meshes = zip(near.phases.values(), program.contacts.phases, strict=True)
    charts = [x.guess(phase.intervals).q[:, :size] for x, phase in meshes]
    durations = np.array([x.duration for x in near.phases.values()])
    return Beginning(guess(program.schedule(), asked.task, Motion(durations, charts)))


def from_straight(program: Program, asked: Asked) -> Beginning:
    """The jump straight ahead, which goes aside and turns on the way (see :func:`.ramped`).

    Solved in half the unknowns, it halves the iterations. It begins in the stance, whatever posture
    is asked for.
    """
    ahead = replace(asked.task, side_m=0.0, yaw_rad=0.0)
    easier = replace(asked, task=ahead, stance=None, weights={})
    phases = asked.straight.solve(easier, STRAIGHT).phases
    return Beginning(ramped(program.contacts, phases, asked.task))


def from_solved(program: Program, solved: Solved) -> Beginning:
    """A solution in the same coordinates, at the nodes (N + 1,) of the program's phases."""
    intervals = {p.name: p.intervals for p in program.contacts.phases}
    apart = []
    for x in solved.schedule.apart:
        count = program.contacts.phases[x.phase].intervals
        ratio = count / solved.schedule.contacts.phases[x.phase].intervals
        last = min(count, math.ceil(ratio * x.last))
        apart.append(replace(x, first=max(1, int(ratio * x.first)), last=last))
    return Beginning(solved.solution.guess(intervals), solved.solution.multipliers, tuple(apart))


def unpassed(program: Program, asked: Asked, rows: Sequence[Apart]) -> Beginning:
    """The stance, carried along the schedule, with links that met (``rows``) kept where they were
    before they did: an arm that cannot swing past a thigh stays behind it.
    """
    return replace(from_stance(program, asked), apart=as_before(rows))


NEIGHBOUR = "neighbour"
STANCE = "stance"
MENDED = "given motion, feet in place"
# first multipliers by how far each limit is: where all begin alike, the barrier wanders for up to
# thirty steps
QUICK = {"acceptable_iter": 1, "bound_mult_init_method": "mu-based"}
STRAIGHT = Start("straight ahead", from_schedule, True, 80, QUICK)
COLD = (
    Start("schedule", from_schedule, True, 150),
    Start("schedule", from_schedule, False, 150),
    Start(STANCE, from_stance, False, 80),
)
# those that are compared, where the cheapest of several is asked for
COMPARED = (
    *COLD[1:],
    *(
        Start(name, partial(from_schedule, crouch=crouch, arms=arms), False, 150)
        for name, crouch, arms in (
            ("deep", 0.35, 1.0),
            ("shallow", 0.05, 1.0),
            ("arms still", 0.2, 0.0),
            ("arms wide", 0.2, 2.0),
            ("arms the other way", 0.2, -1.0),
            ("deep, arms wide", 0.35, 2.0),
            ("shallow, arms still", 0.05, 0.0),
            ("shallow, arms the other way", 0.05, -1.0),
        )
    ),
)
# a jump straight ahead, led aside, begins as near its limits as it will be; a barrier that ends
# where the cost is within 0.1 % of its least lets it take whole steps to the end
RAMPED = QUICK | {"mu_init": 1e-2, "mu_min": 1e-4}
ASIDE = (Start("ramp", from_straight, True, 150, RAMPED), *COLD)
# in the plane a step costs a few milliseconds: where the held Hessian wanders, the exact one is
# tried soon
IN_PLANE = (replace(COLD[0], patience=50), *COLD[1:])
GIVEN = (
    Start("given motion", from_motion, True, 60),
    Start("given motion", from_motion, False, 150),
    Start(MENDED, from_mended, True, 60),
    Start(MENDED, from_mended, False, 150),
)
# of a motion that is followed: near it the exact Hessian settles, the held one wanders. Links that
# meet move it further, so it ends roughly, where they are seen, and is solved on with their rows
ROUGH = {
    "acceptable_constr_viol_tol": 1e-2,
    "acceptable_compl_inf_tol": 0.3,
    "acceptable_obj_change_tol": 3e-2,
}
# of a schedule, whose feet are in place and whose links meet long before its cost has settled
DRAWN = replace(COLD[0], patience=100, options=QUICK | ROUGH)
# one that leads somewhere has mostly done so after 40 steps; a step off by 0.1 m takes 54
ALONG = (replace(DRAWN, patience=80), *COLD[1:])
# where links meet, more of its rows are left to the second solve: from 3e-2 to 1e-2 the barrier of
# the first one may wander for ten steps
MET_ROUGHLY = ROUGH | {"acceptable_constr_viol_tol": 3e-2}
FOLLOWED = (Start("given motion", from_motion, False, 120, QUICK | MET_ROUGHLY),)
FROM_NEIGHBOUR = (
    Start(NEIGHBOUR, from_neighbour, True, 100, NEAR),
    Start(NEIGHBOUR, from_neighbour, False, 150, WARM | {"acceptable_iter": 1}),
)
# from a solution: with rows for links that met, to the end, on finer meshes
MET = WARM | {"acceptable_iter": 1, "mu_init": 1e-3}
APART = (
    Start("links apart", from_neighbour, True, 80, MET),
    Start("links apart", from_neighbour, False, 120, MET),
)
STILL = replace(COLD[-1], name="links apart as before")
# from a rough solution with the held Hessian; with less hold the G1 takes a hundred iterations
HELD_AFTER_ROUGH = tuple(
    Start("links apart", from_neighbour, True, 100, NEAR | {"mu_init": mu}, hold)
    for mu, hold in ((1e-3, SHORTER), (3e-4, SHORTEST))
)
# with the exact one, further inside the limits with a higher barrier; then from what came of it
STEPPED = MET | {"mu_strategy": "monotone"}
AFTER_ROUGH = tuple(
    Start("links apart", from_neighbour, False, 120, STEPPED | warm(push) | {"mu_init": mu})
    for push, mu in ((1e-3, 3e-3), (1e-4, 3e-4))
)
# to a record from an easy jump: to the end, or its prices would be rounding
EXACT = {"acceptable_iter": 0, "tol": 1e-4}
FAR_OFF = {"mu_init": 0.1, "mu_strategy": "monotone"}  # adaptive, it ends sooner, and lower
SEEKING = Start("easy jump", from_neighbour, False, 300, WARM | EXACT | FAR_OFF)
RECORD = Start("record", from_neighbour, False, 150, WARM | EXACT | {"mu_init": 1e-4})
SETTLED = Start("settled", from_neighbour, False, 150, WARM | PATIENT)
FINER = Start("finer mesh", from_neighbour, False, 150, WARM | {"acceptable_iter": 1})
# of schedules, in half of the time of the exact Hessian
CLOSER = {"mu_init": 1e-4, "acceptable_iter": 5, "acceptable_obj_change_tol": 5e-4}
HELD_SETTLED = replace(SETTLED, held=True, patience=40, options=NEAR | CLOSER)
REFINED_ALONG = (HELD_SETTLED, replace(HELD_SETTLED, hold=SHORTEST), SETTLED, FINER, FINER)
REFINED = (SETTLED, FINER, FINER, FINER)  # the last one for flips of robots with a waist
