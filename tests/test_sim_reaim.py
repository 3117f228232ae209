"""Re-aim in the air: what is forecast, where the soles are wished, and a shove that only re-aimed robots survive."""

import numpy as np
import pinocchio as pin
import pytest

from jumplab.control import reaim as module
from jumplab.control.controller import level
from jumplab.control.flight import Flight
from jumplab.control.kinematics import Gauge, headed, rotation, turned, yaw_of
from jumplab.control.reaim import FAR_RAD, Reaim, least_within
from jumplab.sim import INSTALLED, STEP_S, Perturbation, Shove, simulate_jump


@pytest.fixture
def reaim(bhr, tape):
    return Reaim(bhr, tape)


@pytest.fixture
def flight(bhr, tape):
    return Flight(bhr, tape, level)


def wish(reaim, robot, q, v, turn=None, left_s=0.0):
    return reaim.touchdown(Gauge(robot).motion(q, v), np.eye(3) if turn is None else turn, left_s)[0]


def spinning(robot, q, v, spin, push=(0.0, 0.0, 0.0)):
    """The velocity (nv,) of a body that also turns about its CoM, world axes, and flies faster by ``push``."""
    data = robot.model.createData()
    pin.centerOfMass(robot.model, data, q, v)
    com, turn, out = data.com[0].copy(), pin.Quaternion(*q[[6, 3, 4, 5]]).toRotationMatrix(), v.copy()
    out[:3] += turn.T @ (np.cross(spin, q[:3] - com) + push)
    out[3:6] += turn.T @ np.asarray(spin)
    return out


def about_the_soles(robot, q, speed, momentum):
    """L + m r x v about the middle of the soles, over the mass, about x and y."""
    gauge = Gauge(robot)
    return (momentum / robot.total_mass + np.cross(gauge.com(q) - gauge.soles(q), speed))[:2]


def motion(robot, q, v):
    now = Gauge(robot).motion(q, v)
    return now.velocity, now.momentum


@pytest.mark.parametrize("spin", [(0.5, 0.0, 0.0), (0.0, -0.4, 0.0), (0.0, 0.0, 0.8), (0.3, 0.2, -0.6)])
def test_a_body_turns_on_as_fast_as_it_does_beyond_the_plan(bhr, flight, spin, tape):
    """Moments before touchdown by that very spin; a push through the CoM turns nothing, and nothing is as planned."""
    last = round(float(tape.t[-1]) * 1e3)
    row = int(np.searchsorted(tape.t, 1e-3 * (last - 5)))
    q, v, left = tape.q[row], tape.v[row], 5e-3
    plain = flight.turn_ahead(last - 5, Gauge(bhr).motion(q, v), left)
    assert np.abs(pin.log3(plain)).max() < 1e-3
    for speed, push in ((spin, (0.3, -0.4, 0.1)), ((0.0, 0.0, 0.0), (0.3, -0.4, 0.1))):
        turn = flight.turn_ahead(last - 5, Gauge(bhr).motion(q, spinning(bhr, q, v, speed, push)), left)
        assert pin.log3(turn @ plain.T) / left == pytest.approx(speed, abs=0.02)


def test_a_turned_body_stays_turned_as_its_momentum_is(bhr, flight, tape):
    """Planned and turned body spin alike in their own axes, from the apex on: L turns along."""
    turn = pin.exp3(np.array([0.1, -0.2, 0.3]))
    row, step = len(tape.t) - 200, round(float(tape.t[-200]) * 1e3)
    now = Gauge(bhr).motion(turned(tape.q[row], turn), tape.v[row])
    ahead = flight.turn_ahead(step, now, float(tape.t[-1] - tape.t[row]))
    assert pin.log3(ahead @ turn.T) == pytest.approx([0, 0, 0], abs=2e-3)


def test_the_heading_of_a_turn():
    for yaw in (-2.0, -0.3, 0.0, 0.7):
        tilted = pin.rpy.rpyToMatrix(0.0, 0.0, yaw) @ pin.exp3(np.array([0.3, -0.2, 0.0]))
        assert yaw_of(tilted) == pytest.approx(yaw)
    assert yaw_of(pin.rpy.rpyToMatrix(0.0, 3.0, 0.0)) == yaw_of(pin.rpy.rpyToMatrix(0.0, -0.2, 0.0)) == 0


