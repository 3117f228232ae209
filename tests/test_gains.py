"""Feedback gains of the MuJoCo folder: derivatives, the Riccati equation, and the player that uses them."""

import subprocess
import sys

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump, slopes
from fixtures_robots import needs_published
from scipy.linalg import solve_discrete_are

import jumplab as jl
from jumplab.io import export, gains
from jumplab.io.motion import Motion
from jumplab.io.whole import Whole
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration

WHOLE = Whole(Robot.load())
MODEL = WHOLE.model
STANCE = stance_configuration(WHOLE.robot)
NV = MODEL.nv


def on_toes() -> np.ndarray:
    """Both feet tipped by 0.2 rad."""
    q = STANCE.copy()
    for side in ("left", "right"):
        q[MODEL.idx_qs[MODEL.getJointId(f"{side}_ankle_pitch")]] += 0.2
    return q


@pytest.mark.parametrize(("q", "carries"), [(STANCE, [1, 1]), (on_toes(), [1, 1]), (STANCE, [0, 1]), (STANCE, [0, 0])])
def test_derivatives_are_those_of_the_dynamics(q, carries):
    rng = np.random.default_rng(3)
    dynamics = gains.Dynamics(WHOLE)
    v, tau = rng.normal(0, 1, NV), rng.normal(0, 20, NV - 6)
    held = dynamics.held(q, carries)
    assert [len(rows) for *_, rows in held] == [6 - (q is not STANCE)] * sum(carries)
    by_error, by_torque = dynamics.derivatives(q, v, tau, held)

    def away(error):
        """Accelerations beside the state; the springs, which are off it by its twist alone, by their definition."""
        there = pin.integrate(MODEL, q, error[:NV])
        free = dynamics.accelerations(there, v + error[NV:], tau, held)[0]
        jacobians = dynamics.jacobians(held)
        pin.computeJointJacobians(dynamics.model, dynamics.data, q)
        off = [j @ error[:NV] for j in dynamics.jacobians(held)]
        turns = [(dynamics.data.oMi[joint] * place).rotation for joint, place, _ in held]
        if held:
            middle = np.mean([turn @ x[:3] for turn, x in zip(turns, off, strict=True)], axis=0)
            for turn, x in zip(turns, off, strict=True):
                x[:3] -= turn.T @ middle
        springs = np.concatenate([np.zeros(NV), *(-gains.STIFFNESS * x for x in off)])
        pin.computeAllTerms(dynamics.model, dynamics.data, there, v)
        return free + dynamics.solved(jacobians, springs)[:NV]

    seen = slopes(away, np.zeros(2 * NV), 1e-6)
    assert np.abs(by_error - seen).max() < 1e-6 * np.abs(seen).max()
    seen = slopes(lambda push: dynamics.accelerations(q, v, push, held)[0], tau, 1.0)
    assert np.abs(by_torque - seen).max() < 1e-9 * np.abs(seen).max()


def test_gains_of_standing_solve_the_riccati_equation():
    """SciPy solves for errors without the base's place, on which nothing depends."""
    dynamics = gains.Dynamics(WHOLE)
    weight = np.zeros(NV)
    held = dynamics.held(STANCE, [1, 1])
    a, b = gains.discrete(*dynamics.derivatives(STANCE, weight, weight[6:], held))
    q, r = gains.costs(WHOLE)
    value = np.diag(q)
    for _ in range(3000):
        gain, value = gains.riccati(a, b, q, r, value)
    kept = slice(3, None)
    expected = solve_discrete_are(a[kept, kept], b[kept], np.diag(q[kept]), np.diag(r))
    assert np.abs(value[kept, kept] - expected).max() < 1e-6 * np.abs(expected).max()
    assert np.abs(gain[:, :3]).max() < 1e-9 * np.abs(gain).max()
    assert np.abs(np.linalg.eigvals((a - b @ gain)[kept, kept])).max() < 1


def test_gains_count_for_the_errors_of_mujoco(tmp_path, monkeypatch):
    """A state beside the motion asks for the same torques by its errors in MuJoCo and in Pinocchio."""
    rng = np.random.default_rng(1)
    rate = rng.normal(0, 1, NV)
    t = np.arange(0.0, 0.02, 0.001)
    q = np.array([pin.integrate(MODEL, STANCE, rate * x) for x in t])
    none = np.zeros((len(t), NV - 6))
    motion = Motion(t, q, np.tile(rate, (len(t), 1)), none, np.full(len(t), "launch"), "plan")
    folder = export.write("mujoco", motion, WHOLE.robot, tmp_path / "mujoco")
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    with np.load(folder / "motion.npz") as x:
        gain, qpos, qvel = x["gain"], x["qpos"][0], x["qvel"][0]
        assert gain.shape == (4, model.nu, 2 * model.nv) and x["gain_time"][1] == gains.PERIOD_S

    error = 1e-5 * rng.normal(0, 1, 2 * NV)
    there = np.array([pin.integrate(MODEL, row, error[:NV]) for row in q])
    beside = Motion(t, there, motion.v + error[NV:], none, motion.phase, "plan")
    other = export.write("mujoco", beside, WHOLE.robot, tmp_path / "beside")
    dq = np.zeros(model.nv)
    with np.load(other / "motion.npz") as x:
        mujoco.mj_differentiatePos(model, dq, 1.0, qpos, x["qpos"][0])
        asked = gain[0] @ np.concatenate([dq, x["qvel"][0] - qvel])

    monkeypatch.setattr(gains, "from_mujoco", lambda q, v, order: np.eye(2 * NV))
    own = gains.gains(WHOLE, WHOLE.frames(motion, 1000.0))[1][0] @ error
    assert np.abs(asked - own).max() < 1e-3 * np.abs(own).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bhr", pytest.param("g1_arms", marks=needs_published)])
def test_the_player_stands_with_its_gains_and_falls_without(name, tmp_path):
    plan = jump(0.4, 0.2, method="direct") if name == "bhr" else jl.plan(jl.JumpTask(0.4, 0.2), name)
    run = jl.simulate(plan)
    folder = export.write("mujoco", Motion.of(run), plan.robot, tmp_path / "mujoco")
    script = folder / "play.py"
    text = script.read_text()
    assert len(text.splitlines()) <= 60 and "jumplab" not in text

    def play(*arguments):
        return subprocess.run([sys.executable, script, *arguments], capture_output=True, text=True, cwd=tmp_path)

    with_gains, without = play(), play("--no-feedback")
    assert with_gains.returncode == 0 and with_gains.stdout.startswith("stands 2 s later"), with_gains.stderr
    assert without.returncode == 1 and without.stderr.startswith("falls: too far off the motion after")
