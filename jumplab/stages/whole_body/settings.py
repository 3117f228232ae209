"""Limits, weights and mesh of stage 3. The paper prints none of these numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from jumplab.errors import InputError, quoted
from jumplab.task import FRICTION

JERK_SCALE = 2000.0  # [rad/s^3] peaks of solutions, for conditioning
RESERVE_SHARE = 0.1, 0.15  # of the flat-foot phase, over which the CoP's reserve comes and goes
LATE_SHARE = 0.4  # of the flight, at its end: by then a flip has folded
# [rad/s^3] by how much the jerk of a joint may jump from interval to interval: half a sample of 1 kHz later a tape then
# misses the acceleration by 3.9 rad/s^2, and the audit allows 4
FOLLOWED_JERK_STEP = 31_000.0


class Contact(StrEnum):
    """How the robot stands, or does not: the three phases of a jump by their names."""

    FLAT = "flat"
    TOE = "toe"
    FLIGHT = "flight"


@dataclass(frozen=True)
class Limits:
    """What a plan may use of the robot and the ground."""

    torque_share: float = 0.85  # of the peak torque: margin for model error and for feedback
    speed_share: float = 0.90  # of the speed limit
    friction: float = FRICTION
    cop_margin_m: float = 0.01  # ahead of the heel; at the toe none, because the CoP ends there before the heel rises
    range_margin_rad: float = 0.03  # to the joint stops
    hand_clearance_m: float = 0.05  # above the ground in launch
    edge_clearance_m: float = 0.07  # of hand, mid-arm and knee before a platform's edge
    edge_smoothing_m: float = 0.015  # a platform's edge is a step smoothed over about twice this
    edge_before_heel_m: float = 0.05  # a platform begins this far before the landing heel
    edge_step_m: float = 0.08  # and for clearance it counts as beginning this much earlier still
    clearance_m: float = 0.035  # of the sole over the ground in mid-flight: 2 cm from 30 to 70 % of it
    heel_up_rad: float = 0.9  # foot pitch at most during toe-off
    flat_s: tuple[float, float] = (0.25, 0.90)  # duration of the flat-foot phase
    toe_s: tuple[float, float] = (0.06, 0.15)  # duration of the toe phase
    touchdown_joint_rate: float = 2.0  # [rad/s] each: the landing starts from near rest
    touchdown_trunk_rate: float = 1.0  # [rad/s]
    touchdown_foot_rate: float | None = 0.3  # [rad/s] if set: a foot that turns lands on toe or heel, and is spun
    touchdown_knee: tuple[float, float] = (0.95, 1.4)  # [rad] the impact turns a straighter one faster than its motor
    touchdown_ankle_stroke: float | None = None  # [rad] if set, least way left to the stop that the shank leans into
    touchdown_trunk: tuple[float, float] = (0.0, 0.30)  # [rad]
    capture_offset_m: float = 0.02  # sole centre ahead of the CoM at touchdown: offset + slope v_x (measured)
    capture_slope_s: float = 0.13
    capture_window_m: tuple[float, float] = (-0.02, 0.02)
    capture_moment: tuple[float, float] | None = None  # if set, not the window but L about the soles [kg m^2/s]
    # with it, backward: capture point + slope * take-off speed, ahead of the toes (measured)
    capture_beyond_toes_m: tuple[float, float] | None = None
    capture_beyond_slope_s: float = 0.05
    least_push: float = 0.0  # share of the weight that flat feet carry at least
    envelope_between: bool = False  # torque against speed is looked at between the nodes too
    cop_reserve_m: float = 0.0  # kept from both ends of the sole besides, until the last of the flat-foot phase
    jerk_step: float | None = None  # if set, most that the jerk of a joint or of the trunk jumps by [rad/s^3]
    flight_clear: tuple[str, ...] = ("hand", "mid-arm", "knee")  # points that stay clear in flight ...
    flight_clearance_m: float = 0.05  # ... by this much
    opening_speed_share: float = 1.0  # of the speed limit, in the last :data:`LATE_SHARE` of the flight, if it is less
    momentum_share: float = 0.01  # L at take-off within this share of stage 1's
    momentum_slack: float = 0.02  # ... or within this [kg m^2/s], for jumps with little L

    def of_flip(self) -> Limits:
        """The same for a jump that turns over: it arrives turning, and any limb may pass close to the ground.

        Where the soles belong depends on that turning. A front flip asks for its angular momentum about the soles,
        which the impact does not change; a backflip for its capture point, x + v_x / sqrt(g / z), ahead of the toes.
        The launch is open loop and longer than an upright body's fall, so the CoP keeps off the sole's edges.
        """
        return replace(
            self,
            flat_s=(0.25, 1.3),  # time to wind up
            toe_s=(0.06, 0.45),  # a front flip leans over the toes before it brakes on them
            envelope_between=True,
            least_push=0.04,  # or high flips hop first
            cop_reserve_m=0.03,
            jerk_step=FOLLOWED_JERK_STEP,  # or torques jump from node to node
            momentum_share=0.15,  # stage 1's rod turns with other inertia than the body
            flight_clear=("hand", "mid-arm", "knee", "hip", "shoulder"),
            flight_clearance_m=0.06,
            touchdown_trunk_rate=5.0,  # the trunk cannot stop while L stays what the turn needed
            touchdown_foot_rate=None,
            touchdown_ankle_stroke=0.12,  # an ankle at its stop cannot keep a tilted robot's soles flat
            capture_moment=(6.0, 10.0),
            capture_beyond_toes_m=(0.09, 0.12),
        )


@dataclass(frozen=True)
class Weights:
    """Cost weights, integrated over time. Units: [1] / [unit of the term]^2 / [s]."""

    joint_acceleration: float = 4e-3  # [1] / [rad/s^2]^2 / [s]
    jerk: float = 4e-7  # [1] / [rad/s^3]^2 / [s]
    tracking_jerk: float = 5e-7  # the same where stage 1 is tracked: limbs in haste, which a tape must still follow
    torque: float = 1e-4  # [1] / [N m]^2 / [s]
    track_velocity: float = 20.0  # [1] / [m/s]^2 / [s]
    # inertia in shares of the stance's, so that weights mean the same for robots of any size
    track_inertia: float = 6800.0  # [1] / [share]^2 / [s]; tracking it is the task of the paper's flight
    track_inertia_rate: float = 23.0  # [1] / [share/s]^2 / [s], in launch, whose end is faster than legs can be
    track_flight_inertia_rate: float = 136.0  # the same in flight; less, and arms swing the other way and miss by 6 %
    track_momentum: float = 2.0  # [1] / [kg m^2/s]^2 / [s]
    heel_velocity: float = 0.5  # [1] / [m/s]^2 / [s]
    ankle_rate: float = 0.02  # [1] / [rad/s]^2 / [s]
    track_duration: float = 50.0  # [1] / [s]^2

    def of_flip(self) -> Weights:
        """The same for a jump that turns over: limbs in haste, whose jerk must not jump between nodes.

        Its inertia follows from the turn and from L; stage 1's, of a rod that turns as one, is only a hint.
        """
        light = {"track_inertia": 45.4, "track_inertia_rate": 0.454, "track_flight_inertia_rate": 0.454}
        return replace(self, jerk=2.5 * self.jerk, tracking_jerk=2.5 * self.jerk, **light)


@dataclass(frozen=True)
class Mesh:
    """Intervals per phase."""

    flat: int = 25
    toe: int = 20
    flight: int = 30

    def __post_init__(self):
        for name, n in self.intervals().items():
            if isinstance(n, bool) or not isinstance(n, int) or n < 2:
                raise InputError(f"mesh: {name} = {quoted(n)} intervals, must be a whole number of 2 or more")

    def of_flip(self) -> Mesh:
        """The same for a jump that turns over, twice as fine: it winds up longer, and the wrench changes faster."""
        return Mesh(2 * self.flat, 2 * self.toe, 2 * self.flight)

    def intervals(self) -> dict[str, int]:
        """By the names of the phases."""
        return {"flat": self.flat, "toe": self.toe, "flight": self.flight}

    def nodes(self, split: float, takeoff: float, end: float) -> dict[str, np.ndarray]:
        """Times of the nodes [s] from the start of the launch, by the ends of the phases."""
        ends = {"flat": (0.0, split), "toe": (split, takeoff), "flight": (takeoff, end)}
        return {name: np.linspace(*ends[name], n + 1) for name, n in self.intervals().items()}

    def coarse(self) -> Mesh:
        """Half of the intervals: where a solve begins before it is refined on this mesh."""
        return Mesh(*(max(n // 2, 2) for n in (self.flat, self.toe, self.flight)))