def test_a_flight_as_planned_is_left_alone(bhr, reaim, tape):
    """At touchdown nothing is wished; on the way down nothing that matters, the plan's flight being free."""
    assert np.abs(wish(reaim, bhr, tape.q[-1], tape.v[-1])).max() < 1e-6
    assert np.abs(wish(reaim, bhr, tape.q[-150], tape.v[-150], left_s=tape.t[-1] - tape.t[-150])).max() < 5e-3


@pytest.mark.parametrize("push", [(0.15, 0.0, 0.0), (-0.2, 0.0, 0.0), (0.0, 0.25, 0.0), (0.1, -0.25, 0.0)])
def test_the_soles_go_where_nothing_tips_the_robot(bhr, reaim, push, tape):
    """The middle of the soles that are wished: the momentum about it is the planned one, about both level axes."""
    q, v = tape.q[-1], tape.v[-1]
    shoved = spinning(bhr, q, v, (0.0, 0.0, 0.0), push)
    speed, momentum = motion(bhr, q, shoved)
    planned = about_the_soles(bhr, q, *motion(bhr, q, v))
    there = q.copy()
    there[7:] += wish(reaim, bhr, q, shoved)
    assert about_the_soles(bhr, there, speed, momentum) == pytest.approx(planned, abs=0.02)
    assert np.abs(about_the_soles(bhr, q, speed, momentum) - planned).max() > 0.05  # without
    before, after = (np.array([p.act(bhr.foot.center) for p in Gauge(bhr).places(x)])[:, 1] for x in (q, there))
    if push[1]:  # the leg on that side goes out, the other one hardly moves
        out = int(push[1] < 0)
        assert (after - before)[out] * np.sign(push[1]) > 0.05 > 0.03 > abs(after - before)[1 - out]


@pytest.mark.parametrize("turn", [(0.15, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.4), (0.1, -0.15, -0.3)])
def test_soles_of_a_turned_robot_meet_the_ground_flat(bhr, reaim, turn, tape):
    """Seen along the heading of the robot itself: the same posture whatever the yaw, within the joints' stops."""
    turn = pin.exp3(np.array(turn))
    there = turned(tape.q[-1], turn)
    there[7:] += wish(reaim, bhr, there, tape.v[-1], turn)
    tilts = [np.arccos(place.rotation[2, 2]) for place in Gauge(bhr).places(there)]
    assert max(tilts) < 0.03 and np.ptp([p.translation[2] for p in Gauge(bhr).places(there)]) < 0.01
    motors = bhr.limits
    assert (there[7:] >= motors.lower).all() and (there[7:] <= motors.upper).all()
    more = pin.rpy.rpyToMatrix(0.0, 0.0, 0.5)
    q, v = headed(tape.q[-1], -0.5), tape.v[-1]
    assert wish(reaim, bhr, q, v, more) == pytest.approx(wish(reaim, bhr, tape.q[-1], tape.v[-1]), abs=1e-9)


def tilted_ahead(pitch_rad):
    return pin.rpy.rpyToMatrix(0.0, pitch_rad, 0.0)


def joints_of(robot, *roles):
    return [robot.joint_names.index(name) for role in roles for name in robot.joints[role]]


@pytest.mark.parametrize("pitch_rad", [-2 * FAR_RAD, 0.9 * FAR_RAD, 1.1 * FAR_RAD])
def test_arms_swing_only_if_the_trunk_will_be_far_forward(bhr, reaim, pitch_rad, tape):
    """High above the ground, where legs wait; to the back as their way, which turns a trunk back."""
    turn = tilted_ahead(pitch_rad)
    high = turned(tape.q[-1], turn)
    high[2] += 1.0
    now = Gauge(bhr).motion(high, tape.v[-1])
    arms = reaim.correction(now, turn, 0.4)[0, joints_of(bhr, "shoulder_pitch")]
    if pitch_rad < FAR_RAD:
        assert not arms.any()
        return
    data = bhr.model.createData()
    pin.ccrba(bhr.model, data, high, tape.v[-1])
    carried = data.Ag[4, 6:][joints_of(bhr, "shoulder_pitch")]  # of L_y, by each rad/s of an arm
    assert (carried * arms > 0).all()
    reaim.correction(now, tilted_ahead(0.0), 0.3)
    assert reaim.correction(now, tilted_ahead(0.0), 0.3).any()  # they go on until touchdown


