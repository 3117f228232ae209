"""Every way of cheating in the simulation is tried, and caught by the findings that the result carries."""

import json
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from jumplab.cli.common import print_simulation
from jumplab.sim import Disturbance, MujocoEngine, Perturbation, simulate_jump, simulate_landing
from jumplab.sim import loop as jump
from jumplab.sim.checks import check
from jumplab.sim.playback import Motors
from jumplab.sim.result import STAND_S
from jumplab.stages.planner import Planner
from jumplab.task import JumpTask

bullet = pytest.importorskip("pybullet", reason="PyBullet, behind whose back most of the cheats go, is not installed")
engines = import_module("jumplab.sim.bullet")
BulletEngine = engines.BulletEngine
SHORT_S = 0.3
IN_FLIGHT = 1200  # step; the tape takes off a little after one second and flies for half of one


@pytest.fixture(scope="module")
def tape(bhr):
    return Planner(bhr).plan(JumpTask(0.6, 0.3), "direct").tape


def failed(result) -> set[str]:
    assert len(result.checks) == 16
    return {finding.name for finding in result.checks if not finding.passed}


def at_step(monkeypatch, when, cheat):
    """Do ``cheat(world)`` before one step of the run."""
    honest, count = BulletEngine.step, [0]

    def step(world):
        if count[0] == when:
            cheat(world)
        count[0] += 1
        honest(world)

    monkeypatch.setattr(BulletEngine, "step", step)


def test_the_flight_is_where_the_cheats_expect_it(tape):
    assert tape.takeoff_time < IN_FLIGHT / 1000 - 0.05 and tape.t[-1] > IN_FLIGHT / 1000 + 0.05


LATE = Perturbation(friction=0.5, delay_s=0.003)


@pytest.mark.parametrize("options", [{}, {"mode": "pd"}, {"perturbation": LATE, "reaim": True}, {"engine": "mujoco"}])
def test_an_honest_jump_passes(bhr, tape, options, capsys):
    result = simulate_jump(tape, bhr, **options)
    assert result.landed and result.checks_passed and failed(result) == set()
    said = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert said["honest"] and all(row["passed"] for row in said["honesty"])
    print_simulation(said)
    assert "honesty: all 16 checks of the run passed" in capsys.readouterr().out


def test_a_fall_is_honest_too(bhr, tape):
    result = simulate_landing(tape, bhr, Disturbance(pitch_rad=0.6))
    assert not result.landed and result.checks_passed


def test_quick_legs_are_honest(bhr, tape):
    """Re-aim swings the legs as fast as it may: the engine's own error is largest here."""
    result = simulate_landing(tape, bhr, Disturbance(0.8, -0.17, 0.1), mode="pd", reaim=True, stand_s=SHORT_S)
    assert failed(result) == set()


def test_without_findings_nothing_is_honest(bhr, tape):
    result = simulate_jump(tape, bhr, stand_s=SHORT_S)
    assert result.checks_passed and not replace(result, checks=()).checks_passed


@pytest.mark.parametrize("when", [0, IN_FLIGHT])
def test_a_pinned_base(bhr, tape, monkeypatch, when, capsys):
    def pin_base(world):
        place, turn = bullet.getBasePositionAndOrientation(world._body, physicsClientId=world._client)
        bullet.createConstraint(world._body, -1, -1, -1, bullet.JOINT_FIXED, [0, 0, 0], [0, 0, 0], place,
                                childFrameOrientation=turn, physicsClientId=world._client)  # fmt: skip

    at_step(monkeypatch, when, pin_base)
    result = simulate_jump(tape, bhr, stand_s=SHORT_S)
    assert "unexplained force on the body" in failed(result)
    print_simulation(result.to_json())
    assert "NOT HONEST: unexplained force on the body" in capsys.readouterr().out


def test_a_helping_hand(bhr, tape, monkeypatch):
    """5 % of the weight, all the time."""
    honest = BulletEngine.step

    def step(world):
        place = bullet.getBasePositionAndOrientation(world._body, physicsClientId=world._client)[0]
        bullet.applyExternalForce(world._body, -1, [0, 0, 20.6], place, bullet.WORLD_FRAME,
                                  physicsClientId=world._client)  # fmt: skip
        honest(world)

    monkeypatch.setattr(BulletEngine, "step", step)
    assert failed(simulate_jump(tape, bhr, stand_s=SHORT_S)) == {
        "unexplained force on the body",
        "unexplained moment on the body",
    }


