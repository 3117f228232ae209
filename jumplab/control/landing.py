"""Landing controller: a whole-body QP in torque mode, entered at touchdown.

The paper lands with the controller of an earlier paper of its authors (Sec. VI-A) and does not
repeat it. Here, every 4 ms (2 in flips), joint accelerations and foot wrenches are chosen that obey
the base dynamics, friction, the soles' edges and the motors' torques, and come closest to a list of
wishes: CoM, angular momentum, trunk, feet flat and still, posture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.control.body import WholeBody, corner_rows, solver
from jumplab.control.kinematics import Gauge
from jumplab.control.step import RecoveryStep
from jumplab.ocp.qp import Qp
from jumplab.robot import Robot
from jumplab.robot.contact import Anchor
from jumplab.robot.stance import leg_length, stance_configuration
from jumplab.stages.srmp.landing import LandingPlan

CONTACT_FORCE_N = 10.0  # a foot stands if it carries more than 2.5 % of the weight ...
LIKELY = 3.0  # [1] ... and so many standard deviations of a poor sensor ...
# ... and for so long after it last did; flicker of the flag makes robots fall
CONTACT_HOLD_S = 0.008
NEAR_GROUND_M = 0.02  # a foot that bounced less than this is pressed down again, not swung
# of the sole's length and width for the wished CoP; more width lets robots roll onto an edge
SOLE_SHARE = 0.95, 0.5
PLANNED_FRICTION = 0.45  # below the lowest floor friction of the perturbed trials, 0.5
STOP_MARGIN_RAD = 0.05  # a stop is respected this far before it
STOP_HORIZON_S = 0.05  # a joint that would reach it within this time is turned back ...
STOP_LEAVE = 10.0  # [rad/s^2] ... and if it is wished elsewhere, at least so much
# so close to its stop, a joint whose motor gives all but this leans on it: the stop bears the rest.
# Otherwise a trunk on the stop of a weak waist is believed to fall, and the pelvis is sent after it
TOUCH_RAD = 0.02
SPENT_N_M = 1e-3  # of a robot of the default one's size
# [m/s^2], [rad/s^2] an impact must not make wishes that drown all others
MAX_SHIFT = 60.0
MAX_TURN = 300.0
# [rad/s] a joint goes back to the stance: from far off it would be asked for an acceleration that
# the CoM pays for, three radians of an arm for all that the heels can hold
MAX_BACK = 3.0
MAX_STEP = 150.0  # [m/s^2] of a foot that steps: 0.5 m in 0.24 s begin with 50
# [0.1 mN m] ProxQP's last digits depend on where its memory lies; rounded, runs are the same
TORQUE_DIGITS = 4
FALLBACK_DAMPING = 1.5  # [N m s/rad] stable at 250 Hz on the lightest joint


@dataclass(frozen=True)
class LandingGains:
    """Natural frequencies [rad/s] of critically damped wishes, and their weights; the paper prints
    none.

    Weights are [1 / (m/s^2)^2] or [1 / (rad/s^2)^2], found by landing from states around the plan's
    touchdown.
    """

    com_rate_xy: float = 4.0  # the pendulum's own sqrt(g/z) = 4: faster would ask for a longer sole
    com_rate_z: float = 6.0  # stops 2 m/s within 0.12 m
    momentum_rate: float = 8.0
    trunk_rate: float = 7.0
    foot_rate: float = 25.0
    posture_rate: float = 8.0
    # z: a late push meets the end of the knee's stroke
    com_weight: tuple[float, float, float] = (30.0, 10.0, 30.0)
    momentum_weight: float = 0.5  # of L-rate over a nominal inertia, hence also rad/s^2
    trunk_weight: float = 0.5
    foot_weight: float = 20.0  # of a foot that stands, or takes a recovery step
    foot_turning_weight: float = 0.5
    swing_weight: float = 1.0  # of one that is to come down
    swing_turning_weight: float = 0.05
    arm_posture_weight: float = 0.02
    leg_posture_weight: float = 0.002  # pitch joints; feet, CoM and trunk decide them already
    lateral_posture_weight: float = 0.2  # yaw and roll joints
    stop_weight: float = 1.0
    uneven_weight: float = 0.02  # [1 / (100 N)^2] of the difference between both wrenches
    wrench_weight: float = 1e-3  # [1 / (100 N)^2]
    acceleration_weight: float = 1e-4


GAINS = LandingGains()  # of a robot of size one
# their units, where a robot's size matters: natural frequencies, weights of angular accelerations
TURNING = "momentum trunk foot_turning swing_turning arm_posture leg_posture lateral_posture stop"
UNITS = {f"{name}_rate": "rad/s" for name in ("momentum", "trunk", "foot", "posture")}
UNITS |= {"com_rate_xy": "rad/s", "com_rate_z": "rad/s"}
UNITS |= {f"{name}_weight": "(rad/s^2)^-2" for name in TURNING.split()}


class LandingController:
    """Torques that catch and hold the robot; see the module's docstring.

    ``robot`` is as planned: the controller knows no perturbation. Without a
    ``reference``, spring-dampers lead to where the CoM stands above the feet. ``solver``
    counts the QPs posed and those without a solution. With ``may_step`` it takes a ``step``
    wherever its feet alone cannot catch the robot; what was planned ends there. Forces of the feet
    err by ``force_noise_n`` [N] each. ``gains`` are those of a robot of size one.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        reference: LandingPlan | None = None,
        may_step: bool = False,
        force_noise_n: float = 0.0,
        gains: LandingGains = GAINS,
    ):
        self._may_step = may_step
        self.body = body = WholeBody(robot)
        self.gains = body.size.scaled(gains, UNITS)
        self._horizon_s = body.size.of(STOP_HORIZON_S, "s")
        self._most_turn = body.size.of(MAX_TURN, "rad/s^2")
        self._most_back = body.size.of(MAX_BACK, "rad/s")
        self._leave = body.size.of(STOP_LEAVE, "rad/s^2")
        self._near_m = body.size.of(NEAR_GROUND_M, "m")
        self._spent = body.size.of(SPENT_N_M, "N m")
        self._most = np.repeat([MAX_SHIFT, self._most_turn], 3)
        self.step = RecoveryStep(robot, SOLE_SHARE, force_noise_n)
        self.solver = solver()
        self._loaded_n = max(body.size.of(CONTACT_FORCE_N, "N"), LIKELY * force_noise_n)
        g = self.gains
        self._com_rate = np.array([g.com_rate_xy, g.com_rate_xy, g.com_rate_z])
        # by side: of a foot that is in the air, and of one that stands or steps
        swings = g.swing_weight, g.swing_turning_weight
        stands = g.foot_weight, g.foot_turning_weight
        self._foot_weights = np.tile(np.repeat([swings, stands], 3, axis=1), (2, 1, 1))
        pitching = np.isin(robot.joint_names, [name for name, _, _ in robot.role_signs()])
        arms = np.isin(robot.joint_names, robot.joints["shoulder_pitch"])
        legs_weight = np.where(pitching, g.leg_posture_weight, g.lateral_posture_weight)
        self._posture_weight = np.where(arms, g.arm_posture_weight, legs_weight)
        self._corners = corner_rows(robot, PLANNED_FRICTION, *SOLE_SHARE)
        self._last_contact = np.full(2, -np.inf)
        self._leaning = np.zeros(len(robot.joint_names), bool)
        # [m] height of the lowest sole that was loaded last; before, both feet count as standing
        self._ground = np.inf
        # accelerations, wrenches, and what these differ by
        left, right = body.unknowns[-12:-6], body.unknowns[-6:]
        self._effort_rows = np.vstack([body.unknowns, left - right])
        weights = (g.acceleration_weight, g.wrench_weight, g.uneven_weight)
        self._effort_weight = np.repeat(weights, [body.nv, 12, 6])
        # where wrenches act, if not at the soles' middles
        self._anchors: Sequence[Anchor] | None = None
        rest = stance_configuration(robot)
        # posture to go to, and its rates and accelerations
        self._rest = rest[7:]
        self._rest_rates: np.ndarray | float = 0.0
        self._rest_push: np.ndarray | float = 0.0
        self._rest_pitch = float(robot.stance["trunk_pitch_rad"])
        gauge = Gauge(robot)
        soles = gauge.points(rest, robot.foot.center)
        # of the CoM from the middle of the soles, ahead and up
        self._above = gauge.com(rest) - soles.mean(axis=0)
        self._leg_m = leg_length(robot)
        left, right = soles[:, :2]
        self._apart_m = float(np.linalg.norm(left - right))
        self.reference = reference

    def torque(
        self, time: float, q: np.ndarray, v: np.ndarray, foot_force: np.ndarray
    ) -> np.ndarray:
        """Joint torques (nv - 6,) [N m], ``time`` after touchdown [s], from measured ``q`` (nq,),
        ``v`` (nv,) and vertical foot forces (2,) [N].
        """
        body = self.body
        body.update(q, v, self._anchors)
        if self._may_step:
            self.step.look(time, body, foot_force)
        if self.step.starts_s:
            self.reference = None
        contact = self.standing(time, foot_force)
        body.set_contact(contact)
        answer = self.solver.solve(self._program(time, q, v, contact))
        if answer.solved:
            tau = body.torque(answer.x)
            self._leaning = self._leans(q, v, tau)
        else:
            damping = body.size.of(FALLBACK_DAMPING, "N m s")
            tau = body.gravity_torque(contact) - damping * v[6:]
        low, high = body.motors.range(v[6:])
        return np.minimum(np.maximum(np.round(tau, TORQUE_DIGITS), low), high)

    def _leans(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Which joints (nv - 6,) rest on a stop, since their motors cannot give ``tau`` (nv - 6,)
        [N m].
        """
        motors = self.body.motors
        low, high = motors.range(v[6:])
        on_lower = (q[7:] < motors.lower + TOUCH_RAD) & (tau > high - self._spent)
        on_upper = (q[7:] > motors.upper - TOUCH_RAD) & (tau < low + self._spent)
        return on_lower | on_upper

    def standing(self, time: float, foot_force: np.ndarray) -> np.ndarray:
        """Which feet (2,) may carry weight: those whose ``foot_force`` (2,) [N] did a moment before
        ``time`` [s], and any that hovers just over the ground that the last one met.
        """
        self._last_contact[foot_force > self._loaded_n] = time
        if self.step.side is not None:
            return np.arange(2) != self.step.side
        loaded = time - self._last_contact <= CONTACT_HOLD_S
        height = self.body.soles[:, 2]
        if loaded.any():
            self._ground = height[loaded].min()
        return loaded | (height - self._ground < self._near_m)

    def _program(self, time: float, q: np.ndarray, v: np.ndarray, contact: np.ndarray) -> Qp:
        """The QP of one moment."""
        g = self.gains
        body = self.body
        qp = body.program(v, self._corners, leaning=self._leaning)
        ground = body.soles[contact] if contact.any() else body.soles
        middle = ground.mean(axis=0)
        if contact.all():
            middle[2] -= self._lower_m()
        *com, momentum, twist = self._goal(time, middle)
        com_wish = body.com_wish(*com, self._com_rate)
        momentum_wish = twist + g.momentum_rate * (momentum - body.momentum)
        if self.step.side is not None:
            com_wish[:2] = self.step.com_acceleration(body)
        on = float(contact.any())  # in the air neither CoM nor momentum can be asked for
        weights = on * np.array(g.com_weight), on * g.momentum_weight
        body.balance(qp, com_wish, momentum_wish, weights)
        qp.cost("trunk", body.unknowns[3:6], self._trunk_wish(v), g.trunk_weight)
        for side in (0, 1):
            wish = self._foot_wish(side, contact[side])
            weight = self._foot_weights[side, int(contact[side])]
            if side == self.step.side:
                wish[:3] = within(self.step.foot_acceleration(time, body), MAX_STEP)
                weight = self._foot_weights[side, 1]
            target = wish - body.sole_drift[side]
            qp.cost(f"foot {side}", body.sole_rows[side], target, weight)
        qp.cost("posture", body.unknowns[6:-12], *self.posture_wish(q, v))
        qp.cost("effort", self._effort_rows, 0.0, self._effort_weight)
        return qp

    def _lower_m(self) -> float:
        """By how much hips are lower over feet that stand further apart than in the stance, on legs
        as long as there [m]: legs that are straight cannot keep the robot from falling aside.
        """
        left, right = self.body.soles[:, :2]
        further = max(np.sum((left - right) ** 2) - self._apart_m**2, 0.0)
        return self._leg_m - np.sqrt(max(self._leg_m**2 - further / 4, 0.0))

    def _goal(self, time: float, foot_middle: np.ndarray) -> Sequence[np.ndarray]:
        """Place, velocity and acceleration of the CoM, angular momentum and its rate, (3,) each, to
        which the robot is led.
        """
        ahead = np.append(self.body.trunk[:2, 0], 0.0)
        goal = foot_middle + self._above[0] * ahead / np.linalg.norm(ahead)
        goal[2] += self._above[2]
        speed, momentum, push, twist = np.zeros((4, 3))
        if self.reference is not None:
            com, speed[[0, 2]], momentum[1] = self.reference.at(time)
            goal[[0, 2]] = foot_middle[[0, 2]] + com
            push[[0, 2]], twist[1] = self.reference.feed_forward(time)
        return goal, speed, push, momentum, twist

    def _trunk_wish(self, v: np.ndarray) -> np.ndarray:
        """Angular acceleration (3,) of the trunk in its own axes: upright in roll and pitch, yaw
        only damped.
        """
        rate = self.gains.trunk_rate
        trunk = self.body.trunk
        goal = pin.rpy.rpyToMatrix(0.0, self._rest_pitch, np.arctan2(trunk[1, 0], trunk[0, 0]))
        return rate**2 * pin.log3(trunk.T @ goal) - 2 * rate * v[3:6]

    def _foot_wish(self, side: int, standing: bool) -> np.ndarray:
        """Acceleration (6,) of a sole: flat and still; a foot in the air is also led down to the
        ground.
        """
        rate = self.gains.foot_rate
        body = self.body
        attitude = body.attitudes[side]
        wish = -2 * rate * body.twists[side]
        goal = pin.rpy.rpyToMatrix(0.0, 0.0, np.arctan2(attitude[1, 0], attitude[0, 0]))
        wish[3:] += rate**2 * pin.log3(goal @ attitude.T)
        if not standing:
            wish[:2] += 2 * rate * body.com_velocity[:2]
            wish[2] += rate**2 * (self._ground - body.soles[side, 2])
        return within(wish, self._most)

    def posture_wish(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Wished joint accelerations (nv - 6,) [rad/s^2] and their weights at q (nq,), v (nv,);
        near a stop the wish is to turn back in time.
        """
        rate = self.gains.posture_rate
        motors = self.body.motors
        back = within(rate / 2 * (self._rest - q[7:]), self._most_back)
        wish = self._rest_push + 2 * rate * (back + self._rest_rates - v[6:])
        weight = self._posture_weight.copy()
        ahead = q[7:] + v[6:] * self._horizon_s
        for stop, way in ((motors.lower, 1.0), (motors.upper, -1.0)):
            needed = 2 * (way * (stop - ahead) + STOP_MARGIN_RAD) / self._horizon_s**2
            near = needed > 0
            if near.any():
                # or a joint that is to go back would rest just there
                away = np.minimum(way * wish, self._leave)
                most = np.minimum(np.maximum(needed, away), self._most_turn)
                wish[near] = way * most[near]
                weight[near] = self.gains.stop_weight
        return wish, weight


def within(x: np.ndarray, most: np.ndarray | float) -> np.ndarray:
    """``x`` (n,) between -``most`` and ``most``; np.clip takes three times as long."""
    return np.minimum(np.maximum(x, -most), most)
