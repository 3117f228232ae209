"""Stage 1 as a problem: flat foot, toe (heel up) and flight, joined at take-off (Sec. III of the paper)."""

from __future__ import annotations

from jumplab.models.srmp import COORDINATES
from jumplab.ocp.problem import Bound, Phase, Problem
from jumplab.robot import Robot
from jumplab.robot.reach import Reach, reach
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.stages.srmp.terms import cop_terms, flight_terms, joining_terms, launch_terms, reach_terms, takeoff_terms

SCALES = {"q": 1.0, "v": [5.0, 3.0, 5.0, 2.0], "a": [50.0, 30.0, 50.0, 20.0], "j": [1000.0, 500.0, 1000.0, 500.0]}
FLIGHT_SCALES = {"q": 1.0, "v": 20.0, "a": 200.0, "j": 5000.0}
SYMMETRY_OFF = ("symmetric landing",)  # about the pivot it lands too far ahead (falls); the capture window replaces it


def _launch_phases(mass: float, reach: Reach, s: SrmpSettings) -> tuple[Phase, Phase]:
    """Flat foot and toe: the same terms all along; the CoP inside the sole, then in a band at the toe edge."""

    def start(parameters):
        return parameters["start"]

    low, high = zip(s.takeoff_lean, reach.length, s.turn_rad, s.radius_m, strict=True)
    box = Bound("state box", "SL-B1", "rad, m", "q", low, high, "inner")
    bounds = (
        Bound("start posture", "SL-P3; ours: the stance", "rad, m", "q", start, start, "start"),
        Bound("at rest", "ours", "1/s", "v", 0.0, 0.0, "start"),
        Bound("at rest (acceleration)", "ours", "1/s^2", "a", 0.0, 0.0, "start"),
        box,
    )
    heel, toe = reach.cop
    along = launch_terms(mass, reach, s)
    flat = (*along, *reach_terms(mass, reach, s, False), *cop_terms(mass, heel + s.cop_margin_m, toe))
    edge = cop_terms(mass, toe - s.toe_band_m, toe, s.toe_slack_n_m)
    tip = (*along, *reach_terms(mass, reach, s, True), *edge, *takeoff_terms(mass, reach, s))
    return (
        Phase("flat", COORDINATES, s.intervals[0], s.flat_s, flat, bounds, scales=SCALES),
        Phase("toe", COORDINATES, s.intervals[1], s.toe_s, tip, (box,), scales=SCALES),
    )


def _flight_phase(reach: Reach, s: SrmpSettings) -> Phase:
    stance, (low, high) = reach.start[1], reach.inertia
    margin = s.inertia_margin * (high - low)
    bounds = (
        Bound("inertia range", "SF-B1", "kg m^2", "q", low + margin, high - margin),
        Bound("inertia rate range", "SF-B1", "kg m^2/s", "v", -s.inertia_rate, s.inertia_rate),
        Bound("inertia acceleration range", "SF-B1", "kg m^2/s^2", "a", -s.inertia_accel, s.inertia_accel),
    )

    def shortest(parameters):
        fold = s.touchdown_fold_per_m * max(0.0, parameters["platform"])
        return (s.touchdown_length[0] - fold) * stance

    constants = {
        "L": (*s.momentum, 10.0),
        **{name: (*s.com_m, 1.0) for name in ("com_x", "com_z")},
        **{name: (*s.speed_m_s, 1.0) for name in ("vel_x", "vel_z")},
        "leg": (shortest, s.touchdown_length[1] * stance, 1.0),
    }
    terms, more = tuple(flight_terms(s, reach)), {"states": ("theta",), "constants": constants, "scales": FLIGHT_SCALES}
    return Phase("flight", ("inertia",), s.intervals[2], (0.05, 2.0), terms, bounds, **more)


def build_problem(robot: Robot, settings: SrmpSettings = SrmpSettings(), envelope: Reach | None = None) -> Problem:
    """Stage 1 as one problem over launch and flight."""
    envelope, mass = envelope or reach(robot), robot.sagittal.total_mass
    phases = (*_launch_phases(mass, envelope, settings), _flight_phase(envelope, settings))
    sizes = {"start": 4, "distance": 1, "platform": 1, "takeoff_speed": 1, "rotation": 1, "gravity": 1}
    return Problem("SRMP", phases, tuple(joining_terms(mass, settings)), sizes)
