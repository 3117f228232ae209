"""Every check of a simulated run says the right amount: logs of random numbers and plain cases, without an engine."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pinocchio as pin
import pytest

from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.sim.checks import STOP_RAD, check, unexplained, worst
from jumplab.sim.result import Metrics, SimulationResult
from jumplab.sim.scene import Block, Scene

ROBOT = Robot.load()
MODEL, FEET, JOINTS = ROBOT.model, ROBOT.foot.frames, ROBOT.joint_names
LINKS = ("trunk", *FEET, "left_arm")
H, G = 1e-3, np.array([0.0, 0.0, -9.8])
FRICTION = 0.7
# what a run is asked: name -> limit with one step of the engine per line of the log, limit with more of them, unit
ASKED = {
    "unexplained force on the body": (1.0, 6.0, "N"),
    "unexplained moment on the body": (0.5, 6.0, "N m"),
    "unexplained joint torque": (3.0, 3.0, "N m"),
    "largest jump of the state": (1e-4, 1e-3, "m or rad"),
    "unevenness of time": (1e-6, 1e-6, "s"),
    "torque beyond the motors": (1e-6, 1e-6, "N m"),
    "friction used, of the stated coefficient": (1.01, 1.01, ""),
    "CoP outside the sole": (1e-3, 1e-3, "m"),
    "friction read back, less the stated": (1e-6, 1e-6, ""),
    "contact points outside the sole": (1e-3, 1e-3, "m"),
    "links that pass through each other": (0.0, 0.0, ""),
    "damping and armature read back": (1e-6, 1e-6, "SI"),
    "mass read back, less the stated": (1e-3, 1e-3, "kg"),
    "inertia read back, less the stated": (1e-6, 1e-6, "kg m^2"),
    "gravity read back, less the target's": (1e-6, 1e-6, "m/s^2"),
    "claimed landing, short of 3 s by": (1e-6, 1e-6, "s"),
}


def run(n: int = 6, substeps: int = 1, **changes) -> SimulationResult:
    """A robot that hangs in its stance without weight: ``n`` lines of a log, all quiet but for what is changed."""
    engine = {"substeps": substeps, "friction": [FRICTION, FRICTION], "self_collision": True, "beyond_sole_m": 0.0,
              "damping": 0.0, "mass_kg": ROBOT.total_mass, "inertia_error": 0.0,
              "gravity": [0.0, 0.0, -ROBOT.gravity]}  # fmt: skip
    numbers = {f: 0.0 for f in ("standing_s", "max_torque_ratio", "max_speed_ratio", "self_collision_s",
                                "max_torque_ratio_before_touchdown", "max_speed_ratio_before_touchdown")}  # fmt: skip
    by_joint = {f: {} for f in ("max_torque_ratio_by_joint", "max_speed_ratio_by_joint", "saturated_s", "overspeed_s")}
    metrics = Metrics(**numbers, **by_joint, landed=False, reason="", stray_contacts=(), launch_impulse=(0.0, 0.0),
                      qp_solves=0, qp_failures=0)  # fmt: skip
    quiet = {
        "t": np.arange(n) * H, "q": np.tile(stance_configuration(ROBOT), (n, 1)), "v": np.zeros((n, MODEL.nv)),
        "tau": np.zeros((n, MODEL.nv - 6)), "foot_wrench": np.zeros((n, 2, 6)), "com": np.zeros((n, 3)),
        "com_velocity": np.zeros((n, 3)), "L": np.zeros(n), "rho": np.zeros(n), "phase": np.array(["flight"] * n),
        "touching": np.zeros((n, len(LINKS)), bool), "colliding": np.zeros(n, bool), "link_names": LINKS,
        "joint_names": JOINTS, "metrics": metrics, "robot": ROBOT}  # fmt: skip
    settings = {"engine": engine | changes.pop("engine", {}), "perturbation": {"friction": FRICTION}}
    settings |= changes.pop("settings", {})
    return SimulationResult(**(quiet | changes), settings=settings)


def said(result: SimulationResult) -> dict:
    return {f.name: f.value for f in check(result)}


def random_run(seed: int, substeps: int, n: int = 12) -> SimulationResult:
    """States, torques and wrenches that belong to no motion; every third foot in the air."""
    rng = np.random.default_rng(seed)
    middle, nv = stance_configuration(ROBOT), MODEL.nv
    q = np.array([pin.integrate(MODEL, middle, rng.normal(0, 0.02, nv) * ([5] * 6 + [1] * (nv - 6))) for _ in range(n)])
    motors = ROBOT.limits
    q[:, 7:] = np.clip(q[:, 7:], motors.lower + 0.03, motors.upper - 0.03)
    wrench = rng.normal(0, 30, (n, 2, 6)) * (rng.uniform(size=(n, 2, 1)) > 0.33)
    wrench[1, 0, 3:] = 0.0  # a force alone
    v = rng.normal(0, 1.0, (1, nv)) + rng.normal(0, 0.01, (n, nv))
    return run(n, substeps, q=q, v=v, tau=rng.normal(0, 20, (n, nv - 6)), foot_wrench=wrench)


def bodies(q, v) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Momentum, its moment about the world's origin, and the first moment of mass: one body at a time."""
    data, out = MODEL.createData(), np.zeros((3, 3))
    pin.forwardKinematics(MODEL, data, q, v)
    for body, place, twist in list(zip(MODEL.inertias, data.oMi, data.v, strict=True))[1:]:
        com, speed = place.act(body.lever), place.rotation @ (twist.linear + np.cross(twist.angular, body.lever))
        spin = place.rotation @ body.inertia @ twist.angular
        out += [body.mass * speed, spin + np.cross(com, body.mass * speed), body.mass * com]
    return tuple(out)


