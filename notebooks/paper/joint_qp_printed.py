"""Stage 2's QPs by the letter of the paper, one reading at a time: the library's with rows changed, and their fate."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jumplab.errors import InputError, JumplabError
from jumplab.models.full import FullBody
from jumplab.ocp import Phase, Term
from jumplab.robot import Robot
from jumplab.stages.changes import StageChanges
from jumplab.stages.joint_qp import Affine, JointMapper, JointPlan
from jumplab.stages.joint_qp.programs import LaunchQp
from jumplab.stages.srmp import SrmpPlan
from paper.joint_qp_studies import alone
from paper.joint_violations import joint_violations
from paper.tracking import tracking

CHOICES = {
    "base_rows": (3, 6),
    "half": (True, False),
    "heel": ("near", "always"),
    "contact": ("consistent", "free"),
    "pairs": ("all", "hips"),
    "hip_rule": ("mirror", "sum"),
    "inertia": ("row", "term"),
}
WITH_TARGET = ("com", "force", "moment", "foot")  # costs that are halved without the 1/2
LOADED_N, HEEL_UP_M = 20.0, 0.0025  # a foot has a CoP, and a heel is up, beyond these


@dataclass(frozen=True)
class Form:
    """Reading of the paper's QPs. The defaults are the library's; :data:`PRINTED` is the letter of the paper.

    Attributes
    ----------
    base_rows : 6, or 3 for "top three rows", which leave the rotation free.
    half : False minimises X^T W X + f X as printed, whose optimum sits at half of the target.
    heel : "near" keeps the heel above the ground close to it; "always" forbids downward acceleration at any height.
    contact : "consistent" ties the CoP to the foot: flat foot with the CoP inside the sole, or heel up with the CoP at
        the toe; "free" is the printed tiptoe contact, where the heel may rise wherever the CoP is.
    pairs : "all" mirrors every joint pair, "hips" only the three hip joints.
    hip_rule : "mirror" uses difference or sum as the axes demand; "sum" is the printed sum for all three.
    inertia : "row" makes the inertia a hard row of the flight QP as printed; "term" a weighted term.
    """

    base_rows: int = 6
    half: bool = True
    heel: str = "near"
    contact: str = "consistent"
    pairs: str = "all"
    hip_rule: str = "mirror"
    inertia: str = "term"

    def __post_init__(self):
        for name, allowed in CHOICES.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"form: {name} = {getattr(self, name)!r}, must be one of {allowed}")


PRINTED = Form(base_rows=3, half=False, heel="always", contact="free", pairs="hips", hip_rule="sum", inertia="row")


def _halved(rows: Affine) -> Affine:
    """The same wish by half."""
    return Affine(rows.matrix, rows.offset / 2, rows.labels)


def _summed(rows: Affine) -> Affine:
    """The printed sum of accelerations, whatever the axes."""
    return Affine(np.abs(rows.matrix), np.zeros(len(rows)), rows.labels)


def _some(rows: Affine, names: Sequence[str]) -> Affine:
    """The rows of some labels."""
    kept = [k for k, label in enumerate(rows.labels) if label in names]
    return rows[kept].named([rows.labels[k] for k in kept])


def _read(term: Term, phase: str, form: Form, hips: Sequence[str]) -> Term | None:
    """One term of a phase in some form; None if the form has none such."""

    def after(change: Callable[[Affine], Affine], of: Term = term) -> Term:
        return replace(of, expression=lambda p: change(of.expression(p)))

    if term.name in WITH_TARGET and not form.half:
        return after(_halved)
    if term.name == "base dynamics" and form.base_rows < 6:
        return after(lambda rows: _some(rows, rows.labels[: form.base_rows]))
    if term.name == "symmetry":
        summed = after(_summed) if form.hip_rule == "sum" else term
        return summed if form.pairs == "all" else after(lambda rows: _some(rows, hips), summed)
    if (phase, term.name, form.inertia) == ("flight", "inertia", "row"):
        return replace(term, weight=None)
    return None if term.name == "foot pitch or toe moment" and form.contact == "free" else term


class PrintedLaunch(LaunchQp):
    """The launch's QPs in some form."""

    form = Form()

    def target(self, k, now):
        """Aims of a step; with a free contact no step is on the toes."""
        target = super().target(k, now)
        if self.form.contact == "free" or target.on_toes:
            target.heel_floor = np.zeros(2) if self.form.heel == "always" else self.heel_floor(now)
        return target


