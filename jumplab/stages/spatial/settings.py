"""Limits, weights and mesh of the spatial program. The paper prints none of these numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace

from jumplab.stages.whole_body.settings import Mesh


@dataclass(frozen=True)
class SpatialLimits:
    """What a plan may use of the robot and the ground."""

    torque_share: float = 0.85  # of the peak torque: margin for model error and for feedback
    speed_share: float = 0.90  # of the speed limit
    range_margin_rad: float = 0.03  # to the joint stops
    friction: float = 0.42  # below the lowest friction that the trials simulate (0.5), also between the nodes
    heel_margin_m: float = 0.03  # CoP ahead of the heel; at the toe none, it ends there before the heel rises
    side_margin_m: float = 0.02  # CoP inside the sole's sides
    torsion_arm_m: float = 0.045  # on which friction resists the spin of a foot that carries alone
    foot_share: float = 0.15  # of the weight, on each flat foot at least
    heel_up_rad: float = 0.9  # foot pitch at most during toe-off
    knee_rad: float = 2.2  # flexion at most: deeper squats end on one leg
    straight_knee_rad: float = 0.15  # flexion at least while a foot carries: a leg
    # nearly straight has hardly a rate for what its foot has to do, and tapes have jumps there
    roll_rad: float = 1.0  # of the base, far from the chart's end at a quarter turn
    flat_s: tuple[float, float] = (0.25, 0.70)  # duration of the flat-foot phase
    toe_s: tuple[float, float] = (0.06, 0.15)  # duration of the toe phase
    flight_s: tuple[float, float] = (0.05, 1.5)  # duration of the flight, from a hop to a rise of two metres
    clearance_m: float = 0.035  # of the soles over the ground in mid-flight
    body_clearance_m: float = 0.05  # of knees and hands over the ground
    ankle_margin_m: float = 0.005  # of the ankle of a foot in the air, over its height in the stance
    sides_share: float = 0.45  # of the stance's distance between left and right leg, seen from the trunk
    hands_inward_m: float = 0.05  # by which hands may be further in than in the stance
    link_distance_m: float = 0.003  # between links that came too close without it
    touchdown_joint_rate: float = 2.0  # [rad/s] each: the landing starts from near rest
    touchdown_trunk_rate: float = 1.0  # [rad/s]
    touchdown_foot_rate: float = 0.3  # [rad/s] a foot that turns lands on an edge
    touchdown_slope: float = 0.42  # a sole's speed along the ground over that towards it: above the friction it slides
    touchdown_turning: float = (
        4.0  # [rad/s] of trunk and feet about the vertical besides, per half turn after the first
    )
    touchdown_knee: tuple[float, float] = (0.95, 1.4)  # [rad]
    touchdown_pitch: tuple[float, float] = (0.0, 0.30)  # [rad] of the base
    touchdown_roll: float = 0.10  # [rad] of the base, either way
    touchdown_yaw: float = 0.20  # [rad] of the base against the feet, either way
    edge_smoothing_m: float = 0.015  # a platform's edge is a step smoothed over about twice this
    edge_before_heel_m: float = 0.05  # a platform begins this far before the landing soles
    edge_step_m: float = 0.08  # and for clearance its upper surface counts as reaching this much further
    capture_offset_m: float = 0.02  # sole centre ahead of the CoM at touchdown: offset + slope * velocity (measured)
    capture_slope_s: float = 0.13
    capture_window_m: float = 0.02
    capture_moment: float | None = None  # if set, not the window but L about the soles' middle [kg m^2/s], either way

    def of_flip(self) -> SpatialLimits:
        """The same for a jump that turns over: time to wind up, a trunk that arrives turning, caught by momentum."""
        turning = dict(touchdown_trunk_rate=5.0, touchdown_foot_rate=8.0, capture_moment=4.0)
        return replace(self, flat_s=(0.25, 1.3), toe_s=(0.06, 0.45), **turning)


@dataclass(frozen=True)
class SpatialWeights:
    """Cost weights, integrated over time. Units: [1] / [unit of the term]^2 / [s]."""

    acceleration: float = 2e-3  # [1] / [rad/s^2]^2 / [s]
    jerk: float = 2e-7  # [1] / [rad/s^3]^2 / [s]
    torque: float = 2e-4  # [1] / [N m]^2 / [s]
    force: float = 1e-5  # [1] / [N]^2 / [s], of each corner's generators
    mirror: float = 10.0  # [1] / [rad]^2 / [s], of jumps straight ahead


SPATIAL_MESH = Mesh(12, 8, 12)  # coarse: the tape is exact between the nodes
FLIP_MESH = Mesh(20, 16, 28)  # a flip winds up longer, and turns faster