def places(q) -> list:
    data = MODEL.createData()
    pin.framesForwardKinematics(MODEL, data, q)
    return [data.oMf[MODEL.getFrameId(name)].copy() for name in FEET]


def generalised(result: SimulationResult, k: int, share: float) -> np.ndarray:
    """Inverse dynamics of one step in world axes, less the wrenches on the feet: (nv,)."""
    (q, v), (q_next, v_next) = ((result.q[i], result.v[i]) for i in (k, k + 1))
    arm = MODEL.inertias[1].lever
    spins, speeds = [], []  # of the base's CoM, world axes
    for state, rate in ((q, v), (q_next, v_next)):
        turn = pin.Quaternion(state[3:7]).matrix()
        spins.append(turn @ rate[3:6])
        speeds.append(turn @ (rate[:3] + np.cross(rate[3:6], arm)))
    there = pin.interpolate(MODEL, q, q_next, share)
    turn = pin.Quaternion(there[3:7]).matrix()
    r, w, u = turn @ arm, (1 - share) * spins[0] + share * spins[1], (1 - share) * speeds[0] + share * speeds[1]
    turning, moving = (spins[1] - spins[0]) / H, (speeds[1] - speeds[0]) / H
    speed = u - np.cross(w, r)
    origin = moving - np.cross(turning, r) - np.cross(w, np.cross(w, r))
    body = turn.T @ np.array([speed, w, origin - np.cross(w, speed), turning]).T
    joints = (1 - share) * v[6:] + share * v_next[6:]
    rate = np.concatenate([body[:, 0], body[:, 1], joints])
    change = np.concatenate([body[:, 2], body[:, 3], (v_next[6:] - v[6:]) / H])
    data, need = MODEL.createData(), pin.rnea(MODEL, MODEL.createData(), there, rate, change)
    for name, wrench in zip(FEET, result.foot_wrench[k], strict=True):
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        need -= pin.computeFrameJacobian(MODEL, data, there, MODEL.getFrameId(name), axes).T @ wrench
    return need


def momentum(result: SimulationResult, k: int) -> np.ndarray:
    """(6,) change of momentum and of its moment, less weight and wrenches."""
    (p, spin, first), (p_next, spin_next, first_next) = (bodies(result.q[i], result.v[i]) for i in (k, k + 1))
    force, moment = ROBOT.total_mass * G, np.cross((first + first_next) / 2, G)
    for place, wrench in zip(places(result.q[k]), result.foot_wrench[k], strict=True):
        force, moment = force + wrench[:3], moment + wrench[3:] + np.cross(place.translation, wrench[:3])
    return np.concatenate([(p_next - p) / H - force, (spin_next - spin) / H - moment])


@pytest.mark.parametrize("substeps", [1, 2, 5])
def test_what_the_log_does_not_explain(substeps):
    result = random_run(substeps, substeps)
    explained(result, substeps)
    for column in (0, 3):  # a force, then a moment that outweighs all else
        explained(replace(result, foot_wrench=result.foot_wrench + 1e5 * (np.arange(6) == column)), substeps)


