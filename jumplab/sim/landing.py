"""Landing controller: a whole-body QP in torque mode, entered at touchdown.

The paper lands with the controller of an earlier paper of its authors (Sec. VI-A) and does not repeat it. Here, every
2 ms, joint accelerations and foot wrenches are chosen that obey the base dynamics, friction, the soles' edges and the
motors' torques, and come closest to a list of wishes: CoM, angular momentum, trunk, feet flat and still, posture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from proxsuite import proxqp

from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.sim.kinematics import Gauge
from jumplab.sim.playback import Actuators
from jumplab.sim.reference import Reference
from jumplab.sim.step import RecoveryStep


class BodyTerms:
    """Quantities at one state (``update``); unknowns are x = (accelerations, wrench left, wrench right).

    Wrenches act at the middle of each sole, world axes, force then moment, in units of ``wrench_scale``.

    Attributes
    ----------
    mass : [kg];  standing_height : CoM above the soles in the stance [m];  pitch_rest : trunk pitch there [rad].
    posture_rest : (nv - 6,) joint angles of the stance.
    com, com_velocity : (3,) [m, m/s];  momentum : (3,) angular momentum about the CoM [kg m^2/s].
    trunk : (3, 3) attitude of the base;  soles : (2, 3) their middles;  attitudes : (2, 3, 3);  twists : (2, 6).
    sole_rows, sole_drift : (2, 6, nx) and (2, 6), acceleration of the sole = rows @ x + drift.
    base_rows, base_offset : (6, nx) and (6,), the unactuated dynamics: rows @ x + offset = 0.
    torque_rows, torque_offset : (nv - 6, nx) and (nv - 6,), torque = rows @ x + offset.
    force_rows : (3, nx), CoM acceleration = rows @ x + gravity;  momentum_rows : (3, nx), rate of ``momentum``.
    """

    def __init__(self, robot: Robot, wrench_scale: float):
        self._gauge, self._scale = Gauge(robot), wrench_scale
        self.nv = nv = robot.model.nv
        self.nx = nx = nv + 12
        self.mass, self.gravity = robot.total_mass, robot.model.gravity.linear.copy()
        rest = stance_configuration(robot)
        self.posture_rest, self.pitch_rest = rest[7:].copy(), float(robot.stance["trunk_pitch_rad"])
        self.standing_height = float(self._gauge.com(rest)[2])
        self.soles, self.attitudes, self.twists = np.zeros((2, 3)), np.zeros((2, 3, 3)), np.zeros((2, 6))
        self.sole_rows, self.sole_drift = np.zeros((2, 6, nx)), np.zeros((2, 6))
        self.force_rows, self.momentum_rows = np.zeros((3, nx)), np.zeros((3, nx))
        self._dynamics, self._zero = np.zeros((nv, nx)), np.zeros(nv)

    def update(self, q: np.ndarray, v: np.ndarray, point: np.ndarray | None = None) -> None:
        """Evaluate everything at (q, v), before :meth:`set_contact`; the soles' at another ``point`` (3,) than their
        middle, in the axes of the foot link.
        """
        point = self._gauge.robot.foot.center if point is None else point
        model, data = self._gauge.model, self._gauge.data
        pin.computeAllTerms(model, data, q, v)
        pin.forwardKinematics(model, data, q, v, self._zero)
        self.com, self.com_velocity = data.com[0].copy(), data.vcom[0].copy()
        self.momentum, self.trunk = data.hg.angular.copy(), data.oMi[1].rotation.copy()
        self._dynamics[:, : self.nv] = data.M
        self.base_rows, self.torque_rows = self._dynamics[:6], self._dynamics[6:]
        self.base_offset, self.torque_offset = data.nle[:6], data.nle[6:]
        for side, frame in enumerate(self._gauge.frames):
            self._sole(side, frame, point)

    def set_contact(self, contact: np.ndarray) -> None:
        """Let only the feet flagged in ``contact`` (2,) transmit wrenches."""
        for side in (0, 1):
            at = slice(self.nv + 6 * side, self.nv + 6 * side + 6)
            on = self._scale * float(contact[side])
            self._dynamics[:, at] = -on * self.sole_rows[side, :, : self.nv].T
            self.force_rows[:, at][:, :3] = on / self.mass * np.eye(3)
            self.momentum_rows[:, at] = on * np.hstack([pin.skew(self.soles[side] - self.com), np.eye(3)])

    def _sole(self, side: int, frame: int, point: np.ndarray) -> None:
        """Kinematics of one sole's ``point``, world axes."""
        model, data, axes = self._gauge.model, self._gauge.data, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        place = pin.updateFramePlacement(model, data, frame)
        arm = place.rotation @ point
        jacobian = pin.getFrameJacobian(model, data, frame, axes)
        jacobian[:3] -= pin.skew(arm) @ jacobian[3:]
        velocity = pin.getFrameVelocity(model, data, frame, axes)
        drift = pin.getFrameClassicalAcceleration(model, data, frame, axes)
        w, spin = velocity.angular, pin.skew(velocity.angular)
        self.soles[side], self.attitudes[side] = place.translation + arm, place.rotation
        self.twists[side] = np.concatenate([velocity.linear + spin @ arm, w])
        self.sole_rows[side, :, : self.nv] = jacobian
        linear = drift.linear + pin.skew(drift.angular) @ arm + spin @ (spin @ arm)
        self.sole_drift[side] = np.concatenate([linear, drift.angular])

    def torque(self, x: np.ndarray) -> np.ndarray:
        """Joint torques (nv - 6,) that go with the unknowns ``x`` [N m]."""
        return self.torque_rows @ x + self.torque_offset

    def gravity_torque(self, contact: np.ndarray) -> np.ndarray:
        """Joint torques (nv - 6,) that hold the weight on the standing feet if nothing moves [N m]."""
        x = np.zeros(self.nx)
        share = self.mass * -self.gravity[2] / self._scale / max(1, int(np.sum(contact)))
        for side in np.flatnonzero(contact):
            x[self.nv + 6 * side + 2] = share
        return self.torque(x)


