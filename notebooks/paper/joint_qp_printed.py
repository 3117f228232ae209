"""Stage 2's QPs by the letter of the paper, one reading at a time: the library's with rows changed, and their fate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from jumplab.errors import InputError, JumplabError
from jumplab.models.full import FullBody
from jumplab.robot import Robot
from jumplab.stages.joint_qp import JointMapper, JointPlan, Limits, Options
from jumplab.stages.joint_qp.flight import FlightQp
from jumplab.stages.joint_qp.launch import LaunchQp
from jumplab.stages.joint_qp.problem import Layout, StepQp
from jumplab.stages.srmp import SrmpPlan
from paper.joint_qp_studies import alone
from paper.joint_violations import joint_violations

CHOICES = {
    "base_rows": (3, 6),
    "half": (True, False),
    "heel": ("near", "always"),
    "contact": ("consistent", "free"),
    "pairs": ("all", "hips"),
    "hip_rule": ("mirror", "sum"),
    "inertia": ("row", "term"),
}
SIDES = {"A": ("A", "b"), "E": ("E", "e")}
LOADED_N, HEEL_UP_M = 20.0, 0.0025  # a foot has a CoP, and a heel is up, beyond these


@dataclass(frozen=True)
class Form:
    """How the paper's QPs are read. The defaults are the library's; :data:`PRINTED` is the letter of the paper.

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


def without(qp: StepQp, matrix: str, gone: np.ndarray) -> StepQp:
    """The program without some rows (a mask) of A or E."""
    blocks, labels = {}, dict(qp.layout.labels)
    for name, (own, rows) in qp.layout.blocks.items():
        if own == matrix:
            rows = slice(int((~gone[: rows.start]).sum()), int((~gone[: rows.stop]).sum()))
        if rows.start < rows.stop:
            blocks[name] = own, rows
    labels[matrix] = tuple(np.array(labels[matrix])[~gone])
    return replace(qp, layout=Layout(blocks, labels), **{k: getattr(qp, k)[~gone] for k in SIDES[matrix]})


def _read(qp: StepQp, form: Form, hips: Mapping[str, Any], targets: int) -> StepQp:
    """Readings that both phases share; the first ``targets`` rows of A are those with a target."""
    b, E, e = qp.b.copy(), qp.E.copy(), qp.e.copy()
    mirror = qp.layout.at("symmetry")
    if not form.half:
        b[:targets] /= 2
    if form.hip_rule == "sum":
        E[mirror], e[mirror] = np.abs(E[mirror]), 0.0
    gone = np.zeros(len(e), bool)
    gone[form.base_rows : 6] = True
    if form.pairs == "hips":
        gone[mirror] = [label.removeprefix("symmetry ") not in hips for label in qp.layout.labels["E"][mirror]]
    return without(replace(qp, b=b, E=E, e=e), "E", gone)


class PrintedLaunch(LaunchQp):
    """The launch QP in some form."""

    def __init__(self, *args, form: Form):
        super().__init__(*args)
        self.form = form
        if form.contact == "free":
            self.on_toes = np.zeros_like(self.on_toes)
            self.inertia_weights = self._inertia_weights()

    def _heel_floor(self, terms, k):
        if self.form.contact == "consistent" and not self.on_toes[k]:
            return super()._heel_floor(terms, k)
        if self.form.heel == "always":
            return np.zeros(2)
        return self._near_ground(terms)

    def matrices(self, terms, target, start) -> StepQp:
        """As the library's, then read in the form."""
        qp = super().matrices(terms, target, start)
        if self.form.contact == "free":
            gone = np.zeros(len(qp.e), bool)
            gone[qp.layout.at("foot pitch or toe moment")] = True
            qp = without(qp, "E", gone)
        return _read(qp, self.form, self.body.pair_names(("hip",)), 9)


class PrintedFlight(FlightQp):
    """The flight QP in some form."""

    def __init__(self, *args, form: Form):
        super().__init__(*args)
        self.form = form

    def matrices(self, terms, target, start) -> StepQp:
        """As the library's, then read in the form."""
        qp = _read(super().matrices(terms, target, start), self.form, self.body.pair_names(("hip",)), 6)
        if self.form.inertia == "term":
            return qp
        gone = np.zeros(len(qp.b), bool)
        gone[qp.layout.at("inertia")] = True
        qp = without(qp, "A", gone)
        blocks = {**qp.layout.blocks, "inertia": ("E", slice(len(qp.e), len(qp.e) + 1))}
        labels = {**qp.layout.labels, "E": (*qp.layout.labels["E"], "inertia rho")}
        e = np.append(qp.e, target.inertia_accel - terms.drift_rho)
        return replace(qp, E=np.vstack([qp.E, terms.J_rho]), e=e, layout=Layout(blocks, labels))


class PrintedMapper(JointMapper):
    """Stage 2 in some form; the other arguments are those of :class:`jumplab.stages.joint_qp.JointMapper`."""

    def __init__(self, srmp_plan: Any, robot: Robot, form: Form = PRINTED, **how):
        self.launch_qp, self.flight_qp = partial(PrintedLaunch, form=form), partial(PrintedFlight, form=form)
        super().__init__(srmp_plan, robot, **how)


def map_as_read(srmp_plan: Any, robot: Robot, form: Form = PRINTED, method: str = "direct", **how) -> JointPlan:
    """Stage 2's roll-out in some form, see :func:`jumplab.stages.joint_qp.map_to_joints`."""
    return PrintedMapper(srmp_plan, robot, form, **how).run(method)


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


def readings_tried(srmp: SrmpPlan, robot: Robot) -> tuple[dict[str, JointPlan], dict[str, str], list[dict]]:
    """Roll-outs of all of :data:`READ`; one that stops is tried again without torque limits.

    Returns
    -------
    By name, the roll-outs that come through, and the first refusal of those that stop; the table of both.
    """
    tried, said, rows = {}, {}, []
    for name, form in READ.items():
        row = {"form": name, "torque limits": "fails with and without"}
        for torque in (1.0, None):
            try:
                tried[name] = map_as_read(srmp, robot, form, options=Options(limits=Limits(torque_share=torque)))
            except JumplabError as e:
                said.setdefault(name, str(e).partition("; relax")[0])
                continue
            row["torque limits"] = "yes" if torque else "left out"
            r = {**tried[name].tracking, **joint_violations(tried[name], robot)}
            row |= {"take-off speed, off by [%]": 100 * r["takeoff_velocity"]}
            row |= {"L, off by [%]": 100 * r["launch_momentum"], "force from nowhere [N, N m]": r["base_force"]}
            row |= {"L lost in flight": r["flight_momentum"]}
            break
        rows.append(row)
    return tried, said, rows


def cop_behind_toe_mm(plan: JointPlan, robot: Robot) -> float:
    """How far the CoP of a loaded left foot gets behind its toe while the heel is up [mm]."""
    body, behind, foot = FullBody(robot), 0.0, robot.foot
    for k in range(plan.rows("launch").stop - 1):
        x, following = (body.motion(plan.q[i], plan.v[i]) for i in (k, k + 1))
        f = plan.f[k, 0]
        if f[2] > LOADED_N and x.heel[0, 2] - x.toe[0, 2] > HEEL_UP_M:
            middle = (x.foot_rotation[0] + following.foot_rotation[0]) / 2  # of the step
            moment = f[3:] - np.cross(middle @ [foot.toe, 0.0, foot.sole_z], f[:3])
            behind = max(behind, 1000 * moment[1] / f[2])
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