def explained(result: SimulationResult, substeps: int) -> None:
    base, joints = unexplained(result)
    assert base.shape == (11, 6) and joints.shape == (11, MODEL.nv - 6)
    for k in range(11):
        need = generalised(result, k, 0.0 if substeps == 1 else 0.5)
        np.testing.assert_allclose(joints[k], need[6:] - result.tau[k], rtol=1e-8, atol=1e-6)
        expected = need[:6] if substeps == 1 else momentum(result, k)
        np.testing.assert_allclose(base[k], expected, rtol=1e-8, atol=1e-6)
    found = said(result)
    mean = np.abs(np.array([b.mean(axis=0) for b in (base[:, :3], base[:, 3:])])).max(axis=1)
    assert found["unexplained force on the body"] == pytest.approx(mean[0])
    assert found["unexplained moment on the body"] == pytest.approx(mean[1])
    assert found["unexplained joint torque"] == pytest.approx(np.abs(joints.mean(axis=0)).max())


@pytest.mark.parametrize("substeps", [1, 2])
def test_stated_pushes_are_explained(substeps):
    """Only in the steps that they are stated for, and with the moment of the place on which they act."""
    result, arm = random_run(substeps + 7, substeps), np.array([0.1, -0.05, 0.2])
    spans = {(2, 3): (30.0, -20.0, 5.0), (4, 4): (-7.0, 11.0, 0.0), (-2, 3): (0.0, 3.0, 9.0), (-5, 3): (50.0, 0.0, 0.0)}
    told = [{"step": step, "steps": steps, "force_n": list(force)} for (step, steps), force in spans.items()]
    alone, joints = unexplained(result)
    for place in (arm, np.zeros(3)):
        how = {"pushes": told} | ({"push_place_m": place.tolist()} if place.any() else {})
        base, same = unexplained(replace(result, settings=result.settings | how))
        np.testing.assert_array_equal(joints, same)
        for k in range(11):
            force = sum((np.array(f) for (step, n), f in spans.items() if step <= k < step + n), np.zeros(3))
            turn = pin.Quaternion(result.q[k, 3:7]).matrix()
            inward = np.concatenate([turn.T @ force, np.cross(place, turn.T @ force)])
            outward = np.concatenate([force, np.cross(result.q[k, :3] + turn @ place, force)])
            np.testing.assert_allclose(alone[k] - base[k], inward if substeps == 1 else outward, atol=1e-9)


def test_where_the_log_cannot_say_nothing_is_asked():
    result, motors = random_run(1, 1), ROBOT.limits
    touching, colliding, q = result.touching.copy(), result.colliding.copy(), result.q.copy()
    touching[2, LINKS.index(FEET[0])] = touching[3, LINKS.index("left_arm")] = True
    touching[11, LINKS.index("trunk")] = colliding[5] = colliding[11] = True
    q[7, 7 + 2], q[7, 7 + 3] = motors.lower[2] + 0.0199, motors.upper[3] - 0.0199
    q[8, 7 + 2], q[8, 7 + 3] = motors.lower[2] + 0.0201, motors.upper[3] - 0.0201
    q[9, 7 + 2], q[9, 7 + 3] = motors.lower[2] + STOP_RAD, motors.upper[3] - STOP_RAD
    base, joints = unexplained(replace(result, touching=touching, colliding=colliding, q=q))
    assert not base[3].any() and not joints[3].any()
    assert not joints[5].any() and base[5].all()
    assert list(np.flatnonzero(joints[7] == 0)) == [2, 3]
    for k in (0, 1, 2, 4, 6, 8, 9, 10):
        assert base[k].all() and joints[k].all()


def test_forces_count_by_their_mean_over_a_tenth_of_a_second():
    push = np.zeros((300, 3))
    push[120:160, 1] = -5.0
    assert worst(push) == pytest.approx(2.0)
    push[120:290, 1] = -5.0
    assert worst(push) == pytest.approx(5.0)
    push[:, 2] = 7.0 * (-1.0) ** np.arange(300)
    assert worst(push) == pytest.approx(5.0)
    assert (
        worst(np.full((4, 2), 3.0)) == pytest.approx(3.0) == worst(np.full((1, 2), 3.0))
        and worst(np.zeros((0, 2))) == 0.0
    )
    edge = np.zeros((101, 1))
    edge[0] = 100.0
    assert worst(edge) == pytest.approx(1.0)
    edge[0], edge[-1] = 0.0, 100.0
    assert worst(edge) == pytest.approx(1.0)