class BodyQp:
    """The QP over the unknowns x of :class:`BodyTerms`, posed anew at every state.

    Equations are the dynamics of the base, bounds what the motors can give and what the soles can carry. ``solves`` and
    ``failures`` count the QPs posed, and those without a solution.
    """

    def __init__(self, robot: Robot, body: BodyTerms):
        self._body, self._actuators = body, Actuators(robot)
        self.solves = self.failures = 0
        self.solver = proxqp.dense.QP(body.nx, 6, len(robot.joint_names) + CORNER_ROWS)
        self.solver.settings.eps_abs, self.solver.settings.max_iter = TOLERANCE, MAX_ITERATIONS

    def solve(
        self,
        wishes: tuple[np.ndarray, np.ndarray, np.ndarray],
        diagonal: np.ndarray,
        linear: np.ndarray,
        corners: np.ndarray,
        v: np.ndarray,
        *,
        offset: np.ndarray | None = None,
        coupling: np.ndarray | float = 0.0,
    ) -> np.ndarray | None:
        """The x (nx,) that comes closest to what is wished, or None if the solver does not report success.

        ``wishes`` are rows (k, nx), targets (k,) and weights (k,) of squares; to these come the diagonal (nx,) of a
        quadratic form and a linear form (nx,), and ``coupling`` (12, 12) of the wrenches. ``corners`` are the rows of
        :func:`corner_rows`, ``v`` (nv,) is measured; ``offset`` (6,) is the body's, or that of one loaded otherwise.
        """
        body, (rows, targets, weights) = self._body, wishes
        weighted = rows * weights[:, None]  # (k, nx)
        hessian, linear = weighted.T @ rows, linear - weighted.T @ targets
        hessian[np.diag_indices(body.nx)] += diagonal
        hessian[body.nv :, body.nv :] += coupling
        low, high = self._actuators.range(v[6:])
        matrix = np.vstack([body.torque_rows, corners])
        lower = np.concatenate([low - body.torque_offset, np.zeros(CORNER_ROWS)])
        upper = np.concatenate([high - body.torque_offset, np.full(CORNER_ROWS, UNBOUNDED)])
        pose = self.solver.update if self.solves else self.solver.init
        pose(hessian, linear, body.base_rows, -(body.base_offset if offset is None else offset), matrix, lower, upper)
        self.solves += 1
        self.solver.solve()
        if self.solver.results.info.status != proxqp.QPSolverOutput.PROXQP_SOLVED:
            self.failures += 1
            return None
        return self.solver.results.x


