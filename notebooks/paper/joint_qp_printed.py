"""Stage 2's QPs by the letter of the paper, one reading at a time: the library's QPs with rows changed afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.stages.joint_qp import JointMapper, JointPlan
from jumplab.stages.joint_qp.flight import FlightQp
from jumplab.stages.joint_qp.launch import LaunchQp
from jumplab.stages.joint_qp.problem import Layout, StepQp

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
