"""Measurements of stage 2's notebook: its programs in cvxpy against the library's, one weight or choice at a time."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import null_space

from jumplab.models.full import FullTerms
from jumplab.ocp.qp import Block, Qp, QpAnswer, QpSolver
from jumplab.robot import Robot
from jumplab.stages.joint_qp import JointMapper, JointPlan, Options, map_to_joints
from jumplab.stages.joint_qp.rollout import State
from jumplab.stages.joint_qp.settings import Gain, Gains, LaunchWeights
from jumplab.stages.planner import STEPS_S, motion_of_joints
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body import WholeBodyPlanner
from jumplab.task import JumpTask
from paper.tracking import tracking

CLARABEL = {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}
QUANTITIES = ("M", "H", "J", "A_f", "A_c", "B_c", "J_rho", "drift_rho")
ZERO = cp.Constant(0.0)


# ------------------------------------------------------------------------- programs in cvxpy


class CvxpySolver:
    """The library's programs by cvxpy and Clarabel; one problem with Parameters (DPP) for each shape, turned into
    standard form once.
    """

    def __init__(self):
        self.problems: dict[tuple, tuple[cp.Problem, cp.Variable, list[cp.Parameter]]] = {}

    def solve(self, qp: Qp) -> QpAnswer:
        """Solve one step; whether the answer can be trusted is asked again by who takes it."""
        matrices = wide(qp)
        shape = tuple(x.shape for x in matrices)
        if shape not in self.problems:
            self.problems[shape] = self._posed(matrices)
        problem, x, parameters = self.problems[shape]
        for parameter, value in zip(parameters, matrices, strict=True):
            parameter.value = value
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an inaccurate answer is judged by its rows, not by a warning
            problem.solve(solver=cp.CLARABEL, warm_start=False, enforce_dpp=True, **CLARABEL)
        value = np.full(qp.size, np.nan) if x.value is None else x.value
        iterations = int(problem.solver_stats.num_iters or 0)
        return QpAnswer(value, iterations, str(problem.status), problem.status == "optimal")

    def _posed(self, matrices: Sequence[np.ndarray]) -> tuple[cp.Problem, cp.Variable, list[cp.Parameter]]:
        A, b, E, e, G, h = given = [cp.Parameter(x.shape) for x in matrices]
        x = cp.Variable(A.shape[1])
        return cp.Problem(cp.Minimize(cp.sum_squares(A @ x - b) / 2), [E @ x == e, G @ x <= h]), x, given


def wide(qp: Qp) -> tuple[np.ndarray, ...]:
    """A, b, E, e, G and h of min 1/2 |A x - b|^2, E x = e, G x <= h: the roots of the weights multiplied in, sides that
    are free left out.
    """
    costs, equal, limits = (list(x.values()) for x in (qp.costs, qp.equalities, qp.limits))
    roots = np.sqrt(np.concatenate([x.weight for x in costs]))
    parts = [(np.vstack([x.matrix for x in xs]), np.concatenate([x.low for x in xs])) for xs in (costs, equal, limits)]
    (A, b), (E, e), (G, low) = parts
    high = np.concatenate([x.high for x in limits])
    below, above = np.isfinite(low), np.isfinite(high)
    return roots[:, None] * A, roots * b, E, e, np.vstack([-G[below], G[above]]), np.r_[-low[below], high[above]]


@dataclass
class Written:
    """The program of one phase as it is written in cvxpy, and the steps at which it is looked at.

    Attributes
    ----------
    qp : the library's programs of that phase.  x : the unknowns.  given : the Parameters.
    wishes : block -> residual.  equal, above : block -> what is 0, or at least 0.
    between : block -> lowest value, expression, highest value.
    steps : with ``k``, ``numbers`` by the names of the Parameters, and ``weights`` by block.
    problem, weight : the program, and the Parameters of its weights by block, once it is put together.
    """

    qp: Any
    x: cp.Variable
    given: SimpleNamespace
    wishes: dict[str, cp.Expression]
    equal: dict[str, cp.Expression]
    above: dict[str, cp.Expression]
    between: dict[str, tuple]
    steps: Sequence[SimpleNamespace]
    problem: cp.Problem | None = None
    weight: dict[str, cp.Parameter] = field(default_factory=dict)

    def fill(self, step: SimpleNamespace) -> None:
        """Give all Parameters the values of a step."""
        for name, value in step.numbers.items():
            getattr(self.given, name).value = value
        for name, value in step.weights.items():
            self.weight[name].value = np.broadcast_to(value, self.weight[name].shape)

    def rows(self) -> dict[str, tuple]:
        """Block -> slope, lowest and highest value of its rows that are in force; weights' roots multiplied in."""
        self.x.value, out = np.zeros(self.x.size), {}
        free = cp.Constant(np.inf)
        sides = {name: (ZERO, x, ZERO) for name, x in {**self.wishes, **self.equal}.items()}
        sides |= {name: (ZERO, x, free) for name, x in self.above.items()} | self.between
        for name, (low, x, high) in sides.items():
            root = np.sqrt(self.weight[name].value) if name in self.weight else np.ones(x.size)
            slope = root[:, None] * x.grad[self.x].T.toarray()
            used = slope.any(axis=1)
            ends = (np.broadcast_to(root * (side.value - x.value), x.size)[used] for side in (low, high))
            out[name] = slope[used], *ends
        return out


