"""The paper's claims, judged: the four verdicts, measurements that need more than a line, and the table of readings."""

from __future__ import annotations

import itertools
import json
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import coal  # noqa: F401  (its shapes are what Pinocchio's geometry objects hold)
import numpy as np
import pinocchio as pin
from scipy.stats import qmc

from jumplab.errors import InputError, JumplabError, SolverError, as_path, quoted, require_type
from jumplab.io.tape import Tape
from jumplab.models.full import FullBody
from jumplab.robot import SAGITTAL_JOINTS, Robot
from jumplab.robot.stance import stance_angles
from jumplab.sim import STEP_S, SimulationResult
from jumplab.stages.joint_qp import JointPlan, map_to_joints
from jumplab.stages.plan import JumpPlan
from jumplab.stages.planner import STEPS_S, motion_of_joints
from jumplab.stages.reconstruction import to_link_angles
from jumplab.stages.srmp import SrmpPlan, SrmpPlanner
from jumplab.stages.whole_body import Mesh, WholeBodyPlan, WholeBodyPlanner
from jumplab.stages.whole_body.motions import Motion
from jumplab.task import GRAVITY, JumpTask
from paper.expansion import expand
from paper.planar import planar_quantities

HOLDS, CHANGED, FAILS, OPEN = "holds", "holds with a change", "does not hold", "open: cannot be checked here"
ADOPTED = "adopted: ours by construction"
INF = np.inf
STARTS = ("crouch", "stage 2", "looser stage 3")
LOOSE_MESH = Mesh(6, 4, 6)  # half of stage 3's mesh ...
LOOSE_TOLERANCE = {"tol": 1e-2, "constr_viol_tol": 5e-5}  # ... and tolerances that leave millimetres open
SAME_COST = 1.01  # more than this times the least cost known is another jump
FIRST_S, LAST_S, STEADY_S = 0.1, 0.05, 0.02  # of the launch: where it begins, ends; over which peaks of contacts pass
SWING = 0.01  # of the peak of L: less is not seen in a figure of it
READINGS = ("the paper says", "we do", "because", "effect")
HEADING = "## Differences from the paper"


