"""Stage 1 as a problem: flat foot, toe (heel up) and flight, joined at take-off (Sec. III of the paper)."""

from __future__ import annotations

from jumplab.models.srmp import COORDINATES
from jumplab.ocp.problem import Bound, Phase, Problem
from jumplab.robot import Robot
from jumplab.robot.reach import Reach, reach
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.stages.srmp.terms import cop_terms, flight_terms, joining_terms, launch_terms, reach_terms, takeoff_terms

COM_BOX_M = (-1.5, 2.5)  # our choice: the CoM at take-off, seen from the pivot
SPEED_BOX_M_S = (-6.0, 6.0)  # our choice: a CoM rise of 1.8 m
# our choice: the toe part's CoP lies within this distance of the toe edge, where the robot's is once its heel is up.
# The costs push it to the inner end: at 5 mm the robot missed 1.3 % of the take-off speed; below 1 mm solves are longer
TOE_BAND_M = 0.0015
# our choice: at 1600 N the CoP's band is 1 mm wider, at 100 N 2 cm. As force and torque vanish together at take-off,
# their quotient bends by more within the last interval; with a quarter of it that interval decided the plan and cost
# 12 % more than on a fine mesh
TOE_SLACK_N_M = 2.0
SCALES = {"q": 1.0, "v": [5.0, 3.0, 5.0, 2.0], "a": [50.0, 30.0, 50.0, 20.0], "j": [1000.0, 500.0, 1000.0, 500.0]}
FLIGHT_SCALES = {"q": 1.0, "v": 20.0, "a": 200.0, "j": 5000.0}
SYMMETRY_OFF = ("symmetric landing",)  # about the pivot it lands too far ahead (falls); the capture window replaces it
PARAMETERS = dict(start=4, distance=1, platform=1, takeoff_speed=1, rotation=1, gravity=1)


def _launch_phases(mass: float, reach: Reach, s: SrmpSettings) -> tuple[Phase, Phase]:
    def start(parameters):
        return parameters["start"]

    low, high = reach.length
    box = Bound("state box", "SL-B1", "rad, m", "q", [s.takeoff_lean[0], low, -2.5, 0.1],
                [s.takeoff_lean[1], high, 2.5, 1.0], "inner")  # fmt: skip
    bounds = (
        Bound("start posture", "SL-P3; ours: the stance", "rad, m", "q", start, start, "start"),
        Bound("at rest", "ours", "1/s", "v", 0.0, 0.0, "start"),
        Bound("at rest (acceleration)", "ours", "1/s^2", "a", 0.0, 0.0, "start"),
        box,
    )
    heel, toe, margin = *reach.cop, s.cop_margin_m
    along = launch_terms(mass, reach, s)
    inside, edge = cop_terms(mass, heel + margin, toe), cop_terms(mass, toe - TOE_BAND_M, toe, TOE_SLACK_N_M)
    flat = Phase(
        "flat",
        COORDINATES,
        s.intervals[0],
        s.flat_s,
        (*along, *reach_terms(mass, reach, s, False), *inside),
        bounds,
        scales=SCALES,
    )
    tip_terms = (*along, *reach_terms(mass, reach, s, True), *edge, *takeoff_terms(mass, reach, s))
    tip = Phase("toe", COORDINATES, s.intervals[1], s.toe_s, tip_terms, (box,), scales=SCALES)
    return flat, tip


def _flight_phase(reach: Reach, s: SrmpSettings) -> Phase:
    stance = reach.start[1]
    low, high = reach.inertia
    margin = s.inertia_margin * (high - low)
    bounds = (
        Bound("inertia range", "SF-B1", "kg m^2", "q", low + margin, high - margin),
        Bound("inertia rate range", "SF-B1", "kg m^2/s", "v", -s.inertia_rate, s.inertia_rate),
        Bound("inertia acceleration range", "SF-B1", "kg m^2/s^2", "a", -s.inertia_accel, s.inertia_accel),
    )

    def shortest(parameters):
        fold = s.touchdown_fold_per_m * max(0.0, parameters["platform"])
        return (s.touchdown_length[0] - fold) * stance

    leg = (shortest, s.touchdown_length[1] * stance, 1.0)
    constants = {"L": (*s.momentum, 10.0), "com_x": (*COM_BOX_M, 1.0), "com_z": (*COM_BOX_M, 1.0),
                 "vel_x": (*SPEED_BOX_M_S, 1.0), "vel_z": (*SPEED_BOX_M_S, 1.0), "leg": leg}  # fmt: skip
    terms = tuple(flight_terms(s, reach))
    return Phase("flight", ("inertia",), s.intervals[2], (0.05, 2.0), terms, bounds, states=("theta",),
                 constants=constants, scales=FLIGHT_SCALES)  # fmt: skip


def build_problem(robot: Robot, settings: SrmpSettings = SrmpSettings(), envelope: Reach | None = None) -> Problem:
    """Stage 1 as one problem over launch and flight."""
    envelope, mass = envelope or reach(robot), robot.sagittal.total_mass
    phases = (*_launch_phases(mass, envelope, settings), _flight_phase(envelope, settings))
    return Problem("SRMP", phases, tuple(joining_terms(mass, settings)), dict(PARAMETERS))
