"""Weights and bounds of stage 1."""

from __future__ import annotations

from dataclasses import dataclass, replace

from jumplab.task import FRICTION

Range = tuple[float, float]  # lower, upper


@dataclass(frozen=True)
class SrmpSettings:
    """Weights and bounds of stage 1; the paper prints none of these numbers. Weights are integrated
    over time.
    """

    intervals: tuple[int, int, int] = (28, 12, 40)  # flat foot, toe, flight
    friction: float = FRICTION
    # ahead of the heel; at the toe none, because the CoP ends there before the heel rises
    cop_margin_m: float = 0.015
    # heel up: the CoP is this close to the toe edge; less, and solves take longer
    toe_band_m: float = 0.0015
    # added there, where force and torque vanish together and their quotient bends
    toe_slack_n_m: float = 2.0
    # duration of the flat-foot part of the launch, as in stage 3
    flat_s: Range = (0.25, 0.90)
    # of its toe part (heel up); fixed, since the cost hardly feels it
    toe_s: Range = (0.12, 0.12)
    # trunk at take-off [rad]: leaning into the jump, so it bends first
    posture_end: Range = (0.2, 0.8)
    # of the extension speed: the foot's own rotation, not counted there, helps
    speed_share: float = 0.95
    # share of the extension speed up to which the full leg force is there
    corner_speed: float = 0.5
    momentum: Range = (-45.0, 45.0)  # box on L [kg m^2/s]: a backflip needs about -35
    inertia_margin: float = 0.05  # share of the envelope's width kept free on either side
    flight_inertia: float = (
        # share of its width up to which a flight goes: more takes straight legs and raised arms
        0.76
    )
    takeoff_lean: Range = (-0.5, 0.7)  # [rad]
    # share of the standing phi at most: knees still bent, far from the straight leg
    takeoff_length: float = 0.95
    # box on d rho/dt [kg m^2/s]: all limbs at half of their speed limits
    inertia_rate: float = 40.0
    inertia_accel: float = 600.0  # box on d^2 rho/dt^2 [kg m^2/s^2]
    turn_rad: Range = (-2.5, 2.5)  # box on theta_pl
    radius_m: Range = (0.1, 1.0)  # box on varphi
    com_m: Range = (-1.5, 2.5)  # box on the CoM at take-off, seen from the pivot
    speed_m_s: Range = (-6.0, 6.0)  # box on its velocity: a CoM rise of 1.8 m
    touchdown_inertia_rate: float = 8.0  # [kg m^2/s] the limbs come nearly to rest before touchdown
    touchdown_lean: float = 1.0  # [rad] at most, either way; without it a plan may land on its head
    # share of the standing phi: knees bent by about 0.7 rad
    touchdown_length: Range = (0.92, 0.97)
    touchdown_fold_per_m: float = 0.35  # lower share per metre of platform: legs folded to reach it
    # sole centre ahead of the CoM at touchdown, offset + slope v_x, as in stage 3
    capture_offset_m: float = 0.02
    capture_slope_s: float = 0.13
    capture_window_m: Range = (-0.03, 0.02)
    # [kg m^2] around the usual inertia at the touchdown length
    touchdown_inertia: Range = (-0.3, 0.5)
    # the positive part of a crouch's depth is rounded over this much
    crouch_smoothing_m: float = 0.02
    # SL-J1: of the jerks of theta_l, phi, theta_pl, varphi, each in its usual size
    w_jerk: tuple[float, float, float, float] = (8e-5, 8e-5, 4e-4, 8e-4)
    w_posture_end: float = 1.0  # SL-J2 [1 / rad^2]
    w_velocity: float = 2.0  # SL-J2 [1 / (m/s)^2 / s]
    w_momentum_end: float = 0.01  # SL-J3 [1 / (kg m^2/s)^2]
    w_momentum_rate: float = 2e-3  # SL-J3 [1 / (N m)^2 / s]
    # [1 / (kg m^2)^2 / s] inertia that postures of this leg length usually have
    w_usual_inertia: float = 60.0
    # [1 / m^2 / s] below an easy crouch the hip is at its stop and rho not free
    w_deep_crouch: float = 3e4
    w_turn: float = 5.0  # SL-J4 [1 / rad^2 / s]
    w_time: float = 0.5  # SL-J5 [1 / s^2]
    w_inertia_accel: float = 5e-4  # SF-J1 [1 / (kg m^2/s^2)^2 / s]; less leaves L undecided
    w_inertia_jerk: float = 1e-7  # SF-J1 [1 / (kg m^2/s^3)^2 / s]

    def of_flip(self) -> SrmpSettings:
        """The same for a jump that turns over.

        Trunk and arms swing upward with the legs' extension, so a flip leaves the ground faster
        than legs alone would; the turn is had by folding, not by more momentum in an open body.
        """
        return replace(
            self, speed_share=1.05, corner_speed=0.7, momentum=(-32.0, 32.0), flight_inertia=1.0
        )