# The paper prints none of these numbers.
PERIOD_STEPS = 2  # 500 Hz
WRENCH_SCALE = 100.0  # [N] unit of the wrench variables, so that all unknowns are of order 1 to 10
CONTACT_FORCE_N = 10.0  # a foot stands if it carries more than 2.5 % of the weight ...
LIKELY = 3.0  # [1] ... and so many standard deviations of a poor sensor ...
CONTACT_HOLD_S = 0.008  # ... and for so long after it last did; flicker of the flag makes robots fall
NEAR_GROUND_M = 0.02  # a foot that bounced less than this is pressed down again, not swung
SOLE_SHARE = 0.95, 0.5  # of the sole's length and width for the wished CoP; more width lets robots roll onto an edge
PLANNED_FRICTION = 0.45  # below the lowest floor friction of the perturbed trials, 0.5
NOMINAL_INERTIA = 5.0  # [kg m^2] pitch inertia of the landed robot, turns a momentum rate into rad/s^2
STOP_MARGIN_RAD = 0.05  # a stop is respected this far before it
STOP_HORIZON_S = 0.05  # a joint that would reach it within this time is turned back ...
STOP_LEAVE = 10.0  # [rad/s^2] ... and if it is wished elsewhere, at least so much
SPIN_FRICTION = 0.04  # [m] friction coefficient times the mean lever of the sole, about 0.07 m
SPIN_HALF_WIDTH_M = 0.05  # of that sole: narrow ones turn on their edges under less
MAX_SHIFT, MAX_TURN = 60.0, 300.0  # [m/s^2], [rad/s^2] an impact must not make wishes that drown all others
MAX_STEP = 150.0  # [m/s^2] of a foot that steps: 0.5 m in 0.24 s begin with 50
CORNER_ROWS = 20  # of both feet
UNBOUNDED = 1e20  # ProxQP's infinity
TOLERANCE = 1e-6  # of residuals in N m, N and (r)m/s^2, far below what a motor can resolve
MAX_ITERATIONS = 300  # ten times what the hardest recorded QP took
TORQUE_DIGITS = 4  # [0.1 mN m] ProxQP's last digits depend on where its memory lies; rounded, runs are the same
FALLBACK_DAMPING = 3.0  # [N m s/rad] stable at 500 Hz on the lightest joint
UNEVEN = np.kron([[1.0, -1.0], [-1.0, 1.0]], np.eye(6))  # (12, 12), squared difference of the two wrenches


@dataclass(frozen=True)
class LandingGains:
    """Natural frequencies [rad/s] of critically damped wishes, and their weights; the paper prints none.

    Weights are [1 / (m/s^2)^2] or [1 / (rad/s^2)^2], found by landing from states around the plan's touchdown.
    """

    com_rate_xy: float = 4.0  # the pendulum's own sqrt(g/z) = 4: faster would ask for a longer sole
    com_rate_z: float = 6.0  # stops 2 m/s within 0.12 m
    momentum_rate: float = 8.0
    trunk_rate: float = 7.0
    foot_rate: float = 25.0
    posture_rate: float = 8.0
    com_weight: tuple[float, float, float] = (30.0, 10.0, 30.0)  # z: a late push meets the end of the knee's stroke
    momentum_weight: float = 0.5  # of L-rate over a nominal inertia, hence also rad/s^2
    trunk_weight: float = 0.5
    foot_weight: tuple[float, float] = (20.0, 0.5)  # displacement, turning
    swing_weight: tuple[float, float] = (1.0, 0.05)
    step_weight: tuple[float, float] = (20.0, 0.5)  # of a foot in a recovery step
    arm_posture_weight: float = 0.02
    leg_posture_weight: float = 0.002  # pitch joints; feet, CoM and trunk decide them already
    lateral_posture_weight: float = 0.2  # yaw and roll joints
    stop_weight: float = 1.0
    uneven_weight: float = 0.02  # [1 / (100 N)^2] of the difference between both wrenches
    wrench_weight: float = 1e-3  # [1 / (100 N)^2]
    acceleration_weight: float = 1e-4


