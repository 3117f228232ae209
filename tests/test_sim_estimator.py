"""The estimator against the truth of a simulated jump, without and with errors of the sensors."""

import numpy as np
import pinocchio as pin
import pytest

from jumplab.control.estimator import Estimator
from jumplab.control.kinematics import State
from jumplab.robot.stance import stance_configuration
from jumplab.sim import Perturbation, SensorNoise, simulate_jump
from jumplab.sim.sensors import LEVER_M, Perception, Sensors, estimation_error

STILL = np.zeros((2, 6))


@pytest.fixture(scope="module")
def jump(bhr, tape):
    """A jump that slips, bounces and stands askew a little: the truth to be found again."""
    return simulate_jump(tape, bhr, perturbation=Perturbation.draw(bhr, 3), reaim=True, stand_s=0.5)


def errors(bhr, jump, noise, seed=0):
    """Worst error in launch, flight and landing of tilt [rad], velocity [m/s] and place [m]."""
    sensors = Sensors(noise, seed)
    estimator, wrench, rows = Estimator(bhr, sensors.initial(jump.q[0]), jump.v[0], noise), STILL, []
    for q, v, after in zip(jump.q, jump.v, jump.foot_wrench, strict=True):
        believed = estimator.update(sensors.read(q, v, wrench))
        rows.append((*estimation_error(q, v, *believed), np.linalg.norm(believed[0][:3] - q[:3])))
        wrench = after
    rows = np.array(rows)
    return {phase: rows[jump.phase == phase].max(axis=0) for phase in ("launch", "flight", "landing")}


def test_exact_sensors_find_the_truth(bhr, jump):
    """Through launch, flight, impact and landing: 0.05 mrad, 1 mm/s, 1 mm."""
    for worst in errors(bhr, jump, SensorNoise()).values():
        assert (worst < [5e-5, 1e-3, 1e-3]).all(), worst


@pytest.mark.parametrize("seed", range(2))
def test_typical_sensors_are_good_enough_to_land(bhr, jump, seed):
    """One degree, 6 cm/s, and 3 cm of place at the end of the flight; the feet take the velocity's error away again."""
    worst = errors(bhr, jump, SensorNoise.typical(), seed)
    for phase in worst.values():
        assert (phase < [0.018, 0.06, 0.035]).all(), worst
    assert worst["landing"][0] > 1e-4  # it is an estimate, not the truth


def test_standing_feet_stop_a_drift_that_the_inertial_unit_alone_would_have(bhr):
    """Half a degree per second and 5 mg: three seconds of standing."""
    noise = SensorNoise(gyro=0.01, gyro_bias=0.01, accel=0.1, accel_bias=0.05, joint_rad=5e-4)
    q, v = stance_configuration(bhr), np.zeros(20)
    loads = {"standing": np.tile([0.0, 0, 206, 0, 0, 0], (2, 1)), "hanging": STILL}
    error = {}
    for name, wrench in loads.items():
        perceived = Sensors(noise, 4)
        estimator = Estimator(bhr, q, v, noise)
        for _ in range(3000):
            believed = estimator.update(perceived.read(q, v, wrench))
        error[name] = (*estimation_error(q, v, *believed), np.linalg.norm(believed[0][:3] - q[:3]))
    assert error["standing"][0] < 0.015 and error["standing"][1] < 0.02 and error["standing"][2] < 0.03
    assert (np.array(error["hanging"]) > 3 * np.array(error["standing"])).all()


def test_readings_are_as_noisy_as_stated(bhr):
    noise = SensorNoise.typical()
    q, v = stance_configuration(bhr), np.random.default_rng(0).normal(size=20)
    wrench = np.arange(12.0).reshape(2, 6)
    sensors, twin = Sensors(noise, 3), Sensors(noise, 3)
    rows = [sensors.read(q, v, wrench) for _ in range(800)]
    assert np.array_equal(twin.read(q, v, wrench).joints, rows[0].joints)
    joints, gyro = np.array([r.joints for r in rows]), np.array([r.gyro for r in rows])
    force = np.array([r.specific_force for r in rows])
    assert (joints - q[7:]).std() == pytest.approx(noise.joint_rad, rel=0.1)
    assert np.abs(joints / noise.encoder_step_rad - np.round(joints / noise.encoder_step_rad)).max() < 1e-6
    assert gyro.std(axis=0) == pytest.approx(np.full(3, noise.gyro), rel=0.1)
    assert 0 < np.abs(gyro.mean(axis=0) - v[3:6]).max() < 5 * noise.gyro_bias  # what is left is the bias
    assert force.std(axis=0) == pytest.approx(np.full(3, noise.accel), rel=0.1)
    assert (np.array([r.foot_wrench[:, 2] for r in rows]) - [2, 8]).std() == pytest.approx(noise.force, rel=0.1)
    moments = np.array([r.foot_wrench[:, 3:] for r in rows]) - wrench[:, 3:]
    assert moments.std() == pytest.approx(LEVER_M * noise.force, rel=0.1)


def test_poor_foot_sensors_find_no_ground_in_the_air(bhr, tape):
    """Errors of 12 N a foot pass 30 N in both together once in 26 readings, and half a flight has three hundred."""
    poor = Perturbation(seed=1, noise=SensorNoise.typical().times(4))
    run = simulate_jump(tape, bhr, perturbation=poor, reaim=True)
    assert run.landed and run.checks_passed, run.reason
    assert run.settings["perception"]["worst_velocity_error"] < 0.5


def test_exact_readings(bhr):
    """At rest the accelerometer feels the ground's push; in a free fall nothing; in a turn, what Newton says."""
    q, v, sensors = stance_configuration(bhr), np.zeros(20), Sensors(SensorNoise(), 0)
    attitude = pin.Quaternion(q[6], q[3], q[4], q[5]).toRotationMatrix()
    reading = sensors.read(q, v, np.arange(12.0).reshape(2, 6))
    assert attitude @ reading.specific_force == pytest.approx([0, 0, 9.8])
    assert np.array_equal(reading.foot_wrench, np.arange(12.0).reshape(2, 6)) and np.array_equal(reading.joints, q[7:])
    v[:3] = attitude.T @ [0.002, 0, -0.0098]
    assert attitude @ sensors.read(q, v, STILL).specific_force == pytest.approx([2, 0, 0], abs=1e-9)


def test_perception_is_the_truth_until_a_sensor_errs(bhr):
    q, v = stance_configuration(bhr), np.zeros(20)
    exact, noisy = (Perception(bhr, q, v, noise, 0) for noise in (SensorNoise(), SensorNoise.typical()))
    state = State(q, v, STILL)
    assert exact(state) is state and exact.to_json() == {"state": "true"}
    assert noisy(state).q[:7] != pytest.approx(q[:7], abs=1e-6)
    assert noisy.to_json()["state"] == "estimated" and noisy.to_json()["worst_tilt_error_rad"] > 0


def test_a_jump_lands_on_estimates(bhr, tape):
    noisy = Perturbation(seed=1, noise=SensorNoise.typical())
    run = simulate_jump(tape, bhr, perturbation=noisy, reaim=True, stand_s=0.5)
    assert run.checks_passed and "watched" in run.reason
    said = run.settings["perception"]
    assert said["state"] == "estimated" and 0 < said["worst_tilt_error_rad"] < 0.03
    assert said["worst_velocity_error"] < 0.1
