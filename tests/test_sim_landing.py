"""The landing controller alone: it stands, it catches, it obeys its limits, it survives a solver that fails."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import brentq

from jumplab.control import LandingController
from jumplab.control.body import PERIOD_STEPS, WRENCH_SCALE, WholeBody
from jumplab.control.landing import GAINS, MAX_BACK
from jumplab.control.playback import Command
from jumplab.control.servo import WholeBodyServo
from jumplab.ocp.qp import QpSolver
from jumplab.robot.stance import com_from_toe, configuration, stance_configuration
from jumplab.sim import BulletEngine


class Catch:
    """A robot dropped with its joints held until the feet feel the ground, then the controller; logs what matters."""

    def __init__(self, robot, q, v=None, seconds=3.0, controller=None, friction=0.8):
        self.controller = controller or LandingController(robot)
        motors, servo, data = robot.limits, WholeBodyServo(robot), robot.model.createData()
        hold = Command(q=q[7:], rate=np.zeros(14), acceleration=np.zeros(14))
        self.worst_torque, self.touching, touchdown, tau = 0.0, set(), None, np.zeros(14)
        with BulletEngine(robot, q, v, friction=friction) as world:
            force = np.zeros(2)
            for step in range(round(seconds * 1000)):
                q, v = world.state()
                if touchdown is None and force.sum() > 20:
                    touchdown = step
                if touchdown is None:
                    tau = servo.torque(hold, q, v)
                else:
                    since = step - touchdown
                    if since % PERIOD_STEPS == 0:
                        tau = self.controller.torque(since / 1000, q, v, force)
                        low, high = motors.range(v[6:])
                        assert (tau <= high + 1e-9).all() and (tau >= low - 1e-9).all()
                    self.worst_torque = max(self.worst_torque, np.max(np.abs(tau) / motors.effort))
                world.set_torque(tau)
                world.step()
                force = world.wrench()[:, 2]
            q, v = world.state()
            self.touching = set(np.array(world.links)[world.log().touching.any(axis=0)])
        pin.centerOfMass(robot.model, data, q, v)
        self.com, self.speed, self.force = data.com[0].copy(), np.linalg.norm(data.vcom[0]), force.sum()

    @property
    def stands(self):
        return self.touching == {"left_foot", "right_foot"} and self.speed < 0.02


def crouched(robot, vx, knee=1.0, pitch=0.15, vz=-3.0):
    """Feet flat just above the ground, soles ahead of the CoM by the capture law of the plan."""
    middle = robot.sagittal.sole_center[0]

    def angles(shank):
        return np.array([0.0, shank, shank - knee, pitch, pitch])

    def miss(shank):
        return middle - com_from_toe(robot, angles(shank))[0] - (0.02 + 0.13 * vx)

    q = configuration(robot, angles(brentq(miss, -1.2, 1.4)))
    q[2] += 0.002
    v = np.zeros(robot.model.nv)
    v[:3] = pin.Quaternion(q[6], q[3], q[4], q[5]).toRotationMatrix().T @ [vx, 0, vz]
    return q, v


def sole_acceleration(robot, q, v, a):
    """Upward acceleration of the middle of the left sole under ``a`` (nv,) [m/s^2]."""
    body = WholeBody(robot)
    body.update(q, v)
    return float((body.sole_rows[0, :, : body.nv] @ a + body.sole_drift[0])[2])


def test_body_terms_obey_newton(bhr):
    """Rows and offsets of the controller against inverse dynamics and finite differences, at a random state."""
    rng, model, terms = np.random.default_rng(1), bhr.model, WholeBody(bhr)
    q = pin.integrate(model, stance_configuration(bhr), 0.3 * rng.normal(size=20))
    v, a, wrench = rng.normal(size=20), rng.normal(size=20), rng.normal(size=(2, 6))
    x = np.concatenate([a, *wrench])
    terms.update(q, v)
    terms.set_contact(np.array([True, True]))
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    pin.updateFramePlacements(model, data)
    outer = pin.StdVec_Force()
    for _ in range(model.njoints):
        outer.append(pin.Force.Zero())
    for side, name in enumerate(bhr.foot.frames):
        frame = model.frames[model.getFrameId(name)]
        joint = data.oMi[frame.parentJoint]
        middle = data.oMf[model.getFrameId(name)].act(bhr.foot.center)
        at_sole = pin.SE3(np.eye(3), middle)
        outer[frame.parentJoint] = joint.actInv(at_sole.act(pin.Force(100 * wrench[side])))
        assert terms.soles[side] == pytest.approx(middle)
    tau = pin.rnea(model, data, q, v, a, outer)
    base = terms.program(v, np.zeros((0, terms.nx))).equalities["base"]
    assert base.matrix @ x - base.low == pytest.approx(tau[:6], abs=1e-8)
    assert terms.torque(x) == pytest.approx(tau[6:], abs=1e-8)
    total = 100 * wrench.sum(axis=0)
    assert terms.force_rows @ x == pytest.approx(total[:3] / 42)
    moment = sum(100 * w[3:] + np.cross(p - terms.com, 100 * w[:3]) for p, w in zip(terms.soles, wrench, strict=True))
    assert terms.momentum_rows @ x == pytest.approx(moment)
    step = 1e-6
    twists, acceleration = terms.twists.copy(), terms.sole_rows @ x + terms.sole_drift
    terms.update(pin.integrate(model, q, step * v), v + step * a)
    assert (terms.twists - twists) / step == pytest.approx(acceleration, abs=1e-3)


def test_stands_quietly(bhr):
    run = Catch(bhr, stance_configuration(bhr), seconds=1.2)
    assert run.stands and run.speed < 1e-3
    assert run.force == pytest.approx(42 * 9.8, rel=1e-3)
    assert run.worst_torque < 0.3
    assert run.controller.solver.failures == 0 and run.controller.solver.solves > 550


def test_catches_a_drop(bhr):
    q = stance_configuration(bhr)
    q[2] += 0.2
    run = Catch(bhr, q, seconds=1.2)
    assert run.stands and run.controller.solver.failures == 0
    assert run.com[:2] == pytest.approx([0, 0], abs=0.01)


@pytest.mark.parametrize(("vx", "friction"), [(0.7, 0.5), (1.4, 1.0)])
def test_catches_a_jump(bhr, vx, friction):
    run = Catch(bhr, *crouched(bhr, vx), seconds=1.6, friction=friction)
    assert run.stands and run.controller.solver.failures == 0
    assert run.worst_torque <= 1.0


def test_follows_a_reference(bhr):
    """Sink by 10 cm in half a second and stay there, 2 cm ahead of the middle of the feet."""
    q = stance_configuration(bhr)
    start = float(pin.centerOfMass(bhr.model, bhr.model.createData(), q)[2])
    s = np.linspace(0, 1, 51)
    blend, slope = 3 * s**2 - 2 * s**3, (6 * s - 6 * s**2) / 0.5
    com, rate = np.stack([0.02 * blend, start - 0.1 * blend], 1), np.stack([0.02 * slope, -0.1 * slope], 1)
    plan = SimpleNamespace(
        at=lambda t: ([np.interp(t, 0.5 * s, x) for x in com.T], [np.interp(t, 0.5 * s, x) for x in rate.T], 0.0),
        feed_forward=lambda t: (np.zeros(2), 0.0),
    )
    controller = LandingController(bhr, reference=plan)
    run = Catch(bhr, q, seconds=1.2, controller=controller)
    assert run.stands
    assert run.com[[0, 2]] == pytest.approx([0.02, start - 0.1], abs=0.005)


def test_survives_a_failing_solver(bhr):
    """Torques stay within the limits; one lost solve in ten does not cost the stance."""
    controller = LandingController(bhr)
    solve, calls = controller.solver.solve, []

    def flaky(qp):
        calls.append(1)
        return replace(solve(qp), solved=len(calls) % 10 != 0)

    controller.solver.solve = flaky
    q = stance_configuration(bhr)
    q[2] += 0.05
    run = Catch(bhr, q, seconds=1.0, controller=controller)
    assert run.stands and len(calls) > 400


def test_reports_an_unsolvable_problem(bhr):
    controller = LandingController(bhr)
    q, v = stance_configuration(bhr), np.zeros(20)
    controller.solver = QpSolver(1e-6, iterations=1)
    v[6:] = np.random.default_rng(0).normal(size=14) * 10
    tau = controller.torque(0.0, q, v, np.array([200.0, 200.0]))
    assert controller.solver.failures == 1
    assert np.isfinite(tau).all() and (np.abs(tau) <= bhr.limits.effort).all()


@pytest.mark.parametrize("noise_n, stands", [(0.0, True), (3.0, True), (12.0, False)])
def test_a_foot_in_the_air_does_not_stand_by_what_its_sensor_errs(bhr, noise_n, stands):
    """20 N are a load for a good sensor, and less than twice the error of a poor one."""
    control, q = LandingController(bhr, force_noise_n=noise_n), stance_configuration(bhr)
    q[7 + bhr.joint_names.index("left_knee")] += 0.5
    control.body.update(q, np.zeros(bhr.model.nv))
    assert control.standing(0.0, np.array([20.0, 400.0])).tolist() == [stands, True]


def test_a_joint_at_its_stop_is_led_away_from_it(bhr):
    """Arms that land overhead come back: at rest by the stop the wish is not to stay there."""
    control, q = LandingController(bhr), stance_configuration(bhr)
    arm = bhr.joint_names.index("left_shoulder_pitch")
    lower = bhr.actuators["left_shoulder_pitch"]["lower"]
    for angle, rate, least in ((lower + 0.0499, 0.0, 10.0), (lower + 0.02, 0.0, 20.0), (lower + 0.1, -3.0, 70.0)):
        q[7 + arm], v = angle, np.zeros(bhr.model.nv)
        v[6 + arm] = rate
        control.body.update(q, v)
        wish, weight = control.posture_wish(q, v)
        assert least - 1e-6 <= wish[arm] <= 300.0 and weight[arm] == GAINS.stop_weight, angle
    q[7 + arm] = lower + 0.06  # beyond the margin the posture's own wish has it
    wish, weight = control.posture_wish(q, np.zeros(bhr.model.nv))
    assert wish[arm] == pytest.approx(2 * GAINS.posture_rate * MAX_BACK)
    assert weight[arm] == GAINS.arm_posture_weight


@pytest.mark.parametrize("off_rad", (-3.0, -0.1))
def test_a_joint_goes_back_to_the_stance_no_faster_than_it_may(bhr, off_rad):
    """At the rate it goes back with, nothing is asked of it; far off that rate does not grow with the way."""
    control, q, v = LandingController(bhr), stance_configuration(bhr), np.zeros(bhr.model.nv)
    arm = bhr.joint_names.index("left_shoulder_pitch")
    control.body.update(q, v)
    q[7 + arm] += off_rad
    v[6 + arm] = min(MAX_BACK, -off_rad * GAINS.posture_rate / 2)
    assert control.posture_wish(q, v)[0][arm] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("gap_m", "stands"), [(0.015, True), (0.025, False)])
def test_feet_that_both_bounced_are_pressed_down_again(bhr, gap_m, stands):
    """Just over the ground that they met both stand; feet that hover in step with each other would never meet it."""
    control, q, v = LandingController(bhr), stance_configuration(bhr), np.zeros(bhr.model.nv)
    control.body.update(q, v)
    assert control.standing(0.0, np.zeros(2)).all()  # no foot was loaded yet
    assert control.standing(0.0, np.full(2, 200.0)).all()
    q[2] += gap_m
    control.body.update(q, v)
    assert control.standing(0.1, np.zeros(2)).tolist() == [stands, stands]
    if not stands:
        tau = control.torque(0.1, q, v, np.zeros(2))
        data = bhr.model.createData()
        falls = pin.aba(bhr.model, data, q, v, np.concatenate([np.zeros(6), tau]))
        assert sole_acceleration(bhr, q, v, falls) < -bhr.gravity - 1.0


def test_a_joint_whose_motor_is_spent_leans_on_its_stop(bhr):
    """Knees too weak for a deep crouch rest on their stops: from then on the robot moves as it is believed to."""
    weak = bhr.with_limits(effort={"knee": 0.02})
    control, q, v = LandingController(weak), stance_configuration(weak), np.zeros(weak.model.nv)
    angles = {"knee": 2.39, "hip_pitch": -1.69, "ankle_pitch": -0.9}
    for role, angle in angles.items():
        q[[7 + weak.joint_names.index(name) for name in weak.joints[role]]] = angle
    q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.0, -sum(angles.values()), 0.0)).coeffs()
    body, data = WholeBody(weak), weak.model.createData()
    body.update(q, v)
    mass, drift = pin.crba(weak.model, data, q), pin.nonLinearEffects(weak.model, data, q, v)
    knees = body.unknowns[[9, 16], : body.nv]
    answers = []
    solve = control.solver.solve
    control.solver.solve = lambda qp: answers.append(solve(qp)) or answers[-1]
    wrong = []
    for _ in range(2):
        tau = np.concatenate([np.zeros(6), control.torque(0.0, q, v, np.full(2, 200.0))])
        believed, push = np.split(answers[-1].x, [body.nv])
        push = body.size.of(WRENCH_SCALE, "N") * push
        free = np.linalg.solve(mass, tau - drift + np.vstack(body.sole_rows)[:, : body.nv].T @ push)
        gain = np.linalg.solve(mass, knees.T)
        wrong.append(np.abs(believed - free + gain @ np.linalg.solve(knees @ gain, knees @ free)).max())
    assert wrong[1] < 0.01 < 1.0 < wrong[0]
