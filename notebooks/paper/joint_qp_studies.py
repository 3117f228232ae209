"""What stage 2's notebook measures: its programs in cvxpy against the library's, one weight or choice at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import null_space

from jumplab.models.full import FullTerms
from jumplab.robot import Robot
from jumplab.stages.joint_qp import DirectSolver, JointMapper, JointPlan, Options, map_to_joints
from jumplab.stages.joint_qp.problem import State, StepQp
from jumplab.stages.joint_qp.settings import GENTLE
from jumplab.stages.joint_qp.solve import CLARABEL
from jumplab.stages.planner import STEPS_S, motion_of_joints
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body import WholeBodyPlanner
from jumplab.task import JumpTask

QUANTITIES = ("M", "H", "J", "A_f", "A_c", "B_c", "J_rho", "drift_rho")
ZERO = cp.Constant(0.0)


# ------------------------------------------------------------------------- programs in cvxpy


@dataclass
class Written:
    """The program of one phase as it is written in cvxpy, and the steps at which it is looked at.

    Attributes
    ----------
    qp : the library's programs of that phase.  x : the unknowns.  given : the Parameters.
    wishes : block -> residual.  equal, below : block -> what is 0, or at most 0.
    between : block -> lowest value, expression, highest value.
    steps : with ``k``, ``numbers`` by the names of the Parameters, and ``weights`` by block.
    problem, weight : the program, and the Parameters of its weights by block, once it is put together.
    """

    qp: Any
    x: cp.Variable
    given: SimpleNamespace
    wishes: dict[str, cp.Expression]
    equal: dict[str, cp.Expression]
    below: dict[str, cp.Expression]
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
        """Block -> matrix, slope, lowest and highest value of its rows, as filled; weights' roots multiplied in."""
        self.x.value, out = np.zeros(self.x.size), {}
        written = {"A": self.wishes, "E": self.equal, "G": self.below, "R": self.between}
        for name, matrix, x in ((name, matrix, x) for matrix, part in written.items() for name, x in part.items()):
            low, x, high = x if matrix == "R" else (ZERO, x, ZERO)
            root = np.sqrt(self.weight[name].value) if matrix == "A" else np.ones(x.size)
            slope = root[:, None] * x.grad[self.x].T.toarray()
            out[name] = matrix, slope, root * (low.value - x.value), root * (high.value - x.value)
        return out


def parameters(numbers: Mapping[str, Any]) -> SimpleNamespace:
    """cvxpy Parameters of the same names and shapes."""
    return SimpleNamespace(**{name: cp.Parameter(np.shape(value), name=name) for name, value in numbers.items()})


def shared_numbers(terms: FullTerms, wish: Any, qp: Any, state: State, step_s: float) -> dict[str, Any]:
    """What the programs of both phases need: quantities, wishes of joints and trunk, limits of the joints.

    Parameters
    ----------
    terms : in the middle of the step.  wish : with ``joints``, ``trunk``, ``symmetry``.  state : at its start.
    """
    out = {name: getattr(terms, name) for name in QUANTITIES}
    out |= {name: getattr(wish, name) for name in ("joints", "trunk", "symmetry")}
    out["tau_min"], out["tau_max"] = qp.joints.torque(terms.v[6:])
    out["acc_min"], out["acc_max"] = qp.joints.acceleration(state.q[7:], state.v[6:], step_s)
    return out


def alone(mapper: JointMapper, qp: Any, k: int, plan: JointPlan) -> tuple[FullTerms, StepQp, np.ndarray]:
    """Step ``k`` of a phase of ``plan`` again: quantities in its middle, its program, the direct solver's optimum."""
    row = plan.rows(qp.name).start + k
    terms, _, matrices = mapper.problem(qp, k, plan.state(row))
    return terms, matrices, DirectSolver(matrices).solve(matrices, qp.name, plan.t[row]).x