# ---------------------------------------------------------------------------------------------- verdicts


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper, and what decides it.

    Attributes
    ----------
    sentence : what is said, in our words.
    where : notebook that shows it at length.
    limits : what is measured, with its unit -> least and most for which the claim holds; None if nothing here can
    measure it.
    adopted : whether the measurement reads back what was built so; it can fail, but proves nothing of the paper.
    """

    sentence: str
    where: str
    limits: Mapping[str, tuple[float, float]] | None
    adopted: bool = False

    @property
    def words(self) -> str:
        """The limits in words."""
        return "; ".join(f"{name} {_range(*ends)}" for name, ends in (self.limits or {}).items()) or "none"


def _range(least: float, most: float) -> str:
    if least == most:
        return f"= {least:g}"
    if np.isinf(most):
        return f"≥ {least:g}"
    return f"≤ {most:g}" if least in (0, -INF) else f"{least:g} … {most:g}"


# in the order of the paper
CLAIMS = {
    "jumps": Claim(
        "The robot jumps more than a metre forward, and in another jump onto half a metre.",
        "06_experiments",
        {"toe to toe [m]": (1.0, INF), "CoM up on the platform [m]": (0.48, 0.52), "jumps that stand": (2, 2)},
    ),
    "time": Claim(
        "All optimisations together take about ten seconds, or less.",
        "00_overview",
        {"slowest plan [CPU s]": (0, 10)},
    ),
    "chain": Claim(
        "Three optimisations in a chain, each with its own model.",
        "04_whole_body",
        {"stages that solve": (3, 3), "coordinates of 1": (4, 4), "of 2": (20, 20), "of 3": (7, 7)},
        adopted=True,
    ),
    "size": Claim(
        "The robot is about 1.5 m high, weighs 42 kg and has 14 joints.",
        "01_models",
        {"height [m]": (1.45, 1.55), "mass [kg]": (41.5, 42.5), "joints": (14, 14)},
        adopted=True,
    ),
    "links": Claim(
        "Nine links, 20 degrees of freedom: six of the base, per side one shoulder, three hip, one knee, two ankle.",
        "01_models",
        {"links": (9, 9), "degrees of freedom": (20, 20), "shoulder": (2, 2), "hip": (6, 6), "knee": (2, 2),
         "ankle": (4, 4)},
        adopted=True,
    ),
    "five links": Claim(
        "Five links in the sagittal plane stand for nine when both sides move alike; a leg carries the mass of two.",
        "01_models",
        {"largest difference [SI]": (0, 1e-9)},
    ),
    "wrenches": Claim(
        "The ground acts on the nine links by twelve numbers, a force and a torque per foot.",
        "03_joint_space_mapping",
        {"rows of the contact Jacobian": (12, 12)},
        adopted=True,
    ),
    "gravity": Claim(
        "Gravity is 9.8 m/s².",
        "01_models",
        {"least [m/s²]": (9.8, 9.8), "most [m/s²]": (9.8, 9.8)},
        adopted=True,
    ),
    "ballistics": Claim(
        "Take-off speed and time in the air follow from the rise alone.",
        "02_srmp",
        {"speed off the rule [m/s]": (0, 0.03), "time off the rule [s]": (0, 0.05)},
    ),
    "sensors": Claim(
        "A control cycle of 1 ms, a gyroscope up to 250 deg/s and an accelerometer up to 8 g serve the jump.",
        "05_simulation",
        {"cycle [ms]": (1, 1), "turning [deg/s]": (0, 250), "acceleration over 20 ms [g]": (0, 8)},
    ),
    "open loop": Claim(
        "Launch and flight are played in position mode without any correction; a controller in torque mode lands.",
        "05_simulation",
        {"stands": (1, 1), "checks failed": (0, 0), "mode position": (1, 1), "corrections switched on": (0, 0)},
    ),
    "differs": Claim(
        "The simulated robot differs a little from the planned one, and misses a little.",
        "05_simulation",
        {"robots": (20, INF), "miss of the distance, median [mm]": (1, 50), "share that lands": (0.9, 1)},
    ),
    "bias": Claim(
        "A bias on the goal removes that error.",
        "06_experiments",
        {"robots": (20, INF), "share that hits the goal": (0.9, 1)},
    ),
    "guess": Claim(
        "Stage 2's motion as a guess speeds stage 3 up, more efficiently than a looser stage 3 would.",
        "03_joint_space_mapping",
        {"targets": (24, INF), "time, all counted, of the crouch's": (0, 0.95), "of the looser stage 3's": (0, 0.95)},
    ),
    "tracks": Claim(
        "The whole body precisely tracks the trajectory of the angular momentum.",
        "04_whole_body",
        {"L off, rms, share of its peak": (0, 0.1)},
    ),
    "bows": Claim(
        "The trunk first bends forward and then accelerates, in the plan of stage 1 as in simulation.",
        "02_srmp",
        {"stage 1 [deg]": (3, INF), "simulation [deg]": (3, INF)},
    ),
    "shapes": Claim(
        "In flight legs and arms are drawn in to shape the inertia, and the feet swing to where they land.",
        "05_simulation",
        {"least rho of that at lift-off": (0, 0.95), "change by the legs [kg m²]": (-INF, -0.01),
         "by the arms [kg m²]": (-INF, -0.01), "soles ahead of the CoM [m]": (0.01, INF)},
    ),
    "vibrates": Claim(
        "Angular momentum vibrates when the launch begins and then follows its reference.",
        "05_simulation",
        {"swings at first": (3, INF), "swings later": (0, 0), "off later, rms, share of the peak": (0, 0.05)},
    ),
    "hardware": Claim(
        "A robot that is not its model misses height and angular momentum, and reaches its target all the same.",
        "06_experiments",
        None,
    ),
    "flip": Claim(
        "A target angle of a full turn gives a backflip; jumps to the side and in a row are left to later work.",
        "02_srmp",
        {"turn of stage 1 off [rad]": (0, 0.3)},
        adopted=True,
    ),
    "posture": Claim(
        "Stage 2 leaves an unexpected posture at touchdown, which does no harm.",
        "03_joint_space_mapping",
        {"posture off [deg]": (20, INF), "checks failed": (0, 0), "costlier targets": (0, 0)},
    ),
}  # fmt: skip


def judge(name: str, measured: str, values: Mapping[str, float] | None = None, change: str = "") -> dict[str, str]:
    """One line of the table of claims.

    Parameters
    ----------
    name : of :data:`CLAIMS`.
    measured : the numbers in words, with units.
    values : what was measured, by the names of the claim's limits; not a number keeps no limit.
    change : what was read, done or found differently, where that is part of the verdict.

    Raises
    ------
    InputError
        If there is no such claim, the text is empty, or the values are not those of the limits.
    """
    if name not in CLAIMS:
        raise InputError(f"there is no claim {quoted(name)}; choose from {', '.join(CLAIMS)}")
    if not (isinstance(measured, str) and measured.strip()):
        raise InputError(f"measured of a claim must be a text, got {quoted(measured)}; say what was measured")
    claim, values = CLAIMS[name], values or {}
    limits = claim.limits or {}
    if set(values) != set(limits):
        raise InputError(f"claim {name!r}: measured are {', '.join(values) or 'no values'}; it needs {claim.words}")
    ok = all(least <= values[key] <= most for key, (least, most) in limits.items())
    agreed = ADOPTED if claim.adopted else CHANGED if change else HOLDS
    verdict = OPEN if claim.limits is None else agreed if ok else FAILS
    row = {"claim": claim.sentence, "verdict": verdict, "holds if": claim.words, "measured": measured}
    return row | {"change": change, "where": claim.where}


class Verdicts(list):
    """Lines of the table of claims, in their order."""

    def add(self, *claim: Any, **more: Any) -> None:
        """One more, see :func:`judge`."""
        self.append(judge(*claim, **more))


# ---------------------------------------------------------------------------------------------- measurements


def standing_height_m(robot: Robot) -> float:
    """Height of the robot's collision shapes with all joints at zero, legs straight [m] (Sec. VI-A)."""
    require_type(robot, Robot, "the robot")
    shapes = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.COLLISION)
    data, places = robot.model.createData(), shapes.createData()
    pin.updateGeometryPlacements(robot.model, data, shapes, places, pin.neutral(robot.model))
    low, high = np.inf, -np.inf
    for shape, place in zip(shapes.geometryObjects, places.oMg, strict=True):
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        corners = np.array(list(itertools.product(*zip(box.min_, box.max_, strict=True))))  # (8, 3)
        z = corners @ place.rotation[2] + place.translation[2]
        low, high = min(low, z.min()), max(high, z.max())
    return float(high - low)