@pytest.mark.parametrize("substeps", [1, 4])
def test_jumps_of_the_state(substeps):
    """A state that its velocities lead to, and one that is beyond; what swings within that step, and in those beside
    it, is allowed for.
    """
    rng, n, nv = np.random.default_rng(3), 10, MODEL.nv
    v = rng.normal(0, 1.0, (n, nv))
    v[3:6] = v[2] + 1e-3 * rng.uniform(-1, 1, (3, nv))  # little room in the steps to 3, 4, 5
    q = [stance_configuration(ROBOT)]
    for k in range(n - 1):
        q.append(pin.integrate(MODEL, q[k], H * (v[k] + (1 + 1 / substeps) / 2 * (v[k + 1] - v[k]))))
    real = run(n, substeps, q=np.array(q), v=v)
    assert said(real)["largest jump of the state"] == pytest.approx(0.0, abs=1e-9)
    swings = np.abs(np.diff(v, axis=0)).max(axis=1)
    for at, column, amount in ((4, 1, 3e-3), (4, 9, -3e-3), (5, 9, 0.03), (8, 9, 0.03)):
        away = np.zeros(nv)
        away[column] = amount
        moved = [*q[:at], *[pin.integrate(MODEL, x, away) for x in q[at:]]]
        room = 3.0 * (1 - 1 / substeps) * swings[at - 2 : at + 1].max() * H
        found = said(replace(real, q=np.array(moved)))["largest jump of the state"]
        assert found == pytest.approx(abs(amount) - room, abs=2e-7)


def test_time_torque_and_what_the_engine_says():
    result = run()
    quiet = said(result)
    for name in ("unevenness of time", "torque beyond the motors", "friction read back, less the stated"):
        assert quiet[name] == pytest.approx(0.0, abs=1e-12)
    assert said(replace(result, t=np.where(result.t > 0.0025, result.t + 2e-4, result.t)))[
        "unevenness of time"
    ] == pytest.approx(2e-4)
    peak = ROBOT.limits.effort
    for row, sign in ((0, 1), (5, -1)):
        tau = result.tau.copy()
        tau[row, 3] = sign * (peak[3] + 0.25)
        assert said(replace(result, tau=tau))["torque beyond the motors"] == pytest.approx(0.25)
    v, tau = result.v.copy(), result.tau.copy()
    v[2, 6 + 3], tau[2, 3] = ROBOT.limits.speed[3], 1.0  # nothing is left at the speed limit
    assert said(replace(result, v=v, tau=tau))["torque beyond the motors"] == pytest.approx(1.0)
    told = {"friction": [0.7, 0.65], "self_collision": False, "beyond_sole_m": 0.02, "damping": 0.3,
            "mass_kg": ROBOT.total_mass - 0.4, "inertia_error": 0.02,
            "gravity": [0.1, 0.0, 0.3 - ROBOT.gravity]}  # fmt: skip
    found = said(run(engine=told))
    assert found["friction read back, less the stated"] == pytest.approx(0.05)
    assert found["contact points outside the sole"] == 0.02 and found["damping and armature read back"] == 0.3
    assert found["links that pass through each other"] == 1.0
    assert found["mass read back, less the stated"] == pytest.approx(0.4)
    assert found["inertia read back, less the stated"] == 0.02
    assert found["gravity read back, less the target's"] == pytest.approx(0.3)
    assert quiet["links that pass through each other"] == quiet["mass read back, less the stated"] == 0.0


def with_cop(result: SimulationResult, row: int, foot: int, point, force) -> SimulationResult:
    """A force [N] on one foot at a point in its own frame [m], in one row."""
    place, wrench = places(result.q[row])[foot], result.foot_wrench.copy()
    push = place.rotation @ force
    wrench[row, foot] = [*push, *np.cross(place.rotation @ point, push)]
    return replace(result, foot_wrench=wrench)