@pytest.mark.parametrize(
    ("cheat", "steps", "caught"),
    [
        (lambda data: data.xfrc_applied.__setitem__((1, 2), 20.6), 1000, "unexplained force on the body"),
        (lambda data: data.qpos.__setitem__(2, data.qpos[2] + 0.01), 1, "largest jump of the state"),
        (lambda data: data.qvel.__setitem__(0, data.qvel[0] + 0.1), 1, "unexplained force on the body"),
    ],
)
def test_hands_in_mujoco(bhr, tape, monkeypatch, cheat, steps, caught):
    """5 % of the weight from mid-flight on; a place set; a velocity set."""
    honest, count = MujocoEngine.step, [0]

    def step(world):
        if IN_FLIGHT <= count[0] < IN_FLIGHT + steps:
            cheat(world._data)
        count[0] += 1
        honest(world)

    monkeypatch.setattr(MujocoEngine, "step", step)
    assert caught in failed(simulate_jump(tape, bhr, engine="mujoco", stand_s=SHORT_S))


def test_unlimited_torque(bhr, tape, monkeypatch):
    monkeypatch.setattr(Motors, "deliver", lambda motors, tau, rate: 3 * tau)
    assert "torque beyond the motors" in failed(simulate_jump(tape, bhr, mode="pd", stand_s=SHORT_S))


def test_torque_that_the_log_conceals(bhr, tape, monkeypatch):
    honest = BulletEngine.set_torque

    def stronger(world, tau):
        honest(world, 1.2 * tau)
        world._torque = tau

    monkeypatch.setattr(BulletEngine, "set_torque", stronger)
    assert failed(simulate_jump(tape, bhr, mode="pd", stand_s=SHORT_S)) == {"unexplained joint torque"}


def test_a_place_set_in_mid_run(bhr, tape, monkeypatch):
    def lift(world):
        (x, y, z), turn = bullet.getBasePositionAndOrientation(world._body, physicsClientId=world._client)
        bullet.resetBasePositionAndOrientation(world._body, (x, y, z + 0.01), turn, physicsClientId=world._client)

    at_step(monkeypatch, IN_FLIGHT, lift)
    assert "largest jump of the state" in failed(simulate_jump(tape, bhr, stand_s=SHORT_S))


def test_a_velocity_set_in_mid_run(bhr, tape, monkeypatch):
    def push(world):
        linear, angular = bullet.getBaseVelocity(world._body, physicsClientId=world._client)
        bullet.resetBaseVelocity(world._body, np.add(linear, (0.1, 0, 0)), angular, physicsClientId=world._client)

    at_step(monkeypatch, IN_FLIGHT, push)
    assert "unexplained force on the body" in failed(simulate_jump(tape, bhr, stand_s=SHORT_S))


def test_oversized_feet(bhr, tape, monkeypatch):
    honest, sole = engines.load_urdf, '<box size="0.24 0.1 0.03" />'
    assert sole in bhr.urdf
    longer = '<box size="0.27 0.1 0.03" />'
    monkeypatch.setattr(engines, "load_urdf", lambda urdf, *options: honest(urdf.replace(sole, longer), *options))
    result = simulate_jump(tape, bhr, stand_s=SHORT_S)
    assert "contact points outside the sole" in failed(result)
    assert result.settings["engine"]["beyond_sole_m"] == pytest.approx(0.015, abs=0.001)


def test_feet_that_press_beyond_their_sole(bhr, tape):
    """The same from the forces alone: wrenches of a robot with longer feet, judged by the stated ones."""
    result = simulate_jump(tape, bhr, stand_s=SHORT_S)
    small = replace(bhr, config_text=bhr.config_text.replace("[-0.10, 0.14]", "[-0.10, 0.13]"))
    assert small.foot.toe == bhr.foot.toe - 0.01
    names = {finding.name for finding in check(result, small) if not finding.passed}
    assert "CoP outside the sole" in names


