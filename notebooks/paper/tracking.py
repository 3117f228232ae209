"""Differences of stage 2's motion, and of the finished jump, from stage 1's trajectories."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from jumplab.models.full import FullBody, pitch_inertia
from jumplab.robot import Robot
from jumplab.stages import JumpPlan
from jumplab.stages.joint_qp import JointPlan
from jumplab.stages.srmp import SrmpPlan

# of the jump: quantity -> column of stage 1
TRACKED = {"rho": "rho", "rho_rate": "rho_rate", "velocity": "com_velocity", "L": "L"}
# of the launch: what, the most that "follows" allows (None: not asked), and the unit with its factor
ASKED = {
    "L": ("angular momentum, rms", 10.0, 100, "% of its peak"),
    "velocity": ("CoM velocity, rms", 5.0, 100, "% of its peak"),
    "rho": ("inertia, rms", None, 100, "% of its mean"),
    "com": ("CoM off its path", 3.0, 100, "cm"),
}


def compared(plan: JointPlan, srmp: SrmpPlan, robot: Robot) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Quantities of stage 2's motion, and those that stage 1 asks for, at the same nodes.

    com (from the pivot) [m] and com_velocity [m/s] (N, 2), L [kg m^2/s] and rho [kg m^2] (N,), in flight foot_com, the
    middle of the soles from the CoM [m].
    """
    launch, flight = plan.rows("launch"), plan.rows("flight")
    body = FullBody(robot.under_gravity(srmp.task.gravity))
    nodes = [body.terms(q, v) for q, v in zip(plan.q, plan.v, strict=True)]
    pivot = nodes[0].sole.place.mean(axis=0)
    actual = {
        "com": np.array([x.com - pivot for x in nodes])[:, [0, 2]],
        "com_velocity": np.array([x.com_velocity for x in nodes])[:, [0, 2]],
        "L": np.array([x.momentum[4] for x in nodes]),
        "rho": np.array([x.rho for x in nodes]),
        "foot_com": np.array([x.foot_com.mean(axis=0) for x in nodes[flight]])[:, [0, 2]],
    }
    asked = srmp.at(plan.t[launch], plan.t[flight] - plan.t[flight.start])
    both = ("com", "com_velocity", "L", "rho")
    wanted = {k: np.concatenate([getattr(asked.launch, k), getattr(asked.flight, k)]) for k in both}
    return actual, wanted | {"foot_com": asked.flight.foot_com}


def tracking(plan: JointPlan, srmp: SrmpPlan, robot: Robot) -> dict[str, float]:
    """Errors of stage 2 against stage 1.

    Keys: ``takeoff_velocity`` (share of the take-off speed), ``takeoff_momentum`` and ``launch_momentum`` (share of the
    peak of L in the launch; at take-off, and the largest), ``launch_inertia_rms``, ``flight_inertia_rms`` (share of the
    mean of rho), ``launch_com`` (largest distance [m]), ``flight_foot_rms`` and ``touchdown_foot`` [m].
    """
    actual, wanted = compared(plan, srmp, robot)
    n = plan.rows("launch").stop
    missed = {k: x - wanted[k] for k, x in actual.items()}
    speed = wanted["com_velocity"][n - 1]
    foot = np.linalg.norm(missed["foot_com"], axis=1)
    momentum = np.abs(missed["L"][:n]) / max(np.abs(wanted["L"][:n]).max(), 1e-9)

    def rms(x, size):
        return float(np.sqrt(np.mean(x**2)) / size)

    return {
        "takeoff_velocity": float(np.linalg.norm(missed["com_velocity"][n - 1]) / np.linalg.norm(speed)),
        "takeoff_momentum": float(momentum[-1]),
        "launch_momentum": float(momentum.max()),
        "launch_inertia_rms": rms(missed["rho"][:n], wanted["rho"][:n].mean()),
        "flight_inertia_rms": rms(missed["rho"][n:], wanted["rho"][n:].mean()),
        "launch_com": float(np.linalg.norm(missed["com"][:n], axis=1).max()),
        "flight_foot_rms": rms(foot, 1.0),
        "touchdown_foot": float(foot[-1]),
    }


