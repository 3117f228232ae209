"""Every way of cheating in the simulation is tried, and caught by the findings that the result carries."""

import json
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from paper.basin import WrongApex

from jumplab.cli.common import print_simulation
from jumplab.sim import MujocoEngine, Perturbation, simulate_jump
from jumplab.sim import loop as jump
from jumplab.sim.checks import check
from jumplab.sim.motors import Motors
from jumplab.sim.result import STAND_S

bullet = pytest.importorskip("pybullet", reason="PyBullet, behind whose back most of the cheats go, is not installed")
engines = import_module("jumplab.sim.bullet")
BulletEngine = engines.BulletEngine
SHORT_S = 0.05
IN_FLIGHT = 1200  # step; the tape takes off a little after one second and flies for half of one


@pytest.fixture(scope="module")
def short(bhr, tape):
    """A sound run that is over just after the landing."""
    return simulate_jump(tape, bhr, stand_s=SHORT_S)


def failed(result) -> set[str]:
    assert len(result.checks) == 16
    return {finding.name for finding in result.checks if not finding.passed}


def test_the_flight_is_where_the_cheats_expect_it(tape):
    assert tape.takeoff_time < IN_FLIGHT / 1000 - 0.05 and tape.t[-1] > IN_FLIGHT / 1000 + 0.05


LATE = Perturbation(friction=0.5, delay_s=0.003)


def test_a_jump_passes_its_checks(bhr, tape, capsys):
    result = simulate_jump(tape, bhr, perturbation=LATE, reaim=True)
    assert result.landed and result.checks_passed and failed(result) == set()
    said = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert said["checks_passed"] and all(row["passed"] for row in said["checks"])
    print_simulation(said)
    assert "checks: all 16 of the run passed" in capsys.readouterr().out


@pytest.mark.parametrize("engine, mode", [("bullet", "whole-body"), ("mujoco", "position")])
def test_on_usual_contacts_mechanics_hold_to_rounding(bhr, tape, engine, mode):
    """One step in each millisecond leaves nothing unexplained: so the edges of MuJoCo's friction pyramids are read."""
    result = simulate_jump(tape, bhr, engine=engine, mode=mode, contact="usual", stand_s=0.3)
    assert result.metrics.touchdown_s and failed(result) == set()
    assert result.settings["engine"]["contact"] == "usual" and result.settings["mode"] == mode
    for finding in result.checks[:3]:
        assert "unexplained" in finding.name and finding.value < 1e-4, finding


def test_quick_legs_pass(bhr, tape):
    """Re-aim swings the legs as fast as it may: the engine's own error is largest here."""
    result = simulate_jump(tape, bhr, disturbance=WrongApex(0.8, -0.17, 0.1), mode="pd", reaim=True, stand_s=SHORT_S)
    assert failed(result) == set()


def test_without_findings_nothing_passes(short):
    assert short.checks_passed and not replace(short, checks=()).checks_passed


def client(world):
    return {"physicsClientId": world._client}


def pin_base(world):
    place, turn = bullet.getBasePositionAndOrientation(world._body, **client(world))
    bullet.createConstraint(world._body, -1, -1, -1, bullet.JOINT_FIXED, [0, 0, 0], [0, 0, 0], place,
                            childFrameOrientation=turn, **client(world))  # fmt: skip


def set_place(world):
    (x, y, z), turn = bullet.getBasePositionAndOrientation(world._body, **client(world))
    bullet.resetBasePositionAndOrientation(world._body, (x, y, z + 0.01), turn, **client(world))


def set_velocity(world):
    linear, angular = bullet.getBaseVelocity(world._body, **client(world))
    bullet.resetBaseVelocity(world._body, np.add(linear, (0.1, 0, 0)), angular, **client(world))


def forget_friction(world):
    """Bullet's default, 0.5, behind the back of the check that the world makes when it is built."""
    for foot in world._feet:
        bullet.changeDynamics(world._body, foot, lateralFriction=0.5, **client(world))


def grease(world):
    bullet.changeDynamics(world._ground[0], -1, lateralFriction=0.7, **client(world))


def help_up(world):
    """5 % of the weight."""
    place = bullet.getBasePositionAndOrientation(world._body, **client(world))[0]
    bullet.applyExternalForce(world._body, -1, [0, 0, 20.6], place, bullet.WORLD_FRAME, **client(world))


FORCE, STATE = "unexplained force on the body", "largest jump of the state"
GROUND = "friction read back, less the stated"
ALWAYS = range(10**6)
CHEATS = {
    "a pinned base": (BulletEngine, pin_base, [0], FORCE),
    "a base pinned in flight": (BulletEngine, pin_base, [IN_FLIGHT], FORCE),
    "a place": (BulletEngine, set_place, [IN_FLIGHT], STATE),
    "a velocity": (BulletEngine, set_velocity, [IN_FLIGHT], FORCE),
    "a helping hand": (BulletEngine, help_up, ALWAYS, {FORCE, "unexplained moment on the body"}),
    "friction": (BulletEngine, forget_friction, [0], {GROUND}),
    "slippery ground": (BulletEngine, grease, [0], {GROUND}),
    "a hand in MuJoCo": (MujocoEngine, lambda w: w._data.xfrc_applied.__setitem__((1, 2), 20.6),
                         range(IN_FLIGHT, IN_FLIGHT + 1000), FORCE),
    "a place in MuJoCo": (MujocoEngine, lambda w: w._data.qpos.__setitem__(2, w._data.qpos[2] + 0.01),
                          [IN_FLIGHT], STATE),
    "a velocity in MuJoCo": (MujocoEngine, lambda w: w._data.qvel.__setitem__(0, w._data.qvel[0] + 0.1),
                             [IN_FLIGHT], FORCE),
}  # fmt: skip