def test_sticky_feet(bhr, tape, monkeypatch):
    """Stated 0.2, really 2: read back, and seen in the forces."""

    def sticky(robot, q, v, **options):
        return BulletEngine(robot, q, v, **{**options, "friction": 2.0})

    monkeypatch.setattr(jump, "engine_class", lambda name: sticky)
    result = simulate_jump(tape, bhr, perturbation=Perturbation(friction=0.2), stand_s=SHORT_S)
    assert failed(result) == {"friction used, of the stated coefficient", "friction read back, less the stated"}


def test_friction_that_never_reached_the_feet(bhr, tape, monkeypatch):
    """Bullet's default, 0.5, behind the back of the check that the world makes when it is built."""

    def default(world):
        for foot in world._feet:
            bullet.changeDynamics(world._body, foot, lateralFriction=0.5, physicsClientId=world._client)

    at_step(monkeypatch, 0, default)
    result = simulate_jump(tape, bhr, perturbation=Perturbation(friction=0.9), stand_s=SHORT_S)
    assert failed(result) == {"friction read back, less the stated"}
    assert result.settings["friction_read_back"] == 0.5


def test_slippery_ground_counts_too(bhr, tape, monkeypatch):
    def grease(world):
        bullet.changeDynamics(world._ground[0], -1, lateralFriction=0.7, physicsClientId=world._client)

    at_step(monkeypatch, 0, grease)
    result = simulate_jump(tape, bhr, stand_s=SHORT_S)
    assert failed(result) == {"friction read back, less the stated"}
    assert result.settings["friction_read_back"] == pytest.approx(0.8 * 0.7)


def test_self_collision_switched_off(bhr, tape, monkeypatch):
    honest = bullet.loadURDF

    def load(path, flags=0, **options):
        return honest(path, flags=flags & ~bullet.URDF_USE_SELF_COLLISION, **options)

    monkeypatch.setattr(bullet, "loadURDF", load)
    assert failed(simulate_jump(tape, bhr, stand_s=SHORT_S)) == {"links that pass through each other"}


@pytest.mark.parametrize(
    ("cheat", "found"),
    [
        (lambda model: model.opt.gravity.__setitem__(2, -9.7), "gravity read back, less the target's"),
        (lambda model: model.body_inertia.__imul__(0.99), "inertia read back, less the stated"),
        (lambda model: model.body_ipos.__iadd__(1e-4), "inertia read back, less the stated"),
        (lambda model: model.dof_armature.__setitem__(8, 1e-3), "damping and armature read back"),
    ],
)
def test_what_mujoco_has_is_read_back(bhr, tape, monkeypatch, cheat, found):
    """Too small to be felt in forces, and read back all the same."""
    honest = MujocoEngine.read_back

    def read_back(world):
        cheat(world._model)
        return honest(world)

    monkeypatch.setattr(MujocoEngine, "read_back", read_back)
    assert failed(simulate_jump(tape, bhr, engine="mujoco", stand_s=0.01)) == {found}


@pytest.mark.parametrize(
    ("cheat", "found"),
    [
        (lambda body, world: bullet.setGravity(0, 0, -9.7, **world), "gravity read back, less the target's"),
        (lambda body, world: bullet.changeDynamics(body, 3, localInertiaDiagonal=[1e-3] * 3, **world),
         "inertia read back, less the stated"),
    ],
)  # fmt: skip
def test_what_bullet_has_is_read_back(bhr, tape, monkeypatch, cheat, found):
    honest = BulletEngine.read_back

    def read_back(world):
        cheat(world._body, {"physicsClientId": world._client})
        return honest(world)

    monkeypatch.setattr(BulletEngine, "read_back", read_back)
    assert failed(simulate_jump(tape, bhr, stand_s=0.01)) == {found}


def test_a_landing_shorter_than_three_seconds(bhr, tape):
    result = simulate_jump(tape, bhr, stand_s=1.0)
    assert not result.landed and result.checks_passed
    claimed = replace(result, metrics=replace(result.metrics, landed=True))
    found = {finding.name: finding for finding in check(claimed, bhr)}
    short = found["claimed landing, short of 3 s by"]
    assert not short.passed and short.value == pytest.approx(STAND_S - 1.05, abs=0.002)