def jump_tracking(plan: JumpPlan) -> dict[str, dict[str, dict[str, float]]]:
    """Differences of the tape from stage 1's trajectories, compared at the same share of each phase (WL-J1, WF-J1).

    Returns
    -------
    phase ("launch", "flight") -> "rho" [kg m^2], "rho_rate" [kg m^2/s], "velocity" of the CoM [m/s], "L" [kg m^2/s] ->
    "rms" of the difference, and "relative_rms", its share of the reference's mean size.
    """
    tape, k = plan.tape, plan.tape.takeoff_index
    asked = dict(zip(("launch", "flight"), _asked(plan), strict=True))
    rows, done = {"launch": slice(k), "flight": slice(k, None)}, {"rho_rate": _rho_rate(plan)}
    done |= {column: tape.extra[f"planar_{column}"] for column in TRACKED.values() if column not in done}
    return {
        name: {key: _missed(getattr(asked[name], column), done[column][part]) for key, column in TRACKED.items()}
        for name, part in rows.items()
    }


def launch_followed(plan: JumpPlan) -> dict[str, float]:
    """Differences of the launch from stage 1's: rms of ``L`` and ``velocity`` as shares of their peaks, and of ``rho``
    as a share of its mean (Sec. V-A); ``com``, the largest distance of the CoM from its
    path, both from their starts [m].
    """
    missed, peaks = jump_tracking(plan)["launch"], plan.srmp.launch
    asked, k = _asked(plan)[0], plan.tape.takeoff_index
    ways = (com[:k] - com[0] for com in (plan.tape.extra["planar_com"], asked.com))
    return {
        "L": missed["L"]["rms"] / float(np.abs(peaks.L).max()),
        "velocity": missed["velocity"]["rms"] / float(np.linalg.norm(peaks.com_velocity, axis=1).max()),
        "rho": missed["rho"]["relative_rms"],
        "com": float(np.linalg.norm(np.subtract(*ways), axis=1).max()),
    }


def followed_table(plans: Iterable[JumpPlan]) -> list[dict[str, float | str]]:
    """Median and worst of :func:`launch_followed` over jumps, beside :data:`ASKED` and whether that holds."""
    found = [launch_followed(plan) for plan in plans]
    rows: list[dict[str, float | str]] = []
    for key, (what, most, per, unit) in ASKED.items():
        sizes = [per * one[key] for one in found]
        row = {"in the launch": what, "unit": unit, "median": float(np.median(sizes)), "worst": max(sizes)}
        row |= {"at most": "" if most is None else most}
        rows.append(row | {"holds": "" if most is None else "yes" if max(sizes) <= most else "does not hold"})
    return rows


def _asked(plan: JumpPlan) -> tuple[Any, Any]:
    """Stage 1's launch and flight at the instants of the tape, each at the same share of its phase."""
    tape, srmp, k = plan.tape, plan.srmp, plan.tape.takeoff_index
    toe = float(tape.extra["planar_toe_phase_start"])
    ends = [0.0, srmp.launch_s - srmp.toe_s, srmp.launch_s]
    air = tape.t[k:] - tape.takeoff_time
    asked = srmp.at(np.interp(tape.t[:k], [0.0, toe, tape.takeoff_time], ends), air * srmp.flight_s / air[-1])
    return asked.launch, asked.flight


def _rho_rate(plan: JumpPlan) -> np.ndarray:
    model, data = plan.robot.model, plan.robot.model.createData()
    return np.array([pitch_inertia(model, data, q)[1] @ v for q, v in zip(plan.tape.q, plan.tape.v, strict=True)])


def _missed(asked: np.ndarray, done: np.ndarray) -> dict[str, float]:
    asked, done = (np.atleast_2d(x.T) for x in (asked, done))
    rms = float(np.sqrt(np.mean(np.sum((done - asked) ** 2, axis=0))))
    size = float(np.mean(np.linalg.norm(asked, axis=0)))
    return {"rms": rms, "relative_rms": rms / size if size else float("nan")}