def test_friction_and_centre_of_pressure():
    foot, row = ROBOT.foot, 2
    lean = run()
    q = lean.q.copy()
    q[:, 3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3)).coeffs()  # soles are not level
    lean = replace(lean, q=q)
    middle = np.array([(foot.heel + foot.toe) / 2, 0.0, foot.sole_z])
    cases = [
        (np.array([foot.toe + 0.01, 0, 0]), 0.01), (np.array([foot.heel - 0.02, 0, 0]), 0.02),
        (np.array([0, foot.half_width + 0.03, 0]), 0.03), (np.array([0, -foot.half_width - 0.04, 0]), 0.04),
        (np.array([foot.toe + 0.01, foot.half_width + 0.02, 0]), 0.02), (np.array([foot.toe - 0.01, 0, 0]), 0.0),
    ]  # fmt: skip
    for which in (0, 1):
        for point, outside in cases:
            point = point * [1, 1, 0] + [0, 0, foot.sole_z]
            found = said(with_cop(lean, row, which, point, [20.0, -10.0, 300.0]))
            assert found["CoP outside the sole"] == pytest.approx(outside, abs=1e-12)
    pushed = with_cop(lean, row, 1, middle, [0.0, 0.0, 300.0])
    f = pushed.foot_wrench[row, 1]
    share = np.hypot(f[0], f[1]) / f[2] / FRICTION
    assert said(pushed)["friction used, of the stated coefficient"] == pytest.approx(share) and share > 0.1
    for factor, expected in ((49.9 / f[2], 0.0), (50.1 / f[2], share)):
        light = replace(pushed, foot_wrench=pushed.foot_wrench * factor)
        assert said(light)["friction used, of the stated coefficient"] == pytest.approx(expected)
    both = pushed.foot_wrench.copy()
    both[row, 0] = [400.0, 0, 50.0, 0, 0, 0]  # beside a loaded foot, one that is not
    both[5, 0] = [900.0, 0, 900.0, 0, 0, 0]  # the last line's wrench acted in no step of the log
    assert said(replace(pushed, foot_wrench=both))["friction used, of the stated coefficient"] == pytest.approx(share)


def on(scene: Scene, **changes) -> SimulationResult:
    return run(settings={"ground": asdict(scene)}, **changes)


def test_friction_is_judged_along_the_ground_that_is_there():
    middle = np.array([0.0, 0.0, ROBOT.foot.sole_z])
    force = pin.rpy.rpyToMatrix(0.1, 0.2, 0.0) @ [90.0, 40.0, 300.0]
    share = np.hypot(90, 40) / 300 / FRICTION
    slope = with_cop(on(Scene("slope", (Block(-20.0, 20.0, pitch_rad=0.2, roll_rad=0.1),))), 2, 0, middle, force)
    assert said(slope)["friction used, of the stated coefficient"] == pytest.approx(share)
    level = np.hypot(force[0], force[1]) / force[2] / FRICTION
    for result in (on(Scene.flat()), run()):
        found = said(with_cop(result, 2, 0, middle, force))
        assert found["friction used, of the stated coefficient"] == pytest.approx(level) and abs(level - share) > 0.05


@pytest.mark.parametrize("sunk, outside", [(0.0, 0.006), (0.01, 0.003), (0.02, 0.0), (0.05, 0.0)])
def test_soft_ground_presses_as_high_as_the_foot_has_sunk(sunk, outside):
    """A force that leans outward through a point 2 cm above the toe's edge meets the sole 6 mm beyond it."""
    q = run().q - sunk * np.eye(MODEL.nq)[2]
    point, force = np.array([ROBOT.foot.toe, 0.0, ROBOT.foot.sole_z + 0.02]), [-90.0, 0.0, 300.0]
    soft = with_cop(on(Scene("soft", (Block(-9, 9, soft_m=0.03),)), q=q), 2, 0, point, force)
    assert said(soft)["CoP outside the sole"] == pytest.approx(outside, abs=1e-12)
    hard = with_cop(on(Scene.flat(), q=q), 2, 0, point, force)
    assert said(hard)["CoP outside the sole"] == pytest.approx(0.006)