def five_against_nine(robot: Robot, samples: int = 20, seed: int = 0) -> dict[str, float]:
    """Largest differences of the five-link from the nine-link model over random symmetric motions (Sec. II-C).

    Returns
    -------
    mass [kg], CoM [m], L [kg m^2/s], rho [kg m^2] -> largest difference.
    """
    require_type(robot, Robot, "the robot")
    random = np.random.default_rng(seed)
    angles = random.uniform([0.0, -0.2, -1.2, -0.2, -2.0], [0.6, 1.2, 0.6, 0.9, 1.0], (samples, 5))
    rates, accels = random.normal(0, 4, (samples, 5)), random.normal(0, 40, (samples, 5))
    rest = np.zeros((samples, 2))
    motion = dict.fromkeys(("toe", "toe_velocity", "toe_acceleration"), rest)
    motion |= dict(t=np.arange(samples) / 1000, angles=angles, rates=rates, accels=accels)
    motion["flying"] = np.zeros(samples, bool)
    tape = expand(motion, robot, GRAVITY)
    five = planar_quantities(robot, angles, rates, accels, rest, GRAVITY)
    body = FullBody(robot)
    nine = [body.terms(q, v) for q, v in zip(tape.q, tape.v, strict=True)]
    com = five["com"] - robot.sagittal.sole_center  # the tape's world starts at the middle of the sole
    return {
        "mass [kg]": abs(robot.sagittal.total_mass - body.mass),
        "CoM [m]": float(np.abs(com - [n.com[[0, 2]] for n in nine]).max()),
        "L [kg m^2/s]": float(np.abs(five["L"] - [n.momentum[4] for n in nine]).max()),
        "rho [kg m^2]": float(np.abs(five["rho"] - [n.rho for n in nine]).max()),
    }


@dataclass(frozen=True)
class Start:
    """Stage 3 from one start, at one target.

    Attributes
    ----------
    task, start : the target, and one of :data:`STARTS`; "crouch" is the planner's own, by inverse kinematics along the
        contacts.
    iterations : of stage 3, in all its attempts; None if it failed.
    alone_s, total_s : processor time of stage 3's solves, and with that of making the start [s]; None if it failed.
    cost : of the jump it ends in [1]; None if it failed.
    """

    task: JumpTask
    start: str
    iterations: int | None = None
    alone_s: float | None = None
    total_s: float | None = None
    cost: float | None = None