def against_library(it: Written, mapper: JointMapper, plan: JointPlan) -> tuple[list[dict], list[dict]]:
    """Rows and optima of a written program beside those of the library.

    Returns
    -------
    By block, the largest difference of its rows over all steps, relative; by step, what Clarabel makes of the written
    program against the direct solver's optimum of the library's. ``bound`` is what a duality gap of Clarabel's
    tolerance leaves open of the unknowns, by the least eigenvalue of the Hessian on the null space of E.
    """
    gaps = {name: 0.0 for part in (it.wishes, it.equal, it.below, it.between) for name in part}
    optima, sizes, contact = [], {}, plan.contact[plan.rows(it.qp.name)]
    for step in it.steps:
        it.fill(step)
        it.problem.solve(solver=cp.CLARABEL, enforce_dpp=True, **CLARABEL)
        found = it.x.value, it.problem.value
        _, q, best = alone(mapper, it.qp, step.k, plan)
        theirs = {"A": (q.A, q.b, q.b), "E": (q.E, q.e, q.e), "G": (q.G, q.h, q.h), "R": (q.R, q.lower, q.upper)}
        for name, (matrix, *own) in it.rows().items():
            pairs = [(mine, other[q.layout.at(name)]) for mine, other in zip(own, theirs[matrix], strict=True)]
            sizes[name] = len(own[0])
            gap = max(np.abs(mine - other).max() / max(1.0, np.abs(other).max()) for mine, other in pairs)
            gaps[name] = max(gaps[name], gap)
        seen = {"t [s]": plan.t[plan.rows(it.qp.name)][step.k], "contact": contact[step.k], "status": it.problem.status}
        optima.append(seen | _apart(q, best, *found, it.qp.first))
    blocks = [{"phase": it.qp.name, "block": x, "rows": sizes[x], "difference": gap} for x, gap in gaps.items()]
    return blocks, optima


def _apart(q: StepQp, best: np.ndarray, x: np.ndarray, cost: float, first: int) -> dict[str, float | None]:
    """How far ``x`` and its cost are from the optimum ``best``; accelerations begin at column ``first``."""
    free, scale, off = q.A @ null_space(q.E), max(1.0, q.objective(best)), 1e6 * np.abs(x - best)
    flattest = np.linalg.eigvalsh(free.T @ free)[0]
    return {
        "largest force [N]": np.abs(best[:first]).max() if first else None,
        "force, difference [µN, µN m]": off[:first].max() if first else None,
        "largest acceleration [rad/s²]": np.abs(best[first:]).max(),
        "acceleration, difference [µrad/s²]": off[first:].max(),
        "cost, difference [1e-6]": 1e6 * abs(cost - q.objective(best)) / scale,
        "bound [SI/1000]": 1e3 * np.sqrt(2 * CLARABEL["tol_gap_rel"] * scale / flattest),
    }


# ------------------------------------------------------------------------- one thing changed at a time


def weights_tried(srmp: SrmpPlan, robot: Robot, phase: str, name: str, values: Sequence[float]) -> list[dict]:
    """How well stage 1 is followed, and what the launch takes of the joints' speeds, by the weight of one wish."""
    top, rows = np.array([robot.actuators[joint]["speed"] for joint in robot.joint_names]), []
    for value in values:
        options = Options(**{phase: replace(getattr(Options(), phase), **{name: value})})
        plan = map_to_joints(srmp, robot, method="direct", options=options)
        e, share = plan.tracking, (np.abs(plan.v[plan.rows("launch"), 6:]) / top).max(axis=0)
        row = {"weight": f"{value:g}", "take-off speed [%]": 100 * e["takeoff_velocity"]}
        row |= {f"rho in {x}, rms [%]": 100 * e[f"{x}_inertia_rms"] for x in ("launch", "flight")}
        row |= {"sole to CoM, rms [mm]": 1000 * e["flight_foot_rms"], "at touchdown [mm]": 1000 * e["touchdown_foot"]}
        row["fastest joint of the launch"] = robot.joint_names[int(share.argmax())].removeprefix("left_")
        rows.append({**row, "of its limit [%]": 100 * share.max()})
    return rows


def choices_tried(task: JumpTask, srmp: SrmpPlan, robot: Robot) -> list[dict]:
    """Stage 2 as the planner runs it and with one choice changed: tracking, and where stage 3 ends from there."""
    whole, rows = WholeBodyPlanner(robot, tracking=True), []
    choices: dict[str, dict[str, Any]] = {
        "as planned": {},
        "steps of 10 ms, as in this notebook": {"step_s": 0.01},
        "arms towards the stance": {"options": Options(arm_rad=0.0)},
        "gentle weights": {"options": GENTLE},
    }
    for name, how in choices.items():
        plan = map_to_joints(srmp, robot, method="direct", **{"step_s": STEPS_S, **how})
        led = whole.plan(task, srmp, begin=motion_of_joints(plan, whole, srmp.toe_s))
        row = {"choice": name, "steps": plan.statistics.steps}
        row |= {"take-off speed [%]": 100 * plan.tracking["takeoff_velocity"]}
        row |= {"L at take-off [%]": 100 * plan.tracking["takeoff_momentum"]}
        row |= {f"rho in {x} [%]": 100 * plan.tracking[f"{x}_inertia_rms"] for x in ("launch", "flight")}
        row |= {"stage 3, iterations": sum(x.iterations for x in led.attempts)}
        rows.append({**row, "stage 3, cost": led.solution.statistics.objective})
    return rows