@pytest.mark.parametrize("beyond, outside", [(0.0, 0.0), (0.005, 0.0), (0.008, 0.003)])
def test_usual_contacts_act_as_far_ahead_as_half_their_depth(beyond, outside):
    """Feet that have sunk by 1 cm, of a run on usual contacts, and the same on hard ones."""
    q = run().q - 0.01 * np.eye(MODEL.nq)[2]
    point = np.array([ROBOT.foot.toe + beyond, 0.0, ROBOT.foot.sole_z])
    hard = with_cop(on(Scene.flat(), q=q), 2, 0, point, [0.0, 0.0, 300.0])
    usual = replace(hard, settings=hard.settings | {"engine": hard.settings["engine"] | {"contact": "usual"}})
    assert said(hard)["CoP outside the sole"] == pytest.approx(beyond, abs=1e-12)
    assert said(usual)["CoP outside the sole"] == pytest.approx(outside, abs=1e-12)


@pytest.mark.parametrize("lean, outside", [(0.69, 0.0), (0.71, 0.03)])
def test_a_foot_on_its_side_is_not_judged_by_its_sole(lean, outside):
    result, foot = run(), ROBOT.foot
    q = result.q.copy()
    q[:, 3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(np.arccos(lean), 0.0, 0.0)).coeffs()
    point = np.array([foot.toe + 0.03, 0.0, foot.sole_z])
    found = said(with_cop(replace(result, q=q), 2, 0, point, [0.0, 0.0, 300.0]))
    assert found["CoP outside the sole"] == pytest.approx(outside, abs=1e-12)


def test_the_last_step_counts():
    """The last line but one is the last whose wrench acted."""
    result = run(6)
    pushed = with_cop(result, 4, 0, np.array([0.0, 0.0, ROBOT.foot.sole_z]), [90.0, 0.0, 300.0])
    assert said(pushed)["friction used, of the stated coefficient"] == pytest.approx(0.3 / FRICTION)
    ended = with_cop(result, 5, 0, np.array([0.0, 0.0, ROBOT.foot.sole_z]), [90.0, 0.0, 300.0])
    assert said(ended)["friction used, of the stated coefficient"] == 0.0


def test_a_foot_may_move_within_a_step():
    """The pressure lies 3 cm beyond the toe where the foot was, inside where it is at the step's end; and back."""
    result, foot = run(), ROBOT.foot
    far = with_cop(result, 2, 0, np.array([foot.toe + 0.03, 0, foot.sole_z]), [0.0, 0.0, 300.0])
    assert said(far)["CoP outside the sole"] == pytest.approx(0.03)
    q = far.q.copy()
    q[3:, 0] += 0.02
    assert said(replace(far, q=q))["CoP outside the sole"] == pytest.approx(0.01)
    q[3:, 0] -= 0.04
    assert said(replace(far, q=q))["CoP outside the sole"] == pytest.approx(0.03)
    other = far.foot_wrench.copy()
    other[2, 1] = other[2, 0] * [1, 1, 1, 0, 0, 0]
    q = far.q.copy()
    q[3:, 0] += 0.04  # now the first foot is fine
    assert said(replace(far, q=q))["CoP outside the sole"] == pytest.approx(0.0)
    assert said(replace(far, foot_wrench=other))["CoP outside the sole"] == pytest.approx(0.03)


def test_a_claimed_landing_is_timed():
    """From touchdown on its feet alone; before it, and where none is claimed, nothing is asked."""
    name, n, down = "claimed landing, short of 3 s by", 60, 10
    phase = np.where(np.arange(n) >= down, "landing", "flight")
    fallen = run(n, phase=phase)
    landed = replace(fallen, metrics=replace(fallen.metrics, landed=True))
    assert said(fallen)[name] == 0.0
    assert said(landed)[name] == pytest.approx(3.0 - 0.05)
    assert said(replace(landed, phase=np.array(["flight"] * n)))[name] == pytest.approx(3.0)
    touching = landed.touching.copy()
    touching[:, LINKS.index(FEET[1])] = touching[5, 0] = True
    assert said(replace(landed, touching=touching))[name] == pytest.approx(3.0 - 0.05)
    touching[30, 3] = touching[40, 0] = True
    assert said(replace(landed, touching=touching))[name] == pytest.approx(3.0 - 0.02)
    long = run(3100, phase=np.where(np.arange(3100) >= down, "landing", "flight"))
    assert said(replace(long, metrics=landed.metrics))[name] == 0.0


@pytest.mark.parametrize("substeps", [1, 2])
def test_what_a_run_is_asked(substeps):
    found = check(run(substeps=substeps))
    assert [(f.name, f.limit, f.unit) for f in found] == [(k, x[substeps > 1], x[2]) for k, x in ASKED.items()]
    assert all(f.catches for f in found)