def parameters(numbers: Mapping[str, Any]) -> SimpleNamespace:
    """cvxpy Parameters of the same names and shapes."""
    return SimpleNamespace(**{name: cp.Parameter(np.shape(value), name=name) for name, value in numbers.items()})


def shared_numbers(terms: FullTerms, wish: Any, qp: Any, state: State, step_s: float) -> dict[str, Any]:
    """Numbers for the programs of both phases: quantities, aims of joints and trunk, limits of the joints.

    Parameters
    ----------
    terms : in the middle of the step.  wish : with ``joints``, ``trunk``, ``symmetry``.  state : at its start.
    """
    out = {name: getattr(terms, name) for name in QUANTITIES}
    out |= {name: getattr(wish, name) for name in ("joints", "trunk", "symmetry")}
    out["tau_min"], out["tau_max"] = qp.body.motors.range(terms.v[6:])
    out["acc_min"], out["acc_max"] = qp.joint_range(state.q[7:], state.v[6:], step_s)
    return out


def alone(mapper: JointMapper, qp: Any, k: int, plan: JointPlan) -> tuple[FullTerms, Qp, np.ndarray]:
    """Step ``k`` of a phase of ``plan`` again: quantities in its middle, its program, the library's optimum."""
    terms, _, program = mapper.step(qp, k, plan.state(plan.rows(qp.phase.name).start + k))
    return terms, program, QpSolver().solve(program).x


def against_library(it: Written, mapper: JointMapper, plan: JointPlan) -> tuple[list[dict], list[dict]]:
    """Rows and optima of a written program beside those of the library.

    Returns
    -------
    By block, the largest difference of its rows over all steps, relative; by step, what Clarabel makes of the written
    program against the optimum of the library's own solver. ``bound`` is what a duality gap of Clarabel's
    tolerance leaves open of the unknowns, by the least eigenvalue of the Hessian on the null space of E.
    """
    gaps = {name: 0.0 for part in (it.wishes, it.equal, it.above, it.between) for name in part}
    rows = plan.rows(it.qp.phase.name)
    optima, sizes, contact = [], dict.fromkeys(gaps, 0), plan.contact[rows]
    for step in it.steps:
        it.fill(step)
        it.problem.solve(solver=cp.CLARABEL, enforce_dpp=True, **CLARABEL)
        found = it.x.value, it.problem.value
        _, program, best = alone(mapper, it.qp, step.k, plan)
        known = program.costs | program.equalities | program.limits
        for name, own in it.rows().items():
            theirs = _in_force(known[name])
            sizes[name] = max(sizes[name], len(own[0]))
            for mine, other in zip(own, theirs, strict=True):
                ends = np.isfinite(other)
                assert np.array_equal(ends, np.isfinite(mine)), name
                off = np.abs(mine[ends] - other[ends]) / max(1.0, np.abs(other[ends]).max(initial=0.0))
                gaps[name] = max(gaps[name], float(off.max(initial=0.0)))
        seen = {"t [s]": plan.t[rows][step.k], "contact": contact[step.k], "status": it.problem.status}
        optima.append(seen | _apart(program, best, *found, it.qp.first))
    blocks = [{"phase": it.qp.phase.name, "block": x, "rows": sizes[x], "difference": gap} for x, gap in gaps.items()]
    return blocks, optima