def spread_targets(number: int) -> list[JumpTask]:
    """Targets spread evenly over distances of 0.1 to 1 m and rises of 0.2 to 0.5 m, to a millimetre."""
    spread = [0.1, 0.2] + qmc.Halton(2, scramble=False).random(number + 1)[1:] * [0.9, 0.3]
    return [JumpTask(round(x, 3), round(z, 3)) for x, z in spread]


def compare_starts(tasks: Iterable[JumpTask], robot: Robot, starts: Sequence[str] = STARTS) -> list[Start]:
    """Stage 3 from a crouch, from stage 2's motion, and from a looser stage 3 (end of Sec. V).

    Returns
    -------
    Per target one row for each of ``starts``. Stages 1 to 3 are built once, and not counted.

    Raises
    ------
    InputError, InfeasibleError, SolverError
        If stage 1 refuses a target; what fails later is a row without numbers.
    """
    stage1, whole = SrmpPlanner(robot), WholeBodyPlanner(robot, tracking=True)
    loose = WholeBodyPlanner(robot, LOOSE_MESH, options=LOOSE_TOLERANCE, tracking=True)
    rows = []
    for task in tasks:
        first = stage1.plan(task)
        for name in starts:
            try:
                rows.append(_from_start(name, task, first, whole, loose))
            except JumplabError:
                rows.append(Start(task, name))
    return rows


def _from_start(name: str, task: JumpTask, first: SrmpPlan, whole: WholeBodyPlanner, loose: WholeBodyPlanner) -> Start:
    began, loose_s = time.process_time(), 0.0
    begin = None
    if name == "stage 2":
        begin = motion_of_joints(_mapped(first, whole.robot.under_gravity(task.gravity)), whole, first.toe_s)
    making_s = time.process_time() - began
    if name == "looser stage 3":
        plan = loose.plan(task, first)
        begin, loose_s = _motion_of(plan, whole.mesh), solved_s(plan)
    plan = whole.plan(task, first, begin=begin)
    count, alone_s = sum(x.iterations for x in plan.attempts), solved_s(plan)
    return Start(task, name, count, alone_s, making_s + loose_s + alone_s, plan.solution.statistics.objective)


def _mapped(first: SrmpPlan, robot: Robot) -> JointPlan:
    """Stage 2 as the planner does it: with long steps, or where those find no way with the usual ones."""
    try:
        return map_to_joints(first, robot, STEPS_S)
    except SolverError:
        return map_to_joints(first, robot)


def _motion_of(plan: WholeBodyPlan, mesh: Mesh) -> Motion:
    """A plan as a motion to begin with, on another mesh."""
    charts, size = [], len(plan.schedule.body.stance)
    for name, count in mesh.intervals().items():
        phase = plan.phases[name]
        charts.append(phase.sample(np.linspace(0.0, phase.duration, count + 1))[0][:, :size])
    return Motion(np.array([phase.duration for phase in plan.phases.values()]), charts)


def solved_s(plan: WholeBodyPlan) -> float:
    """Processor time of all attempts that led to a plan [s]."""
    return sum(x.cpu_s for x in plan.attempts)


def against_crouch(rows: Sequence[Start]) -> list[dict]:
    """One row per start: solved targets, and medians of iterations and time as shares of the crouch's.

    Only targets count that the crouch has solved too; shares are None where there is none. ``costlier`` counts the
    jumps that cost more than :data:`SAME_COST` times the cheapest one found for their target, from whatever start; ``by
    at most [%]`` is how much more.
    """
    crouch = {r.task: r for r in rows if r.start == STARTS[0] and r.iterations is not None}
    least = {t: min((r.cost for r in rows if r.task == t and r.cost is not None), default=0.0) for t in crouch}
    out = []
    for name in dict.fromkeys(r.start for r in rows):
        here = [r for r in rows if r.start == name]
        both = [(r, crouch[r.task]) for r in here if r.iterations is not None and r.task in crouch]
        shares = {
            "iterations, share": [r.iterations / c.iterations for r, c in both],
            "stage 3 alone, share": [r.alone_s / c.alone_s for r, c in both],
            "with the guess, share": [r.total_s / c.total_s for r, c in both],
        }
        above = [r.cost / least[r.task] for r, _ in both]
        out.append(
            {"start": name, "solved": sum(r.iterations is not None for r in here), "targets": len(here)}
            | {key: float(np.median(x)) if x else None for key, x in shares.items()}
            | {"costlier": sum(x > SAME_COST for x in above), "by at most [%]": 100 * (max(above, default=1.0) - 1)}
        )
    return out


