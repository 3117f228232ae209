"""The front door's functions: each takes what the one before returned. ``import jumplab as jl`` has
them all.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jumplab.arguments import checked
from jumplab.control import STAND_S
from jumplab.errors import InputError
from jumplab.io import folder as folders
from jumplab.ocp import Term, cache
from jumplab.ocp.nlp import patience
from jumplab.robot import Robot
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import USUAL, Planner
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.stages.whole_body import Contacts
from jumplab.stages.whole_body.settings import Limits, Mesh
from jumplab.task import JumpTask

if TYPE_CHECKING:  # what only some of the functions need is imported by them
    from jumplab.auditing import AuditReport
    from jumplab.show.viewer import Page
    from jumplab.sim import Perturbation, Ranges, Scene, SimulationResult
    from jumplab.studies.atlas import Atlas

# processor time [s] for a target, of each start that is compared; and for a schedule, a program of
# up to twice the phases that is solved again with rows for links that met: hops, leaps and hurdles
# take 14 to 22 s on a busy core, and took 33 s on one
USUAL_S = 20.0
SCHEDULE_S = 40.0
ROBUST_S = 120.0  # the trees of a dozen robots take up to a minute to build


class Saved(NamedTuple):
    """Content of a result folder."""

    plan: JumpPlan  # results of its stages are not on file
    run: SimulationResult | None  # its simulation, if there is one


@checked
def plan(
    task: JumpTask | None = None,
    robot: Robot | str | Path = "bhr",
    *,
    contacts: Contacts | str | None = None,
    like: Any = None,
    method: str = USUAL,
    robust: Ranges | None = None,
    patience_s: float | None = None,
    starts: int = 1,
    terms: Mapping[str, Iterable[Term]] | None = None,
    weights: Mapping[str, float] | None = None,
    off: Iterable[str] = (),
    limits: Limits | Mapping[str, Any] | None = None,
    settings: SrmpSettings | Mapping[str, Any] | None = None,
    mesh: Mesh | Mapping[str, int] | None = None,
    atlas: Atlas | None = None,
) -> JumpPlan:
    """Plan one jump, by one optimisation or by the paper's three (Sec. III to V), then the 1 kHz
    tape.

    A plan that fails its audit, or lands too fast to be caught, is returned with a warning that
    says so, as its ``audit`` and its card do.

    Parameters
    ----------
    task : what to reach, from a stand, or by the steps and feet that it names; or else
    contacts : a schedule of what is on the ground when and where: a hop, a run-up, a leap, one of
        your own; or the words of :meth:`Contacts.named`, such as "hop=0.2". It is planned by the
        whole-body program, and audited foot by foot.
    like : a clip whose style the jump follows, as :func:`jumplab.judge` takes or returns it, with
        one flight off both feet and down on both, on level ground.
    robot : who jumps, or what :meth:`Robot.load` takes: a name, a TOML, a URDF.
    method : "direct" (the whole body alone) or, for targets in the plane, "three-step" (SRMP,
        joint-space QPs, whole body: what the paper does). The default is "direct", but "three-step"
        where stages 1 or 2, or stage 3's tracking, are changed.
    robust : ranges of the perturbed robots that the plan allows for, such as
        ``jumplab.sim.Ranges()``, see :mod:`jumplab.studies.robust`.
    patience_s : processor time after which planning ends, with the best that was found or a refusal
        [s]; an easier target is looked for in what is left of it, and a tenth more. By default 20 a
        start, 40 for a schedule or a jump like a clip, and 120 for a robust plan.
    starts : how many starts are tried to the end, of which the cheapest plan counts; its
        ``attempts`` say how the others differ. See :meth:`jumplab.Planner.plan`.
    terms, weights, off, limits, settings, mesh, atlas : as of :class:`jumplab.Planner`, which plans
        many targets with them.

    Raises
    ------
    InputError, InfeasibleError, SolverError
        If a stage refuses the target or finds no motion; the sentence says which, names a record
        that was sought and is near, and ends with an easier target that has a plan, if one was
        found. "Impossible" is a target beyond what any motion reaches (notebook 15).
    """
    from jumplab.studies.advice import plan_or_advise

    robot = robot if isinstance(robot, Robot) else Robot.load(robot)
    changes = dict(terms=terms, weights=weights, off=off, limits=limits, settings=settings)
    changes |= dict(mesh=mesh, atlas=atlas)
    if (task is None) == (contacts is None):
        raise InputError(
            "give either a target, JumpTask(...), or a contact schedule, contacts=Contacts.hop(...)"
        )
    along = contacts is not None or like is not None
    steps = task is not None and not task.standing
    if steps and (like is not None or robust is not None):
        raise InputError(
            "takeoff, landing and run_up: a jump like a clip, or one that allows for other robots, "
            "is from a stand; leave them out, or like and robust"
        )
    if patience_s is None:
        once = ROBUST_S if robust is not None else USUAL_S
        patience_s = SCHEDULE_S if along or steps else starts * once
    if along:
        alone = robust is None and method == USUAL and starts == 1
        if not (alone and (contacts is None or like is None)):
            raise InputError(
                "a contact schedule, or a jump like a clip, is planned by the whole-body program: "
                "give only one of contacts and like, and leave out method, robust and starts"
            )
        with patience(patience_s):
            jump = _followed(task, robot, contacts, like, changes)
    else:
        if robust is not None:
            from jumplab.studies.robust import robust_changes

            changes = robust_changes(task, robot, robust, changes)
        planner = Planner(robot, keep=True, **changes)
        jump = plan_or_advise(planner, task, method, patience_s, starts)
    if not jump.audit.sound:
        warnings.warn(f"the plan is returned although it has faults: {jump.verdict}", stacklevel=3)
    return jump


def _followed(
    task: JumpTask | None,
    robot: Robot,
    contacts: Contacts | str | None,
    like: Any,
    changes: dict[str, Any],
) -> JumpPlan:
    """Along a contact schedule, or that of a clip."""
    if like is not None:
        from jumplab.studies.mend import like as alike

        return alike(task, like, robot, **changes)
    if isinstance(contacts, str):
        contacts = Contacts.named(contacts, robot)
    return Planner(robot, keep=True, **changes).follow(contacts)


@checked
def audit(plan: JumpPlan) -> AuditReport:
    """Check a plan by an independent implementation, which sees its tape, its robot and its target,
    and nothing of the planner. Returns :attr:`jumplab.JumpPlan.audit`, which is computed once.
    """
    return plan.audit


@checked
def simulate(
    plan: JumpPlan,
    *,
    mode: str = "position",
    engine: str | None = None,
    contact: Any = "hard",
    perturbation: Perturbation | None = None,
    scene: Scene | None = None,
    feedback: bool | None = None,
    reaim: bool = False,
    step: bool = False,
    landing: str = "planned",
    stand_s: float = STAND_S,
) -> SimulationResult:
    """Play a plan on a simulated robot, catch it, and watch it stand.

    Parameters
    ----------
    mode : what drives track until touchdown: "position", "pd" or "whole-body" (notebook 05).
    engine : "bullet" or "mujoco"; the default is the first that is installed.
    contact : "hard", as plans assume, or "usual", the engine's own defaults.
    perturbation : how the robot differs from its model; None simulates it as planned.
    scene : the ground; None is the one that the plan was made for.
    feedback : whether the launch corrects CoM and angular momentum; None: where one foot carries.
    reaim : whether the legs turn in the air to where they can catch the robot.
    step : whether a foot may step once if the robot would come to rest beyond both soles.
    landing : "planned" or "spring", what the landing controller follows.
    stand_s : how long to watch after the last touchdown [s]; less than the default is no landing.

    Returns
    -------
    SimulationResult
        Also of a jump that fails: see its ``landed`` and ``reason``.
    """
    from jumplab.sim import DEFAULT_ENGINE, Scene, simulate_jump

    run = simulate_jump(
        plan.tape,
        plan.robot,
        perturbation=perturbation,
        scene=scene or Scene.of_plan(plan.summary, plan.robot),
        stand_s=stand_s,
        engine=engine or DEFAULT_ENGINE,
        contact=contact,
        mode=mode,
        reaim=reaim,
        step=step,
        feedback=feedback,
        landing=landing,
    )
    plan.landings.append(run.landed)
    return run


@checked
def save(folder: str | Path, plan: JumpPlan, run: SimulationResult | None = None) -> AuditReport:
    """Write a plan, its audit and its simulation (if given) into a result folder, whole or not at
    all; returns the audit.
    """
    from jumplab.auditing import write_audit

    summary = {**plan.summary, "audit": plan.audit.line()}
    report = folders.write_plan(folder, plan.tape, plan.robot, summary, complete=write_audit)
    if run is not None:
        folders.write_simulation(folder, run, folders.read_plan(folder)[2])
    return report


@checked
def load(folder: str | Path) -> Saved:
    """Read a result folder: ``plan, run = jl.load("out")``; raises :class:`InputError` if there is
    no sound plan.
    """
    from jumplab.sim import SimulationResult

    tape, robot, summary = folders.read_plan(folder)
    plan = JumpPlan.on_file(tape, robot, summary)
    run = SimulationResult.load(folder, robot)
    if run is not None:
        plan.landings.append(run.landed)
    return Saved(plan, run)


@checked
def view(plan: JumpPlan, run: SimulationResult | None = None) -> Page:
    """Make a 3-D page of the jump, plan and simulation. A notebook shows the page; a script prints
    its path. ``view(...).save("jump.html")`` writes it to another file.
    """
    from jumplab.show.viewer import page
    from jumplab.sim import Scene

    scene = Scene.of_plan(plan.summary, plan.robot)
    jump_page = page(plan.robot, plan=plan.tape, simulation=run, task=plan.task, scene=scene)
    if _in_script():
        place = cache.folder() or Path(tempfile.mkdtemp(prefix="jumplab-"))
        print(f"the jump in 3-D, for any browser: {jump_page.save(place / 'jump.html')}")
    return jump_page


def _in_script() -> bool:
    """Whether Python runs a file as a program: then the value of an expression is not displayed."""
    main = sys.modules.get("__main__")
    return main.__spec__ is None and hasattr(main, "__file__") and "get_ipython" not in vars(main)
