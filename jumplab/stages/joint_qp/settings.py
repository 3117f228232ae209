"""Gains, weights and limits of stage 2's QPs. The paper prints none of these numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumplab.task import FRICTION


@dataclass(frozen=True)
class Gain:
    """PD feedback: stiffness [1/s^2] and damping [1/s] (for momentum: only damping)."""

    stiffness: float
    damping: float

    def back(self, error: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Acceleration (...,) that takes an ``error`` (...,) with its ``rate`` (...,) away."""
        return -self.stiffness * error - self.damping * rate


@dataclass(frozen=True)
class Gains:
    """Feedback around the feed-forward references (Sec. IV-B: "PD controllers cooperating with
    feedforward").

    All are critically damped: 20 rad/s where a reference is followed (steps of 10 ms ring with 50),
    30 for the CoM, which must be back on its way at take-off, 5 to 10 where something is only
    suggested.
    """

    com: Gain = Gain(900.0, 60.0)
    momentum: Gain = Gain(0.0, 20.0)
    inertia: Gain = Gain(400.0, 40.0)
    foot: Gain = Gain(400.0, 40.0)
    posture: Gain = Gain(25.0, 10.0)
    trunk: Gain = Gain(25.0, 10.0)
    foot_level: Gain = Gain(100.0, 20.0)
    # Baumgarte: tiptoes, flat feet and the symmetry of left and right
    contact: Gain = Gain(400.0, 40.0)
    # Baumgarte in flight: CoM and momentum back to their ballistic values
    momentum_drift: Gain = Gain(100.0, 20.0)
    ground: Gain = Gain(400.0, 40.0)  # barrier of heel and toe above the ground


@dataclass(frozen=True)
class LaunchWeights:
    """Weights of the launch QP's squared terms."""

    com: float = 1.0  # [cost] / [m/s^2]^2, A_c theta'' + B_c - c''_ref
    # [cost] / [N]^2, linear rows of A_f F - B_f; about 1/m^2 of com, so as strong
    force: float = 1e-3
    # both forwards, feet flat: on the toes an error in x grows as in a falling pendulum
    com_x: float = 900.0
    force_x: float = 0.9
    # [cost] / [N m]^2, angular rows of A_f F - B_f; L is what the flight cannot mend
    moment: float = 50.0
    # [cost] / [kg m^2/s^2]^2, feet flat; a hip at its stop then keeps rho, not the CoM's height
    inertia: float = 0.05
    # the same on the toes: more drives the ankle to its speed limit and costs speed
    inertia_toe: float = 1.2e-4
    # [s] before the heel rises, from the one to the other: the CoM's height returns
    inertia_fade_s: float = 0.2
    posture: float = 1e-4  # [cost] / [rad/s^2]^2, joints towards the stance with swung arms
    trunk: float = 1e-4  # [cost] / [rad/s^2]^2, trunk towards its posture
    wrench: float = 1e-6  # [cost] / [N, N m]^2, regulariser: shares the load between the feet
    # [cost] / [m/s^2, rad/s^2]^2, regulariser: makes the Hessian regular
    acceleration: float = 1e-5


@dataclass(frozen=True)
class FlightWeights:
    """Weights of the flight QP's squared terms."""

    foot: float = 1.0  # [cost] / [m/s^2]^2, J_rd theta'' + drift - p''_rd
    # [cost] / [kg m^2/s^2]^2, J_rho theta'' + drift - rho''_ref
    inertia: float = 1.0
    foot_level: float = 1e-2  # [cost] / [rad/s^2]^2, sole parallel to the ground
    posture: float = 1e-3  # [cost] / [rad/s^2]^2, joints towards the stance
    trunk: float = 1e-4  # [cost] / [rad/s^2]^2, trunk towards its posture
    acceleration: float = 1e-6  # [cost] / [m/s^2, rad/s^2]^2, regulariser


@dataclass(frozen=True)
class Limits:
    """Limits of ground and joints for the motion; a family of rows is switched off by the name of
    its term.
    """

    friction: float = FRICTION
    torque_share: float = 1.0  # of the peak torque, with the speed line of the actuator
    range_margin_rad: float = 0.01  # to the joint stops
    # [1/s]: a stop is approached at most at this times the angle left, so it comes as no shock
    stop_rate: float = 20.0
    # of the peak torque, with which a joint, moving alone in the stance, brakes before a stop
    stop_share: float = 0.5
    near_ground_m: float = 0.03  # below this height the heel (and in flight the toe) must not sink


@dataclass(frozen=True)
class Options:
    """Everything adjustable about stage 2 but its terms, see :func:`.terms.changed_problem`."""

    gains: Gains = Gains()
    launch: LaunchWeights = LaunchWeights()
    flight: FlightWeights = FlightWeights()
    limits: Limits = Limits()
    # shoulder angle of the posture that the joints lean towards, forward negative: arms swing up
    arm_rad: float = -1.5