def spared(rows: Sequence[Start]) -> str:
    """Savings by stage 2's motion as a start, against a crouch, in words."""
    crouch, guess = against_crouch([r for r in rows if r.start in STARTS[:2]])
    shares = (guess[key] for key in ("iterations, share", "with the guess, share"))
    gain = ["?" if share is None else f"{1 - share:.0%}" for share in shares]
    worse = f"costlier jumps: {guess['costlier']}, from the crouch {crouch['costlier']}"
    return f"{gain[0]} of iterations and {gain[1]} of time ({worse})"


def drawn_in(run: SimulationResult, robot: Robot) -> dict[str, float]:
    """Pitch inertia in a simulated flight [kg m^2], and what limbs alone do to it (Sec. VI-B, inertia shaping).

    Returns
    -------
    ``lift-off``, ``least``, ``greatest``, ``touchdown``; ``legs`` and ``arms``, by how much the inertia changes if of
    the posture where it is greatest only the legs, or only the arms, go to where they are when it is least after that.
    """
    at = np.searchsorted(run.t, [run.metrics.liftoff_s, run.metrics.touchdown_s])
    rho, body = run.rho[at[0] : at[1]], FullBody(robot)
    high = int(np.argmax(rho))
    low = high + int(np.argmin(rho[high:]))
    opened, folded = run.q[at[0] + high], run.q[at[0] + low]
    arm, change, rest = np.array(["shoulder" in name for name in robot.joint_names]), {}, np.zeros(body.nv)
    for name, moved in (("legs", ~arm), ("arms", arm)):
        q = opened.copy()
        q[7:][moved] = folded[7:][moved]
        change[name] = float(body.terms(q, rest).rho - body.terms(opened, rest).rho)
    ends = {"lift-off": rho[0], "least": rho.min(), "greatest": rho.max(), "touchdown": rho[-1]}
    return {**{name: float(x) for name, x in ends.items()}, **change}


def trunk_feels(run: SimulationResult, robot: Robot) -> np.ndarray:
    """Readings of an accelerometer at the trunk's centre of mass in each control cycle (N - 1,) [g].

    The change of the simulated velocity over a cycle, less gravity; whatever turns with the robot has the same size.
    """
    lever, gravity, velocity = robot.model.inertias[1].lever, robot.model.gravity.linear, []
    for q, v in zip(run.q, run.v, strict=True):
        velocity.append(pin.Quaternion(q[3:7]).matrix() @ (v[:3] + np.cross(v[3:6], lever)))
    return np.linalg.norm(np.diff(velocity, axis=0) / STEP_S - gravity, axis=1) / np.linalg.norm(gravity)


def steady(values: np.ndarray, span_s: float = STEADY_S) -> np.ndarray:
    """Means of ``values`` (N,) over a time [s]: shorter peaks are those of rigid contacts and the engine's step."""
    size = round(span_s / STEP_S)
    return np.convolve(values, np.full(size, 1 / size), mode="valid")


def momentum_error(run: SimulationResult, tape: Tape) -> tuple[float, float]:
    """Root mean square of simulated less planned L in the launch's first 0.1 s, and after, in shares of the peak."""
    first, later = (float(np.sqrt(np.mean(e**2))) for e in _momentum_off(run, tape))
    return first, later


def _momentum_off(run: SimulationResult, tape: Tape) -> tuple[np.ndarray, np.ndarray]:
    """Simulated less planned L in the launch's first 0.1 s (n,), and after (m,), in shares of the planned peak."""
    down = run.t < run.metrics.liftoff_s
    planned = tape.extra["planar_L"]
    error = (run.L - np.interp(run.t, tape.t, planned))[down] / np.abs(planned).max()
    start = run.t[down] < FIRST_S
    return error[start], error[~start]


