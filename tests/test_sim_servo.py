"""The servos of all modes against the plan, against Pinocchio, and against a drive that is simply stiff."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import refused
from fixtures_robots import needs_published

from jumplab.control import servo as law
from jumplab.control.body import WholeBody
from jumplab.control.controller import Controller
from jumplab.control.kinematics import State, headed
from jumplab.control.playback import AIR, FLAT, TOE, Command, Playback, resampled
from jumplab.control.servo import SERVOS, STIFFNESS, PositionServo, TorqueServo, WholeBodyServo
from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.sim import STEP_S, Perturbation, simulate_jump
from jumplab.sim.motors import Motors

G1 = pytest.param("g1_arms", marks=needs_published)


def told(robot, posture, **changed) -> Command:
    still = np.zeros(len(robot.joint_names))
    return Command(**{**dict(q=posture[7:], rate=still, acceleration=still, feet=FLAT), **changed})


def test_a_stance_takes_what_its_weight_takes(bhr):
    q = stance_configuration(bhr)
    body = WholeBody(bhr)
    body.update(q, np.zeros(bhr.model.nv))
    body.set_contact(both := np.array([True, True]))
    tau = WholeBodyServo(bhr).torque(told(bhr, q), q, np.zeros(bhr.model.nv))
    pitch = [bhr.joint_names.index(name) for pair in bhr.joints.values() for name in pair]
    assert tau[pitch] == pytest.approx(body.gravity_torque(both)[pitch], abs=1e-3)


def test_on_the_tape_it_asks_for_the_planned_torques_that_it_never_saw(bhr, tape):
    """Flat, on the toes and in the air; but where the tape jumps from one to the next."""
    servo, player, effort = WholeBodyServo(bhr, substeps=10**6), Playback(tape, bhr), bhr.limits.effort
    worst = {FLAT: 0.0, TOE: 0.0, AIR: 0.0}
    for row in range(0, len(tape.t) - 1, 7):
        step = round(float(tape.t[row]) / STEP_S)
        stand = player.stands(step)
        if any(player.stands(step + k) != stand for k in (-5, 5)):
            continue
        command = Command(q=tape.q[row, 7:], rate=tape.v[row, 6:], acceleration=tape.a[row, 6:], feet=stand)
        miss = servo.torque(command, tape.q[row], tape.v[row]) - tape.tau[row]
        worst[stand] = max(worst[stand], float(np.abs(miss / effort).max()))
    assert 0 < worst[FLAT] < 0.005 and 0 < worst[AIR] < 1e-4
    assert 0 < worst[TOE] < 0.02  # [of the effort] the toes' line moves a little in the plan, and not in the law


@pytest.mark.parametrize("stand", [FLAT, TOE, AIR])
def test_a_turned_world_changes_nothing(bhr, tape, stand):
    """The robot turned about the vertical, errors and all: the same torques. Feet on their toes turn about their own
    axis, not the world's."""
    row = {FLAT: 100, TOE: np.searchsorted(tape.t, tape.takeoff_time) - 30, AIR: -100}[stand]
    rng, servo = np.random.default_rng(0), WholeBodyServo(bhr)
    q, v = pin.integrate(bhr.model, tape.q[row], rng.normal(size=bhr.model.nv) * 0.01), tape.v[row] + 0.01
    command = Command(q=tape.q[row, 7:], rate=tape.v[row, 6:], acceleration=tape.a[row, 6:], feet=stand)
    expected = servo.torque(command, q, v)
    for yaw in (0.1, 1.0, 3.0):
        assert servo.torque(command, headed(q, yaw), v) == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("stand", [AIR, FLAT])