def test_legs_of_a_flip_come_to_rest_at_their_correction(bhr, tape):
    """All that is sent is one motion: angles, their rates, and the rates of those."""
    reaim = Reaim(bhr, tape, legs_alone=True)
    end, turn = Gauge(bhr).motion(tape.q[-1], tape.v[-1]), tilted_ahead(0.05)
    left = np.arange(0.2, 0.0, -STEP_S)
    falls = [end._replace(velocity=np.array([0.3, 0.0, 9.8 * x - 3.0])) for x in left]
    sent = np.array([reaim.correction(now, turn, x) for now, x in zip(falls, left, strict=True)])
    angles, rates, gained = sent.swapaxes(0, 1)
    goal = reaim.touchdown(falls[-1], turn, left[-1])[0]
    np.testing.assert_allclose(np.diff(angles, axis=0), STEP_S * rates[1:], atol=1e-12)
    np.testing.assert_allclose(np.diff(rates, axis=0), STEP_S * gained[1:], atol=1e-9)
    largest = np.abs(goal).argmax()
    assert abs(goal[largest]) > 0.05
    assert angles[-1, largest] == pytest.approx(goal[largest], rel=0.1)
    assert abs(rates[-1, largest]) < 0.3 * np.abs(rates[:, largest]).max()


def test_bounded_least_squares():
    slope = np.array([[1.0, 1.0], [0.0, 1.0]])
    wide, miss = np.full(2, 10.0), np.array([3.0, 1.0])
    assert least_within(slope, miss, -wide, wide) == pytest.approx([2, 1], abs=4e-3)  # DAMPING is 1e-3
    assert least_within(slope, miss, -wide, np.array([0.5, 10.0])) == pytest.approx([0.5, 1.75], abs=4e-3)
    assert least_within(slope, miss, -wide, np.array([0.5, 0.25])) == pytest.approx([0.5, 0.25])


def test_a_shoved_robot_is_forecast_in_flight(bhr, flight, tape):
    """Attitude at touchdown about all axes, 0.15 s before, of a robot that nothing corrects."""
    aside = Perturbation(shoves=(Shove("flight", 0.3, 8.0, np.pi / 2),))
    run = simulate_jump(tape, bhr, perturbation=aside, stand_s=0.05)
    touch = int(np.argmax(run.phase == "landing"))
    early = touch - 150
    real = pin.log3(rotation(run.q[touch, 3:7]) @ rotation(tape.q[-1, 3:7]).T)
    forecast = pin.log3(flight.turn_ahead(early, Gauge(bhr).motion(run.q[early], run.v[early]), 0.15))
    assert forecast == pytest.approx(real, abs=0.02)
    assert np.linalg.norm(real) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("engine", INSTALLED[-1:])
def test_a_shove_aside_is_landed_with_reaim_alone(bhr, engine, tape):
    aside = Perturbation(shoves=(Shove("flight", 0.3, 15.0, np.pi / 2),))
    plain, aimed = (simulate_jump(tape, bhr, perturbation=aside, reaim=on, engine=engine) for on in (False, True))
    assert "touched the ground" in plain.reason
    assert aimed.landed and aimed.checks_passed, aimed.reason


@pytest.mark.slow
@pytest.mark.parametrize("engine", INSTALLED[:1])
def test_a_shove_forward_early_in_flight_is_landed_with_the_arms(bhr, engine, monkeypatch, tape):
    """Without them the trunk comes down almost a radian forward, further than legs can reach."""
    ahead = Perturbation(shoves=(Shove("flight", 0.1, 15.0, 0.3),))
    arms = simulate_jump(tape, bhr, perturbation=ahead, reaim=True, engine=engine)
    monkeypatch.setattr(module, "FAR_RAD", np.inf)
    legs = simulate_jump(tape, bhr, perturbation=ahead, reaim=True, engine=engine)
    assert arms.landed and arms.checks_passed, arms.reason
    assert "touched the ground" in legs.reason
    assert arms.metrics.touchdown_trunk_pitch_rad < legs.metrics.touchdown_trunk_pitch_rad - 0.3