def vibration(run: SimulationResult, tape: Tape) -> tuple[int, int]:
    """Number of swings of simulated less planned L by more than :data:`SWING` in the first 0.1 s, and after, until 50
    ms before lift-off, where the plan itself is fast.

    A vibration swings to and fro; one blow makes two swings, a drift none, since its mean over 20 ms is taken away.
    """
    size = round(STEADY_S / STEP_S) | 1
    whole = np.concatenate(_momentum_off(run, tape))
    slow = np.convolve(np.pad(whole, size // 2, mode="edge"), np.full(size, 1 / size), mode="valid")
    cut = round(FIRST_S / STEP_S)
    fast = (whole - slow)[: -round(LAST_S / STEP_S)]
    return swings(fast[:cut], SWING), swings(fast[cut:], SWING)


def swings(values: np.ndarray, least: float) -> int:
    """Number of times that ``values`` (N,) go up or down by at least ``least``, smaller turns between left out."""
    count, way, end = 0, 0, float(values[0])
    for x in values:
        if way * (x - end) > 0:
            end = x  # goes on
        elif abs(x - end) >= least:
            way, end, count = (1 if x > end else -1), x, count + 1
    return count


def bow_deg(pitch: np.ndarray, rate: np.ndarray) -> float:
    """Angle by which a trunk is bent forward from where it begins [deg] when the push begins.

    ``pitch`` (N,) [rad], ``rate`` (N,) at which the CoM rises [m/s]: the push begins where it falls fastest, before it
    rises fastest.
    """
    push = int(np.argmin(rate[: np.argmax(rate)]))
    return float(np.degrees(pitch[push] - pitch[0]))


def touchdown_postures(plan: JumpPlan) -> list[dict[str, float | str]]:
    """Posture at touchdown in stage 2 and in stage 3, beside the stance [deg]: four joints, trunk and foot (Fig. 7)."""
    sagittal, joints = plan.robot.sagittal, plan.joints
    links = {
        "stage 2": to_link_angles(plan.robot, joints.q, joints.v, joints.a)[0][-1],
        "stage 3": plan.tape.extra["planar_angles"][-1],
        "stance": stance_angles(plan.robot),
    }
    names = (*SAGITTAL_JOINTS, "trunk", "foot")
    found = {who: np.degrees([*sagittal.joint_angles(x), x[3], x[0]]) for who, x in links.items()}
    return [{"what": name} | {who: float(x[i]) for who, x in found.items()} for i, name in enumerate(names)]


# ---------------------------------------------------------------------------------------------- readings


def readings(notebooks: Iterable[str | Path]) -> list[dict[str, str]]:
    """Differences of the notebooks from the paper, gathered from the tables at their ends.

    Returns
    -------
    Rows with ``notebook`` and the four columns :data:`READINGS`, in Markdown, in the order of the notebooks. A notebook
    without such a table adds none.

    Raises
    ------
    InputError
        If a notebook cannot be read, or its table has other columns or a broken row.
    """
    rows = []
    for path in (as_path(p, "a notebook") for p in notebooks):
        for line in _lines(path):
            cells = [c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]]
            if len(cells) != len(READINGS):
                raise InputError(
                    f"{path.name}: the row {line!r} of its differences from the paper has {len(cells)} "
                    f"columns, not {len(READINGS)}; write \\| for a bar inside a column"
                )
            rows.append({"notebook": path.stem, **dict(zip(READINGS, cells, strict=True))})
    return rows


def _lines(path: Path) -> list[str]:
    """Rows of the table under :data:`HEADING`, without its head."""
    try:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        source = "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError) as e:
        raise InputError(f"{path}: not a readable notebook ({type(e).__name__}); restore it") from e
    before, found, after = source.partition(HEADING)
    if not found or (before and not before.endswith("\n")):
        return []
    lines = [line.strip() for line in after.split("\n## ")[0].splitlines() if line.strip().startswith("|")]
    head = [c.strip() for c in lines[0].strip("|").split("|")] if lines else []
    if lines and tuple(head) != READINGS:
        raise InputError(
            f"{path.name}: its differences from the paper have the columns {', '.join(head)}; "
            f"they must be {', '.join(READINGS)}"
        )
    return lines[2:]


def readings_markdown(rows: Iterable[dict[str, str]]) -> str:
    """The rows of :func:`readings` as one Markdown table, whose first column leads to the notebooks beside it."""
    lines = [f"| {' | '.join(('notebook', *READINGS))} |", "|---" * (1 + len(READINGS)) + "|"]
    for row in rows:
        name = row["notebook"]
        lines.append(f"| [{name}]({name}.ipynb) | {' | '.join(row[c] for c in READINGS)} |")
    return "\n".join(lines)