def test_an_error_is_met_by_a_damper_of_a_body_whose_feet_give_way(bhr, tape, stand):
    """The stated damping, softened by what the rates change within the step: an implicit step, solved another way, with
    feet on springs of no mass instead of rows that hold them."""
    q, v, dt = tape.q[-200] if stand == AIR else stance_configuration(bhr), np.zeros(bhr.model.nv), STEP_S
    servo, data = WholeBodyServo(bhr), bhr.model.createData()
    error = np.random.default_rng(0).normal(size=14) * 1e-3
    free, pulled = (servo.torque(told(bhr, q, q=q[7:] + e, feet=stand), q, v) for e in (0 * error, error))
    damping = np.diag(np.r_[np.zeros(6), law.DAMPING * bhr.limits.effort / bhr.limits.effort.max()])
    mass = pin.crba(bhr.model, data, q)
    pin.computeJointJacobians(bhr.model, data, q)
    springs = np.zeros((20, 20))
    for frame in map(bhr.model.getFrameId, bhr.foot.frames if stand == FLAT else ()):
        placed = pin.updateFramePlacement(bhr.model, data, frame)
        jacobian = pin.getFrameJacobian(bhr.model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        jacobian[:3] -= pin.skew(placed.rotation @ bhr.foot.center) @ jacobian[3:]
        rows = jacobian * np.repeat([1.0, law.LEVER_M], 3)[:, None]
        springs += rows.T @ rows / law.GIVE
    wish = np.r_[np.zeros(6), law.CORNER * error]
    after = np.linalg.solve(mass + dt * damping + springs, dt * damping @ wish)
    assert pulled - free == pytest.approx((damping @ (wish - after))[6:], abs=1e-6)


def test_torques_keep_to_the_share_of_the_motors(bhr):
    q, v = stance_configuration(bhr), np.zeros(bhr.model.nv)
    far = told(bhr, q, q=q[7:] + 10.0, share=0.2)
    tau = WholeBodyServo(bhr).torque(far, q, v)
    assert np.abs(tau) == pytest.approx(0.2 * bhr.limits.effort)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_joint_beyond_its_no_load_speed_is_braked_with_all_its_motor_has(bhr, way):
    q, v, motors = stance_configuration(bhr), np.zeros(bhr.model.nv), bhr.limits
    hip = bhr.joint_names.index("left_hip_pitch")
    v[6 + hip] = way * 1.2 * motors.speed[hip]
    stop, on = (told(bhr, q, feet=AIR, rate=rate * way * 40.0) for rate in (np.zeros(14), np.ones(14)))
    assert WholeBodyServo(bhr).torque(stop, q, v)[hip] == pytest.approx(-way * motors.effort[hip])
    assert WholeBodyServo(bhr).torque(on, q, v)[hip] == 0.0  # it cannot be driven any faster


def test_a_torque_that_is_held_for_a_step_is_that_of_its_middle(bhr, tape):
    """As far as an engine's substeps feel it late: one feels it at once, countless ones half a step late on average."""
    q, v, tau, change = tape.q[100], tape.v[100], tape.tau[100], tape.tau[101] - tape.tau[100]
    takeoff = round(tape.takeoff_time / STEP_S)
    player, none = Playback(tape, bhr), np.zeros(14)
    told, last = (player.command(step, q, v, none) for step in (100, takeoff - 1))
    assert told.change == pytest.approx(change, abs=1e-6) and not np.any(last.change)  # the ground lets go at once
    for servo in (PositionServo, TorqueServo):
        for substeps, share in ((1, 0.0), (4, 0.375), (10**9, 0.5)):
            given = servo(bhr, substeps=substeps).drive(told, q, v).torque(q[7:], v[6:])
            assert given == pytest.approx(tau + share * change, abs=1e-6)


def test_joints_whose_rates_are_right_are_where_substeps_bring_them(bhr, tape):
    """Semi-implicit steps end half a step ahead: there no error is left, and so the damper is all that is felt."""
    q, rate = stance_configuration(bhr), np.linspace(-2, 2, 14)
    for substeps in (1, 4):
        ahead = np.concatenate([q[:7], q[7:] + STEP_S / substeps / 2 * rate])
        v = np.concatenate([np.zeros(6), rate])
        here, there = (WholeBodyServo(bhr, substeps=n).torque(told(bhr, q, rate=rate, feet=AIR), ahead, v)
                       for n in (substeps, 10**9))  # fmt: skip
        wish = told(bhr, ahead, rate=rate, feet=AIR)
        assert here == pytest.approx(WholeBodyServo(bhr, substeps=10**9).torque(wish, ahead, v), abs=1e-6)
        assert np.abs(here - there).max() > 0.1


def test_a_gain_scales_what_is_delivered(bhr):
    names, tau, still = bhr.joint_names, np.full(14, 10.0), np.zeros(14)
    delivered = Motors(bhr, {names[3]: 0.8, names[9]: 1.1}).deliver(tau, still)
    assert delivered[3] == pytest.approx(8) and delivered[9] == pytest.approx(11)
    assert np.delete(delivered, [3, 9]) == pytest.approx(10)
    assert Motors(bhr, {}).deliver(1e3 * tau, still) == pytest.approx(bhr.limits.effort)


@pytest.mark.parametrize("mode", ["pd", "whole-body"])
def test_weak_motors_and_late_commands_are_felt(bhr, tape, mode):
    """Before touchdown, and open loop: a gain scales what is delivered, a delay ages it where torques are sent. A delay
    that is known is led by: no difference is left that anyone would see."""
    weak = Perturbation(motor_gain={name: 0.9 for name in bhr.joint_names})
    late, known = Perturbation(delay_s=0.004), Perturbation(delay_s=0.004, known_delay_s=0.004)
    runs = [simulate_jump(tape, bhr, mode=mode, perturbation=p, stand_s=0.01) for p in (None, weak, late, known)]
    asked, weakly, late, known = (run.metrics for run in runs)
    assert weakly.com_rise_m < asked.com_rise_m - 0.004
    assert abs(late.foot_distance_touchdown_m - asked.foot_distance_touchdown_m) > 0.03
    assert abs(known.foot_distance_touchdown_m - asked.foot_distance_touchdown_m) < 0.01
    assert abs(known.com_rise_m - asked.com_rise_m) < 0.006  # 2 % of the rise; 5.3 mm measured in whole-body mode


def test_late_targets_merely_begin_the_jump_later(bhr, tape):
    """Position drives close their own loop: the same jump begins so many milliseconds on."""
    runs = [simulate_jump(tape, bhr, perturbation=Perturbation(delay_s=s), stand_s=0.01) for s in (0.0, 0.004)]
    asked, late = (run.metrics for run in runs)
    assert late.touchdown_s - asked.touchdown_s == pytest.approx(0.004, abs=0.0011)
    assert late.foot_distance_touchdown_m == pytest.approx(asked.foot_distance_touchdown_m, abs=2e-3)
    assert late.com_rise_m == pytest.approx(asked.com_rise_m, abs=2e-3)
    weak = Perturbation(motor_gain={name: 0.9 for name in bhr.joint_names})
    assert simulate_jump(tape, bhr, perturbation=weak, stand_s=0.01).metrics.com_rise_m < asked.com_rise_m - 0.004


@pytest.mark.parametrize("name", ["bhr", G1])
def test_drives_on_the_plan_give_its_torque(name):
    """Whatever base, rates and other joints are: a drive knows its own joint, and has the planned torque where that has
    no error, also at a stop, where the angle that is sent lies beyond the joint's range."""
    robot = Robot.load(name)
    servo, motors, rng = PositionServo(robot), robot.limits, np.random.default_rng(3)
    n = len(motors.effort)
    q, rate = stance_configuration(robot), rng.uniform(-3, 3, n)
    tau = rng.uniform(-1, 1, n) * motors.effort
    command = Command(q=q[7:], rate=rate, acceleration=np.zeros(n), tau=tau)
    sent = servo.drive(command, q, np.zeros(robot.model.nv))
    assert sent.torque(q[7:], rate) == pytest.approx(tau, abs=1e-9)
    elsewhere = servo.drive(command, rng.uniform(-1, 1, len(q)), rng.uniform(-1, 1, robot.model.nv))
    assert np.array_equal(elsewhere.q, sent.q) and not np.any(elsewhere.tau)
    off = np.zeros(n)
    off[4] = 0.01
    pulled = sent.torque(q[7:] + off, rate) - tau
    assert pulled[4] == pytest.approx(-0.01 * servo.kp[4]) and not np.delete(pulled, 4).any()
    braked = sent.torque(q[7:], rate + 10 * off) - tau
    assert braked[4] == pytest.approx(-0.1 * servo.kd[4])
    stop = servo.drive(Command(q=motors.upper, rate=rate, acceleration=rate, tau=motors.effort), q, np.zeros(n + 6))
    assert np.all(stop.q > motors.upper) and stop.torque(motors.upper, rate) == pytest.approx(motors.effort)
    assert np.all(servo.kp <= STIFFNESS * motors.effort) and np.all(servo.kd > 0)


def test_torque_servo_sends_the_plan_and_its_errors(bhr, tape):
    """On the ground by the gains, in the air by the inertia of the free body: there joints accelerate as asked."""
    servo, q, v = TorqueServo(bhr), tape.q[100], tape.v[100]
    error = 1e-3 * np.arange(1, 15)
    told = dict(q=q[7:] + error, rate=v[6:], acceleration=np.zeros(14), tau=tape.tau[100])
    mended = servo.drive(Command(**told, feet=FLAT), q, v).torque(q[7:], v[6:]) - tape.tau[100]
    knee, roll = (bhr.joint_names.index(f"left_{x}") for x in ("knee", "hip_roll"))
    assert mended[knee] == pytest.approx(800 * error[knee]) and mended[roll] == pytest.approx(300 * error[roll])
    mended = servo.drive(Command(**told, feet=AIR), q, v).torque(q[7:], v[6:]) - tape.tau[100]
    mass = pin.crba(bhr.model, bhr.model.createData(), q)
    wish = np.linalg.solve(mass, np.concatenate([np.zeros(6), mended]))[6:]
    assert wish == pytest.approx(law.FLIGHT_BANDWIDTH * law.FLIGHT_CORNER * error, rel=1e-9)


def test_what_is_sent_ahead_is_what_the_tape_takes_later(bhr, tape):
    """Commands with a lead are those without it so many steps on: on the tape, and off it by an error that stays."""
    lead, servo, none = 3, WholeBodyServo(bhr), np.zeros(14)
    ahead, plain = Playback(tape, bhr, lead * STEP_S), Playback(tape, bhr)
    effort, off = bhr.limits.effort, np.full(14, 5e-3)

    def sent(player, step, seen, error):
        row = int(np.searchsorted(tape.t, seen * STEP_S - 1e-9))
        q, v = tape.q[row].copy(), tape.v[row]
        q[7:] += error
        command = player.command(step, q, v, none)
        return servo.torque(command, *(command.state or (q, v)))

    for step in (100, round(tape.takeoff_time / STEP_S) + 150):
        for error in (none, off):
            miss = sent(ahead, step, step, error) - sent(plain, step + lead, step + lead, error)
            assert np.abs(miss / effort).max() < 1e-6, step
        assert np.abs((sent(ahead, step, step, off) - sent(ahead, step, step, none)) / effort).max() > 0.01


@pytest.mark.parametrize("mode", SERVOS)
def test_a_controller_runs_without_a_simulator_and_on_the_plan_gives_its_torques(bhr, tape, mode):
    control = Controller(tape, bhr, mode=mode)
    for row in range(0, 40, 8):  # still flat
        t = round(float(tape.t[row]) / STEP_S) * STEP_S
        q, v, a = (resampled(np.array([t]), tape.t, x)[0] for x in (tape.q, tape.v, tape.a))
        due = pin.rnea(bhr.model, bhr.model.createData(), q, v, a)  # of which the ground holds the rest
        tau = control.torque(t, State(q, v, np.zeros((2, 6))))
        planned = resampled(np.array([t]), tape.t, tape.tau)[0]
        assert np.abs((tau - planned) / bhr.limits.effort).max() < 0.02, (row, tau - planned)
        assert np.abs(due[6:] - planned).max() > 1.0


def test_states_that_are_no_robot_s_are_refused_in_a_sentence(bhr, tape):
    state = dict(q=tape.q[0], v=tape.v[0], wrench=np.zeros((2, 6)))
    control = Controller(tape, bhr)
    for name, array in state.items():
        broken = array.copy()
        broken.flat[1] = np.nan
        with pytest.raises(
            InputError, match=rf"^the state's {name} has entries that are no number at t = 0\.5 s; stop"
        ):
            control.torque(0.5, State(*(state | {name: broken}).values()))
        with pytest.raises(InputError, match=rf"^the state's {name} must have the shape \("):
            control.torque(0.5, State(*(state | {name: array[:-1]}).values()))
    assert refused(control.torque, np.nan, State(*state.values())).startswith("t must be finite")
    renamed = tape.joint_names[::-1]
    first = str(renamed[0])
    with pytest.raises(InputError, match=rf"^the tape's joints {first}, .* are not those of robot bhr; plan the jump"):
        Controller(replace(tape, joint_names=renamed), bhr)


def test_a_drive_whose_two_gains_are_one_array_holds_its_joint():
    gains = np.array([3.0, 5.0])
    drive = law.Drive(np.zeros(2), q=np.ones(2), rate=np.zeros(2), kp=gains, kd=gains)
    np.testing.assert_allclose(drive.torque(np.zeros(2), np.zeros(2)), gains)
    np.testing.assert_allclose(drive.torque(np.ones(2), np.ones(2)), -gains)