class LandingController:
    """Torques that catch and hold the robot; see the module's docstring.

    ``robot`` is as planned: the controller knows no perturbation. ``reference`` is followed if given; otherwise
    spring-dampers lead to the middle of the feet at standing height. ``qp`` counts the QPs posed and those
    without a solution. With ``may_step`` it takes one step, ``step``, where its feet alone cannot catch the
    robot; what was planned ends there. Forces of the feet err by ``force_noise_n`` [N] each.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        reference: Reference | None = None,
        gains: LandingGains | None = None,
        may_step: bool = False,
        force_noise_n: float = 0.0,
    ):
        self._loaded_n = max(CONTACT_FORCE_N, LIKELY * force_noise_n)
        self.reference, self.gains = reference, gains or LandingGains()
        self.step = RecoveryStep(robot, SOLE_SHARE, force_noise_n) if may_step else None
        self._terms, self._actuators = BodyTerms(robot, WRENCH_SCALE), Actuators(robot)
        self.qp = BodyQp(robot, self._terms)
        self._posture_weight, self._corners = self._posture_weights(robot), _corner_rows(robot)
        self._last_contact = np.full(2, -np.inf)

    def _posture_weights(self, robot: Robot) -> np.ndarray:
        arms, pitch = robot.joints["shoulder_pitch"], {name for pair in robot.joints.values() for name in pair}
        g, names = self.gains, robot.joint_names
        legs = [g.leg_posture_weight if name in pitch else g.lateral_posture_weight for name in names]
        return np.where(np.isin(names, arms), g.arm_posture_weight, legs)

    def torque(self, time: float, q: np.ndarray, v: np.ndarray, foot_force: np.ndarray) -> np.ndarray:
        """Joint torques (nv - 6,) [N m], ``time`` after touchdown, from measured state and vertical foot forces."""
        body = self._terms
        body.update(q, v)
        if self.step is not None:
            self.step.look(time, body, np.asarray(foot_force))
            if self.stepped:
                self.reference = None
        body.set_contact(contact := self._contact(time, np.asarray(foot_force)))
        x = self._solve(*self._wishes(time, q, v, contact), v)
        tau = -FALLBACK_DAMPING * v[6:] + body.gravity_torque(contact) if x is None else body.torque(x)
        return np.clip(np.round(tau, TORQUE_DIGITS), *self._actuators.range(v[6:]))

    @property
    def stepped(self) -> bool:
        """Whether the recovery step has begun."""
        return self.step is not None and self.step.began_s is not None

    def _swings(self, side: int) -> bool:
        return self.step is not None and self.step.side == side

    def _contact(self, time: float, foot_force: np.ndarray) -> np.ndarray:
        """Which feet (2,) may carry weight: those that did a moment ago, and any that hovers just beside one."""
        self._last_contact[foot_force > self._loaded_n] = time
        if self.step is not None and self.step.side is not None:
            return np.arange(2) != self.step.side
        loaded = time - self._last_contact <= CONTACT_HOLD_S
        if not loaded.any():
            return loaded
        height = self._terms.soles[:, 2]
        return loaded | (height - height[loaded].min() < NEAR_GROUND_M)

    def _wishes(self, time, q, v, contact):
        """Least-squares rows (k, nx), targets (k,), weights (k,); wishes on joint accelerations and their weights."""
        g, body = self.gains, self._terms
        ground = body.soles[contact] if contact.any() else body.soles
        com_wish, momentum_wish = self._balance(time, ground.mean(axis=0))
        if self.step is not None and self.step.side is not None:
            com_wish[:2] = self.step.com_acceleration(body)
        trunk_rows = np.zeros((3, body.nx))
        trunk_rows[:, 3:6] = np.eye(3)
        rows = [body.force_rows, body.momentum_rows / NOMINAL_INERTIA, trunk_rows]
        targets = [com_wish - body.gravity, momentum_wish / NOMINAL_INERTIA, self._trunk_wish(v)]
        on = float(contact.any())  # in the air neither CoM nor momentum can be asked for
        weights = [on * np.array(g.com_weight), np.full(3, on * g.momentum_weight), np.full(3, g.trunk_weight)]
        for side in (0, 1):
            rows.append(body.sole_rows[side])
            wish = self._foot_wish(side, contact[side], ground[:, 2].min())
            if self._swings(side):
                wish[:3] = np.clip(self.step.foot_acceleration(time, body), -MAX_STEP, MAX_STEP)
            targets.append(wish - body.sole_drift[side])
            in_air = g.step_weight if self._swings(side) else g.swing_weight
            weights.append(np.repeat(g.foot_weight if contact[side] else in_air, 3))
        return np.vstack(rows), np.concatenate(targets), np.concatenate(weights), *self._posture(q, v)

    def _balance(self, time, foot_middle):
        """Wished CoM acceleration (3,) and rate of angular momentum (3,)."""
        g, body = self.gains, self._terms
        rate = np.array([g.com_rate_xy, g.com_rate_xy, g.com_rate_z])
        goal = foot_middle + np.array([0.0, 0.0, body.standing_height])
        speed, momentum, push, twist = np.zeros((4, 3))
        if self.reference is not None:
            com, com_rate, momentum[1] = self.reference.at(time)
            goal[[0, 2]], speed[[0, 2]] = foot_middle[[0, 2]] + com, com_rate
            push[[0, 2]], twist[1] = self.reference.feed_forward(time)
        wish = push + rate**2 * (goal - body.com) + 2 * rate * (speed - body.com_velocity)
        return wish, twist + g.momentum_rate * (momentum - body.momentum)

    def _trunk_wish(self, v):
        """Angular acceleration (3,) of the trunk in its own axes: upright in roll and pitch, yaw only damped."""
        g, trunk = self.gains, self._terms.trunk
        heading = np.arctan2(trunk[1, 0], trunk[0, 0])
        goal = pin.rpy.rpyToMatrix(0.0, self._terms.pitch_rest, heading)
        return g.trunk_rate**2 * pin.log3(trunk.T @ goal) - 2 * g.trunk_rate * v[3:6]

    def _foot_wish(self, side, standing, ground_height):
        """Acceleration (6,) of a sole: flat and still; a foot in the air is also led down to the ground."""
        g, body = self.gains, self._terms
        attitude, twist = body.attitudes[side], body.twists[side]
        goal = pin.rpy.rpyToMatrix(0.0, 0.0, np.arctan2(attitude[1, 0], attitude[0, 0]))
        turn = g.foot_rate**2 * pin.log3(goal @ attitude.T) - 2 * g.foot_rate * twist[3:]
        shift = -2 * g.foot_rate * twist[:3]
        if not standing:
            shift[:2] = -2 * g.foot_rate * (twist[:2] - body.com_velocity[:2])
            shift[2] += g.foot_rate**2 * (ground_height - body.soles[side, 2])
        return np.concatenate([np.clip(shift, -MAX_SHIFT, MAX_SHIFT), np.clip(turn, -MAX_TURN, MAX_TURN)])

    def _posture(self, q, v):
        """Wished joint accelerations (nv - 6,) and their weights; near a stop the wish is to turn back in time."""
        g, motors = self.gains, self._actuators
        wish = g.posture_rate**2 * (self._terms.posture_rest - q[7:]) - 2 * g.posture_rate * v[6:]
        weight = self._posture_weight.copy()
        ahead = q[7:] + v[6:] * STOP_HORIZON_S
        for stop, side in ((motors.lower + STOP_MARGIN_RAD, 1.0), (motors.upper - STOP_MARGIN_RAD, -1.0)):
            needed = side * 2 * (stop - ahead) / STOP_HORIZON_S**2
            near = needed > 0
            away = np.clip(side * wish, 0.0, STOP_LEAVE)  # or a joint that is to go back would rest just there
            wish[near] = side * np.clip(np.maximum(needed, away), 0.0, MAX_TURN)[near]
            weight[near] = g.stop_weight
        return wish, weight

    def _solve(self, rows, targets, weights, joint_wish, joint_weight, v):
        """Unknowns x (nx,) of the QP, or None if the solver does not report success."""
        g, nv = self.gains, self._terms.nv
        diagonal = np.concatenate([np.full(nv, g.acceleration_weight), np.full(12, g.wrench_weight)])
        diagonal[6:nv] += joint_weight
        linear = np.zeros(self._terms.nx)
        linear[6:nv] -= joint_weight * joint_wish
        wishes, coupling = (rows, targets, weights), g.uneven_weight * UNEVEN
        return self.qp.solve(wishes, diagonal, linear, self._corners, v, coupling=coupling)


def _corner_rows(robot: Robot) -> np.ndarray:
    foot = robot.foot
    return corner_rows(
        robot, PLANNED_FRICTION, SOLE_SHARE[0] * (foot.toe - foot.heel) / 2, SOLE_SHARE[1] * foot.half_width
    )


def corner_rows(robot: Robot, friction: float, half_length: float, half_width: float) -> np.ndarray:
    """Rows r (20, nx) with r @ x >= 0: friction, CoP inside the sole and turning friction of both wrenches."""
    foot, mu = robot.foot, friction / np.sqrt(2)
    spin = SPIN_FRICTION * (1.0 if robot.planar else foot.half_width / SPIN_HALF_WIDTH_M)
    one, rows = np.zeros((10, 6)), np.zeros((CORNER_ROWS, robot.model.nv + 12))
    one[:, 2] = np.repeat([mu, mu, half_width, half_length, spin], 2)
    one[range(10), np.repeat([0, 1, 3, 4, 5], 2)] = np.tile([1.0, -1.0], 5)
    rows[:10, -12:-6] = rows[10:, -6:] = one
    return rows