def _in_force(block: Block) -> tuple[np.ndarray, ...]:
    """Slope, lowest and highest value of a library's block of rows that are limited, weights' roots multiplied in."""
    root = np.ones(len(block.low)) if block.weight is None else np.sqrt(block.weight)
    used = np.isfinite(block.low) | np.isfinite(block.high)
    return root[used, None] * block.matrix[used], (root * block.low)[used], (root * block.high)[used]


def _apart(qp: Qp, best: np.ndarray, x: np.ndarray, cost: float, first: int) -> dict[str, float | None]:
    """Distances of ``x`` and its cost from the optimum ``best``; accelerations begin at column ``first``."""
    A, b, E, *_ = wide(qp)
    cheapest = np.sum((A @ best - b) ** 2) / 2
    free, scale, off = A @ null_space(E), max(1.0, cheapest), 1e6 * np.abs(x - best)
    flattest = np.linalg.eigvalsh(free.T @ free)[0]
    return {
        "largest force [N]": np.abs(best[:first]).max() if first else None,
        "force, difference [µN, µN m]": off[:first].max() if first else None,
        "largest acceleration [rad/s²]": np.abs(best[first:]).max(),
        "acceleration, difference [µrad/s²]": off[first:].max(),
        "cost, difference [1e-6]": 1e6 * abs(cost - cheapest) / scale,
        "bound [SI/1000]": 1e3 * np.sqrt(2 * CLARABEL["tol_gap_rel"] * scale / flattest),
    }


# ------------------------------------------------------------------------- one thing changed at a time


def weights_tried(srmp: SrmpPlan, robot: Robot, phase: str, name: str, values: Sequence[float]) -> list[dict]:
    """Errors against stage 1, and joint speeds of the launch, by the weight of one aim."""
    top, rows = np.array([robot.actuators[joint]["speed"] for joint in robot.joint_names]), []
    for value in values:
        options = Options(**{phase: replace(getattr(Options(), phase), **{name: value})})
        plan = map_to_joints(srmp, robot, options=options)
        e, share = tracking(plan, srmp, robot), (np.abs(plan.v[plan.rows("launch"), 6:]) / top).max(axis=0)
        row = {"weight": f"{value:g}", "take-off speed [%]": 100 * e["takeoff_velocity"]}
        row |= {f"rho in {x}, rms [%]": 100 * e[f"{x}_inertia_rms"] for x in ("launch", "flight")}
        row |= {"sole to CoM, rms [mm]": 1000 * e["flight_foot_rms"], "at touchdown [mm]": 1000 * e["touchdown_foot"]}
        row["fastest joint of the launch"] = robot.joint_names[int(share.argmax())].removeprefix("left_")
        rows.append({**row, "of its limit [%]": 100 * share.max()})
    return rows


# the CoM at 20 rad/s and no stronger forwards, L and inertia weaker: follows stage 1 less closely
GENTLE = Options(
    gains=Gains(com=Gain(400.0, 40.0)),
    launch=LaunchWeights(
        com=3.0,
        force=3e-3,
        com_x=3.0,
        force_x=3e-3,
        moment=1.0,
        inertia=3e-3,
        inertia_toe=6e-5,
        inertia_fade_s=0.01,
    ),
)
CHOICES: dict[str, dict[str, Any]] = {
    "as planned": {},
    "steps of 10 ms, as in this notebook": {"step_s": 0.01},
    "arms towards the stance": {"options": Options(arm_rad=0.0)},
    "gentle weights": {"options": GENTLE},
}


def choices_tried(task: JumpTask, srmp: SrmpPlan, robot: Robot, names: Iterable[str] = CHOICES) -> list[dict]:
    """Stage 2 with ``names`` of :data:`CHOICES`, one changed at a time: tracking, and where stage 3 ends from there."""
    whole, rows = WholeBodyPlanner(robot, tracking=True), []
    for name in names:
        plan = map_to_joints(srmp, robot, **{"step_s": STEPS_S, **CHOICES[name]})
        led = whole.plan(task, srmp, begin=motion_of_joints(plan, whole, srmp.toe_s))
        e, row = tracking(plan, srmp, robot), {"choice": name, "steps": plan.statistics.steps}
        row |= {"take-off speed [%]": 100 * e["takeoff_velocity"], "L at take-off [%]": 100 * e["takeoff_momentum"]}
        row |= {f"rho in {x} [%]": 100 * e[f"{x}_inertia_rms"] for x in ("launch", "flight")}
        row |= {"stage 3, iterations": sum(x.iterations for x in led.attempts)}
        rows.append({**row, "stage 3, cost": led.solution.statistics.objective})
    return rows
