"""The paper's remark that a missed target "can be solved by adding bias to the optimisation's goal" (Sec. VI-B)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from jumplab.errors import InfeasibleError, InputError
from jumplab.sim import Perturbation, Scene, SimulationResult, simulate_jump
from jumplab.stages.planner import JumpPlan, Planner
from jumplab.task import JumpTask

TOLERANCE = 0.02  # share of the goal
LEAST_TOLERANCE_M = 0.005  # where 2 % of the goal is less, as in a jump on the spot
TRIES = 6  # "a few jumps"; the correction usually needs two or three


@dataclass(frozen=True)
class BiasedJump:
    """One jump on the way to the goal.

    Attributes
    ----------
    target : what was planned.
    distance_m, rise_m : what the simulated robot did; the distance of a jump that fell is that at touchdown.
    distance_error_m, rise_error_m : the same minus the goal.
    landed, reason : the verdict, and why.
    hit : landed, with both errors within the tolerance.
    """

    target: JumpTask
    distance_m: float
    rise_m: float
    distance_error_m: float
    rise_error_m: float
    landed: bool
    reason: str
    hit: bool


@dataclass(frozen=True)
class GoalBias:
    """A goal that has been reached.

    Attributes
    ----------
    goal : what was wished.
    jumps : all jumps, the last of which hit it.
    plan, result : of the last jump.
    """

    goal: JumpTask
    jumps: tuple[BiasedJump, ...]
    plan: JumpPlan
    result: SimulationResult

    @property
    def bias_m(self) -> tuple[float, float]:
        """What had to be added to the goal: distance, height [m]."""
        target = self.jumps[-1].target
        return target.distance_m - self.goal.distance_m, target.height_m - self.goal.height_m


def reach_goal(
    goal: JumpTask,
    planner: Planner,
    *,
    perturbation: Perturbation | None = None,
    mode: str = "position",
    reaim: bool = False,
    method: str = "three-step",
    tolerance: float = TOLERANCE,
    tries: int = TRIES,
    simulate: Callable[..., SimulationResult] = simulate_jump,
) -> GoalBias:
    """Jump, see by how much the goal was missed, shift the target by that, and jump again.

    A metre more in the target is taken for a metre more in the jump. The ground is always that of the goal: a platform
    does not move with the target.

    Parameters
    ----------
    goal : what distance and rise of the simulated jump shall be.
    planner : of the robot as it is believed to be; kept for all tries.
    perturbation : how the simulated robot differs from it.
    mode, reaim : see :func:`jumplab.sim.simulate_jump`.
    method : of planning, see :meth:`jumplab.stages.planner.Planner.plan`.
    tolerance : allowed error as a share of the goal [1].
    tries : most jumps, the first of which has no bias.
    simulate : what makes a jump of a tape.

    Raises
    ------
    InputError
        If tolerance or tries cannot be meant, or the goal itself cannot.
    InfeasibleError
        If the goal is not hit within ``tries``, or the biased target cannot be planned, or the feet never come down.
    SolverError
        If a plan fails otherwise.
    """
    if not 0 < tolerance <= 1:
        raise InputError(f"tolerance = {tolerance:g} is outside 0 ... 1; 0.02 is 2 % of the goal")
    if isinstance(tries, bool) or not isinstance(tries, int) or tries < 1:
        raise InputError(f"tries = {tries!r}: must be a whole number, at least 1")
    jumps: list[BiasedJump] = []
    target, scene = goal, None
    for _ in range(tries):
        plan = _plan(planner, target, method, jumps)
        scene = scene or Scene.of_plan(plan.summary, planner.robot)
        result = simulate(plan.tape, planner.robot, mode=mode, perturbation=perturbation, scene=scene, reaim=reaim)
        jumps.append(_judge(goal, target, result, tolerance))
        if jumps[-1].hit:
            return GoalBias(goal, tuple(jumps), plan, result)
        target = replace(
            goal,
            distance_m=target.distance_m - jumps[-1].distance_error_m,
            height_m=target.height_m - jumps[-1].rise_error_m,
        )
    raise InfeasibleError(
        f"the goal was not hit within {tries} jumps; {_last(jumps)}; allow more tries, or a larger "
        f"tolerance than {tolerance:.1%}"
    )


def _plan(planner: Planner, target: JumpTask, method: str, jumps: list[BiasedJump]) -> JumpPlan:
    try:
        return planner.plan(target, method)
    except (InputError, InfeasibleError) as e:
        if not jumps:
            raise
        raise InfeasibleError(
            f"the target {target.distance_m:.3f} m with a rise of {target.height_m:.3f} m, which the "
            f"goal's bias asks for, cannot be planned ({e}); {_last(jumps)}"
        ) from e


def _judge(goal: JumpTask, target: JumpTask, result: SimulationResult, tolerance: float) -> BiasedJump:
    m = result.metrics
    distance = m.foot_distance_m if m.landed else m.foot_distance_touchdown_m
    if distance is None or m.com_rise_m is None:
        raise InfeasibleError(f"there is no error to correct: planned for {target.distance_m:.3f} m, {m.reason}")
    errors = distance - goal.distance_m, m.com_rise_m - goal.height_m
    allowed = (max(tolerance * abs(x), LEAST_TOLERANCE_M) for x in (goal.distance_m, goal.height_m))
    hit = m.landed and all(abs(error) <= most for error, most in zip(errors, allowed, strict=True))
    return BiasedJump(target, distance, m.com_rise_m, *errors, m.landed, m.reason, hit)


def _last(jumps: list[BiasedJump]) -> str:
    j = jumps[-1]
    said = "landed" if j.landed else j.reason
    return (
        f"the last one, planned for {j.target.distance_m:.3f} m and {j.target.height_m:.3f} m, reached "
        f"{j.distance_m:.3f} m and {j.rise_m:.3f} m ({said})"
    )