@pytest.mark.parametrize("name", CHEATS)
def test_a_cheat_is_caught(bhr, tape, monkeypatch, name, capsys):
    """A set names all findings of a cheat; a name alone may have others beside it."""
    engine, cheat, steps, caught = CHEATS[name]
    real, count = engine.step, iter(ALWAYS)

    def step(world):
        if next(count) in steps:
            cheat(world)
        real(world)

    monkeypatch.setattr(engine, "step", step)
    result = simulate_jump(tape, bhr, engine=engine.name, stand_s=SHORT_S)
    assert failed(result) == caught if isinstance(caught, set) else caught in failed(result)
    print_simulation(result.to_json())
    assert f"CHECK FAILED: {FORCE}" in capsys.readouterr().out or FORCE not in failed(result)
    share = {"friction": 0.5, "slippery ground": 0.8 * 0.7}.get(name, 0.8)
    assert result.settings["friction_read_back"] == pytest.approx(share)


def test_unlimited_torque(bhr, tape, monkeypatch):
    monkeypatch.setattr(Motors, "deliver", lambda motors, tau, rate: 3 * tau)
    assert "torque beyond the motors" in failed(simulate_jump(tape, bhr, mode="pd", stand_s=SHORT_S))


def test_torque_that_the_log_conceals(bhr, tape, monkeypatch):
    real = BulletEngine.set_torque

    monkeypatch.setattr(BulletEngine, "set_torque", lambda world, tau: real(world, 1.2 * tau))
    monkeypatch.setattr(BulletEngine, "applied", lambda world: world._torque / 1.2)
    assert failed(simulate_jump(tape, bhr, mode="pd", stand_s=SHORT_S)) == {"unexplained joint torque"}


def test_oversized_feet(bhr, tape, monkeypatch):
    real, sole = engines.load_urdf, '<box size="0.24 0.1 0.03" />'
    assert sole in bhr.urdf
    longer = '<box size="0.27 0.1 0.03" />'
    monkeypatch.setattr(engines, "load_urdf", lambda urdf, *options: real(urdf.replace(sole, longer), *options))
    result = simulate_jump(tape, bhr, stand_s=SHORT_S)
    assert "contact points outside the sole" in failed(result)
    assert result.settings["engine"]["beyond_sole_m"] == pytest.approx(0.015, abs=0.001)


def test_feet_that_press_beyond_their_sole(bhr, short):
    """The same from the forces alone: wrenches of a robot with longer feet, judged by the stated ones."""
    small = replace(bhr, config_text=bhr.config_text.replace("[-0.10, 0.14]", "[-0.10, 0.13]"))
    assert small.foot.toe == bhr.foot.toe - 0.01
    names = {finding.name for finding in check(replace(short, robot=small)) if not finding.passed}
    assert "CoP outside the sole" in names


def test_sticky_feet(bhr, tape, monkeypatch):
    """Stated 0.2, really 2: read back, and seen in the forces."""

    class Sticky(BulletEngine):
        def __init__(self, robot, q, v, **options):
            super().__init__(robot, q, v, **{**options, "friction": 2.0})

    monkeypatch.setattr(jump, "engine_class", lambda name: Sticky)
    result = simulate_jump(tape, bhr, perturbation=Perturbation(friction=0.2), stand_s=SHORT_S)
    assert failed(result) == {"friction used, of the stated coefficient", "friction read back, less the stated"}


def test_self_collision_switched_off(bhr, tape, monkeypatch):
    real = bullet.loadURDF

    def load(path, flags=0, **options):
        return real(path, flags=flags & ~bullet.URDF_USE_SELF_COLLISION, **options)

    monkeypatch.setattr(bullet, "loadURDF", load)
    assert failed(simulate_jump(tape, bhr, stand_s=SHORT_S)) == {"links that pass through each other"}


@pytest.mark.parametrize(
    ("engine", "cheat", "found"),
    [
        (MujocoEngine, lambda w: w._model.opt.gravity.__setitem__(2, -9.7), "gravity read back, less the target's"),
        (MujocoEngine, lambda w: w._model.body_inertia.__imul__(0.99), "inertia read back, less the stated"),
        (MujocoEngine, lambda w: w._model.body_ipos.__iadd__(1e-4), "inertia read back, less the stated"),
        (MujocoEngine, lambda w: w._model.dof_armature.__setitem__(8, 1e-3), "damping and armature read back"),
        (BulletEngine, lambda w: bullet.setGravity(0, 0, -9.7, **client(w)), "gravity read back, less the target's"),
        (BulletEngine, lambda w: bullet.changeDynamics(w._body, 3, localInertiaDiagonal=[1e-3] * 3, **client(w)),
         "inertia read back, less the stated"),
    ],
)  # fmt: skip
def test_what_the_engine_has_is_read_back(bhr, tape, monkeypatch, engine, cheat, found):
    """Too small to be felt in forces, and read back all the same."""
    real = engine.read_back
    monkeypatch.setattr(engine, "read_back", lambda world: (cheat(world), real(world))[1])
    assert failed(simulate_jump(tape, bhr, engine=engine.name, stand_s=0.01)) == {found}


def test_a_landing_shorter_than_three_seconds(bhr, short):
    assert not short.landed and short.checks_passed
    claimed = replace(short, metrics=replace(short.metrics, landed=True))
    found = {finding.name: finding for finding in check(claimed)}
    lacking = found["claimed landing, short of 3 s by"]
    assert not lacking.passed and lacking.value == pytest.approx(STAND_S - SHORT_S - 0.05, abs=0.002)