class PrintedMapper(JointMapper):
    """Stage 2 in some form; the other arguments are those of :class:`jumplab.stages.joint_qp.JointMapper`."""

    def __init__(self, srmp: SrmpPlan, robot: Robot, form: Form = PRINTED, **how):
        super().__init__(srmp, robot, **how)
        arms = robot.joints["shoulder_pitch"]
        above = (robot.joint_names[left - 6] for left, *_ in self.body.pairs["launch"])
        hips = [name for name in above if name not in arms]

        def phase(p: Phase) -> Phase:
            terms = (_read(term, p.name, form, hips) for term in p.terms)
            return replace(p, terms=tuple(t for t in terms if t is not None))

        self.problem = replace(self.problem, phases=tuple(map(phase, self.problem.phases)))
        toe_s = srmp.toe_s if form.contact == "consistent" else 0.0
        given = self.body, self.options, self.problem.phases[0]
        self.launch = PrintedLaunch(*given, self.reference.launch, toe_s, self.q0)
        self.launch.form = form


def map_as_read(srmp: SrmpPlan, robot: Robot, form: Form = PRINTED, **how) -> JointPlan:
    """Stage 2's roll-out in some form, see :func:`jumplab.stages.joint_qp.map_to_joints`."""
    return PrintedMapper(srmp, robot, form, **how).run()


READ = {  # one reading at a time, everything else as the library's; then all of them
    "ours": Form(),
    "without the 1/2": Form(half=False),
    "three base rows": Form(base_rows=3),
    "hip sum for all axes": Form(hip_rule="sum", pairs="hips"),
    "inertia as a hard row": Form(inertia="row"),
    "heel free on a tiptoe": Form(contact="free"),
    "the same, heel row everywhere": Form(contact="free", heel="always"),
    "all as printed": PRINTED,
    "all, heel row near the ground": replace(PRINTED, heel="near"),
}


def readings_tried(
    srmp: SrmpPlan, robot: Robot, names: Iterable[str] = READ
) -> tuple[dict[str, JointPlan], dict[str, str], list[dict]]:
    """Roll-outs of ``names`` of :data:`READ`; one that stops is tried again without torque limits.

    Returns
    -------
    By name, the roll-outs that come through, and the first refusal of those that stop; the table of both.
    """
    tried, said, rows = {}, {}, []
    for name in names:
        form = READ[name]
        row = {"form": name, "torque limits": "fails with and without"}
        for off in ((), ("torque",)):
            try:
                tried[name] = map_as_read(srmp, robot, form, changes=StageChanges(off=off))
            except JumplabError as e:
                said.setdefault(name, str(e).partition("; relax")[0])
                continue
            row["torque limits"] = "left out" if off else "yes"
            r = {**tracking(tried[name], srmp, robot), **joint_violations(tried[name], robot)}
            row |= {"take-off speed, off by [%]": 100 * r["takeoff_velocity"]}
            row |= {"L, off by [%]": 100 * r["launch_momentum"], "unphysical force [N, N m]": r["base_force"]}
            row |= {"L lost in flight": r["flight_momentum"]}
            break
        rows.append(row)
    return tried, said, rows


def cop_behind_toe_mm(plan: JointPlan, robot: Robot) -> float:
    """Largest distance of the CoP of a loaded left foot behind its toe while the heel is up [mm]."""
    body, behind = FullBody(robot), 0.0
    for k in range(plan.rows("launch").stop - 1):
        x, f = body.terms(plan.q[k], plan.v[k]), plan.f[k, 0]
        if f[2] > LOADED_N and x.heel.place[0, 2] - x.tip.place[0, 2] > HEEL_UP_M:
            behind = max(behind, 1000 * f[4] / f[2])
    return float(behind)


def moment_from_nowhere(mapper: JointMapper, plan: JointPlan, robot: Robot, srmp: SrmpPlan) -> dict[str, float]:
    """Largest moment about the base without a cause [N m], at single steps of ``plan``: six base rows, and three."""
    three = PrintedMapper(srmp, robot, Form(base_rows=3)).launch
    missed = dict.fromkeys(("ours", "three base rows"), 0.0)
    for k in range(0, len(mapper.launch.steps), 6):
        for name, qp in zip(missed, (mapper.launch, three), strict=True):
            x, _, both = alone(mapper, qp, k, plan)
            moment = x.M[3:6] @ both[12:] + x.H[3:6] - x.J[:, 3:6].T @ both[:12]
            missed[name] = max(missed[name], float(np.abs(moment).max()))
    return missed
