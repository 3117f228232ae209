"""Limits, weights and mesh of the whole-body program. The paper prints none of these numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jumplab.errors import InputError, quoted
from jumplab.robot.contact import FRICTION
from jumplab.robot.legs import Size

# of the flight, at its end: by then a flip has folded; the hardest push of an opening comes in the
# first fifth of it
LATE_SHARE = 0.5
RESERVE_SHARE = 0.1, 0.15  # of the flat-foot phase, over which the CoP's reserve comes and goes


@dataclass(frozen=True)
class Limits:
    """Limits of robot and ground that a plan keeps."""

    torque_share: float = 0.85  # of the peak torque: margin for model error and for feedback
    speed_share: float = 0.90  # of the speed limit
    power_share: float = 0.95  # of what all motors may draw: between the nodes they draw more
    friction: float = FRICTION
    range_margin_rad: float = 0.03  # to the joint stops
    # ahead of the heel; at the toe none, it ends there before the heel rises
    cop_margin_m: float = 0.01
    # of the sole, kept from both its ends besides until the last of the flat-foot phase: launches
    # are open loop
    cop_reserve_share: float = 0.125
    least_push: float = 0.0  # share of the weight that both flat feet carry at least
    heel_up_rad: float = 0.9  # foot pitch at most during toe-off
    # [rad/s^3] of that pitch, of a record: where it changes by twice as much within a step of the
    # tape, which is 1 ms for all robots, accelerations are 4 rad/s^2 off the rates
    heel_jerk: float = 1.6e4
    straight_knee_rad: float = 0.15  # flexion at least while a foot carries: a leg
    # nearly straight has hardly a rate for what its foot has to do, and tapes have jumps there
    flat_s: tuple[float, float] = (0.25, 0.90)  # duration of the flat-foot phase
    # duration of the toe phase, in which perturbed robots fall forward
    toe_s: tuple[float, float] = (0.06, 0.12)
    # duration of the flight, from a hop to a rise of two metres
    flight_s: tuple[float, float] = (0.05, 1.5)
    # of the soles over the ground in mid-flight: 2 cm, beside platforms too, between nodes
    clearance_m: float = 0.037
    body_clearance_m: float = 0.05  # of knees and hands over the ground
    edge_clearance_m: float = 0.07  # by which a platform's edge counts as nearer to them
    shank_clearance_m: float = 0.015  # of the faces of the shanks from a platform's edge
    edge_smoothing_m: float = 0.015  # a platform's edge is a step smoothed over about twice this
    edge_before_heel_m: float = 0.05  # a platform begins this far before the landing soles
    # and for clearance its upper surface counts as reaching this much further
    edge_step_m: float = 0.08
    # of the ankle of a foot in the air, over its height in the stance
    ankle_margin_m: float = 0.005
    # touchdown
    touchdown_joint_rate: float = 2.0  # [rad/s] each: the landing starts from near rest
    touchdown_trunk_rate: float = 1.0  # [rad/s] of its pitch
    # [rad/s] of its yaw and its roll, which feet can do less against
    touchdown_side_rate: float = 0.5
    touchdown_foot_rate: float = 0.3  # [rad/s] a foot that turns lands on an edge
    # [rad] the impact turns a straighter one too fast
    touchdown_knee: tuple[float, float] = (0.95, 1.4)
    touchdown_pitch: tuple[float, float] = (0.0, 0.30)  # [rad] of the base
    touchdown_waist_rad: float = 0.15  # of each joint of a waist, off the stance either way
    # [rad] if set, least way left to the stop that the shank leans into
    touchdown_ankle_stroke: float | None = None
    # to the joint stops all along a schedule that goes on after a flight, where robots unlike their
    # model need it; of a joint whose stance is nearer than twice that, half of its way there
    rebound_range_rad: float = 0.08
    # at the touchdowns of such a schedule, of the ankles to the stop that the shanks lean into
    rebound_ankle_rad: float = 0.25
    # sole centre ahead of the CoM at touchdown: offset + slope * velocity (measured)
    capture_offset_m: float = 0.02
    capture_slope_s: float = 0.13
    capture_window_m: float = 0.02
    # if set, not the window but L about the soles' middle, either way, in shares of m l sqrt(g l),
    # l the leg's length
    capture_moment: float | None = None
    # in the plane instead, least and most of flips backward, then forward (measured: with which
    # most robots unlike their model stand); of robots that move in the plane alone, and of others
    capture_in_plane: tuple[float, float, float, float] = (0.045, 0.065, 0.070, 0.116)
    capture_even: tuple[float, float, float, float] = (0.0, 0.02, 0.07, 0.09)
    # of the speed limit and of the peak torque, in the last :data:`LATE_SHARE` of the flight,
    # where they are less
    opening_speed_share: float = 1.0
    opening_torque_share: float = 1.0
    # where left and right move differently
    side_margin_m: float = 0.02  # CoP inside the sole's sides
    torsion_arm_m: float = 0.045  # on which friction resists the spin of a foot
    foot_share: float = 0.15  # of the weight, on each flat foot at least
    knee_rad: float = 2.2  # flexion at most: deeper squats end on one leg
    roll_rad: float = 1.0  # of the base, far from the chart's end at a quarter turn
    # of the stance's distance between left and right leg, seen from the trunk
    sides_share: float = 0.45
    hands_inward_m: float = 0.05  # by which hands may be further in than in the stance
    link_distance_m: float = 0.003  # between links that came too close without it
    # a sole's speed along the ground over that towards it: above the friction it slides
    touchdown_slope: float = 0.42
    touchdown_turning: float = (
        4.0  # [rad/s] of trunk and feet about the vertical besides, per half turn after the first
    )
    touchdown_roll: float = 0.10  # [rad] of the base, either way
    touchdown_yaw: float = 0.20  # [rad] of the base against the feet, either way
    # where stage 1 is followed
    momentum_share: float = 0.01  # L at take-off within this share of stage 1's
    momentum_slack: float = 0.02  # ... or within this [kg m^2/s], for jumps with little L

    def of_clip(self) -> Limits:
        """The same for a motion that follows another one, whose legs and arms are its own."""
        return replace(
            self,
            straight_knee_rad=0.25,
            sides_share=0.3,
            hands_inward_m=1.0,
            link_distance_m=0.008,  # its arms are near its legs for long, also between nodes
        )

    def of_size(self, size: Size) -> Limits:
        """Those of a robot of another ``size``, whose jumps they make alike; edges of platforms
        are the world's, and how long a flight may last depends on gravity. Links of small robots
        keep :data:`LINKS_LEAST_M` apart.
        """
        scaled = size.scaled(self, LIMIT_UNITS)
        kept = max(scaled.link_distance_m, LINKS_LEAST_M)
        return replace(scaled, link_distance_m=kept)

    def of_flip(self) -> Limits:
        """The same for a jump that turns over: time to wind up, a trunk that arrives turning,
        caught by momentum.
        """
        return replace(
            self,
            flat_s=(0.25, 1.3),
            toe_s=(0.06, 0.45),  # a front flip leans over the toes before it brakes on them
            least_push=0.04,  # or high flips hop first
            body_clearance_m=0.06,
            momentum_share=0.15,  # stage 1's rod turns with other inertia than the body
            touchdown_trunk_rate=5.0,  # the trunk cannot stop while L stays what the turn needed
            touchdown_side_rate=5.0,
            touchdown_foot_rate=8.0,
            touchdown_waist_rad=0.5,  # it opens with the legs
            # an ankle at its stop cannot keep a tilted robot's soles flat
            touchdown_ankle_stroke=0.12,
            capture_moment=0.047,
        )


@dataclass(frozen=True)
class Weights:
    """Cost weights, integrated over time. Units: [1] / [unit of the term]^2 / [s]."""

    acceleration: float = 2e-3  # [1] / [rad/s^2]^2 / [s]
    jerk: float = 2e-7  # [1] / [rad/s^3]^2 / [s]
    torque: float = 2e-4  # [1] / [N m]^2 / [s]
    force: float = 1e-5  # [1] / [N]^2 / [s], of each corner's generators
    # [1] / [rad]^2 / [s], of a waist and of arms above it, but for their swing: a waist at its stop
    # can hold no trunk at touchdown, and bent it meets the thighs
    posture: float = 30.0
    mirror: float = 10.0  # [1] / [rad]^2 / [s], of jumps straight ahead
    track_velocity: float = 200.0  # [1] / [m/s]^2 / [s]
    # inertia and momentum in shares of the stance's, so that weights mean the same for robots of
    # any size
    # [1] / [share]^2 / [s]; tracking it is the task of the paper's flight
    track_inertia: float = 6800.0
    # [1] / [share/s]^2 / [s], in launch, whose end is faster than legs can be
    track_inertia_rate: float = 23.0
    # the same in flight; less, and arms swing the other way and miss by 6 %
    track_flight_inertia_rate: float = 136.0
    # [1] / [share/s]^2 / [s]; with a tenth of it L misses stage 1's by 6 to 9 % of its peak, rms
    track_momentum: float = 4500.0
    heel_velocity: float = 0.5  # [1] / [m/s]^2 / [s]
    ankle_rate: float = 0.02  # [1] / [rad/s]^2 / [s]
    track_duration: float = 50.0  # [1] / [s]^2

    # where a given motion is followed
    follow_joints: float = 50.0  # [1] / [rad]^2 / [s]
    follow_base: float = 100.0  # [1] / [m]^2 / [s]
    follow_attitude: float = 60.0  # [1] / [rad]^2 / [s]
    follow_takeoff: float = 0.0  # [1] / [m/s]^2, of the vertical speed that a target's rise needs
    follow_duration: float = 100.0  # [1], of the share by which a phase is longer or shorter
    # [1] / [m, rad]^2; with an eightieth of it feet are shuffled instead of jumped
    follow_foothold: float = 2000.0

    def of_clip(self) -> Weights:
        """The same for a motion that follows another one: what it costs counts less.

        Waist and arms are followed with the other joints; some more weight settles them sooner.
        """
        return replace(self, acceleration=2e-4, jerk=3e-7, torque=5e-5, posture=15.0)

    def of_size(self, size: Size) -> Weights:
        """Those of a robot of another ``size``: each term has the same share of the cost."""
        return size.scaled(self, WEIGHT_UNITS)

    def of_flip(self) -> Weights:
        """The same for a jump that turns over: stage 1's inertia, of a rod that turns as one, is
        only a hint.
        """
        return replace(
            self,
            track_velocity=20.0,
            track_inertia=45.4,
            track_inertia_rate=0.454,
            track_flight_inertia_rate=0.454,
            track_momentum=45.4,
        )


# the audit's 1 mm, and 1 mm by which links may be nearer than their row before it is met
LINKS_LEAST_M = 0.002
# of the numbers that grow with the robot
LIMIT_UNITS = {
    name: "m" for name in vars(Limits()) if name.endswith("_m") and not name.startswith("edge_")
}
LIMIT_UNITS |= dict.fromkeys(("flat_s", "toe_s", "capture_slope_s"), "s")
LIMIT_UNITS |= {
    name: "rad/s" for name in vars(Limits()) if name.startswith("touchdown_") and "_rate" in name
}
LIMIT_UNITS |= {"heel_jerk": "rad/s^2", "touchdown_turning": "rad/s", "momentum_slack": "N m s"}
WEIGHT_UNITS = {
    "acceleration": "(rad/s^2)^-2/s",
    "jerk": "(rad/s^3)^-2/s",
    "torque": "(N m)^-2/s",
    "force": "N^-2/s",
    "posture": "1/s",
    "mirror": "1/s",
    "track_velocity": "(m/s)^-2/s",
    "track_inertia": "1/s",
    "track_inertia_rate": "s",
    "track_flight_inertia_rate": "s",
    "track_momentum": "s",
    "heel_velocity": "(m/s)^-2/s",
    "ankle_rate": "s",
    "track_duration": "s^-2",
    "follow_joints": "1/s",
    "follow_base": "m^-2/s",
    "follow_attitude": "1/s",
    "follow_takeoff": "(m/s)^-2",
    "follow_foothold": "m^-2",
}


@dataclass(frozen=True)
class Mesh:
    """Intervals per phase of a jump; coarse, for the tape is exact between the nodes."""

    flat: int = 12
    toe: int = 8
    flight: int = 12

    def __post_init__(self):
        for name, n in self.intervals().items():
            if isinstance(n, bool) or not isinstance(n, int) or n < 2:
                raise InputError(
                    f"mesh: {name} = {quoted(n)} intervals, must be a whole number of 2 or more"
                )

    def of_flip(self) -> Mesh:
        """The same for a jump that turns over: it winds up longer, and turns faster."""
        return Mesh(3 * self.flat, 2 * self.toe, round(2.5 * self.flight))

    def intervals(self) -> dict[str, int]:
        """By the names of the phases."""
        return dict(vars(self))

    def nodes(self, split: float, takeoff: float, end: float) -> dict[str, np.ndarray]:
        """Times of the nodes [s] from the start of the launch, by the ends of the phases."""
        ends = {"flat": (0.0, split), "toe": (split, takeoff), "flight": (takeoff, end)}
        return {name: np.linspace(*ends[name], n + 1) for name, n in self.intervals().items()}
