"""The 1 kHz tape of a spatial plan, exact between the nodes: feet do not slip, momentum is kept, no wrench is missing.

Between nodes the plan's polynomials miss the contact by fractions of a millimetre. In launch the legs follow from base,
arms and the feet's pitch by inverse kinematics on all three levels, and the ground's wrenches take up what inverse
dynamics still misses. In flight the joints' polynomials stand; the base follows from L and the CoM's parabola.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
import pinocchio as pin

from jumplab.io.tape import RATE_HZ, Tape
from jumplab.models.spatial import CHART, SpatialModel
from jumplab.ocp.solution import PhaseSolution
from jumplab.robot import Robot
from jumplab.stages.reconstruction import SHORTEST_STEP
from jumplab.stages.spatial.start import generators
from jumplab.stages.spatial.terms import SpatialTerms

BALANCING = 2  # corrections, each a hundred times smaller than the one before
JOINING_S = 0.05  # after take-off, over which joints pass from the launch as held by the ground to the planned flight
LEG_STEPS = 3  # of Newton's method from errors below a millimetre
WRENCH_ARM_M = 0.05  # a moment of 0.05 N m costs what a force of 1 N does, where a missing wrench is shared out
FRICTION, LOADED_N = 0.5, 10.0  # of each foot; [N] below, the ratio is taken to this force instead
RATE_GAP, ACCELERATION_GAP = 0.01, 4.0  # [rad/s, rad/s^2] over one step, against the mean of its ends
LEAST_LOAD = 1e-3  # share of the weight that each foot counts as carrying there


def make_tape(terms: Mapping[str, SpatialTerms], phases: Mapping[str, PhaseSolution], gravity: float) -> Tape:
    """The tape of a solution; ``terms`` are those of its phases, by name."""
    b, flat, toe, flight = terms["flat"], phases["flat"], phases["toe"], phases["flight"]
    robot = b.robot.under_gravity(gravity)
    launch_s = flat.duration + toe.duration
    t = launch_s - np.arange(int(np.ceil(launch_s * RATE_HZ - 1e-9)), -1, -1) / RATE_HZ
    legs = Legs(b)
    q, v, a, w = _launch(terms, phases, legs, np.maximum(t, 0.0), gravity)
    late = np.append(np.arange(0, flight.duration - SHORTEST_STEP / RATE_HZ, 1 / RATE_HZ), flight.duration)
    stood = b.model.to_pinocchio(q, v, a)
    start = [stood, _flight(terms["flight"], flight, (q[-1], v[-1], a[-1]), [x[-1] for x in stood], late, gravity)]
    q, v, a = (np.concatenate(x) for x in zip(*start, strict=True))
    wrench = np.concatenate([w, np.zeros((len(late), 2, 6))])
    f, tau, com, spin = forces(robot, q, v, a, wrench, len(t))
    phase = np.repeat(["launch", "flight"], [len(t), len(late)])
    extra = {
        "com": com[:, :3],
        "com_velocity": com[:, 3:],
        "angular_momentum": spin,
        "toe_phase_start": flat.duration - t[0],
    }
    extra |= _travel(b.robot, q)
    times = np.concatenate([t - t[0], launch_s - t[0] + late])
    names = np.array(robot.foot.frames), np.array(robot.joint_names)
    return Tape(times, q, v, a, tau, phase, names[0], f, names[1], extra)


def holds_between(tape: Tape, robot: Robot) -> bool:
    """Whether motors and ground can give what the tape takes, also between the nodes, and rates are those of angles.

    The limits are those of the audit.
    """
    motors = [robot.actuators[name] for name in robot.joint_names]
    keys = "effort", "speed", "corner_speed", "no_load_speed"
    effort, speed, corner, free = (np.array([m[key] for m in motors]) for key in keys)
    rate = tape.v[:, 6:]
    left = np.clip((free - np.sign(tape.tau) * rate) / (free - corner), 0.0, 1.0)
    step = np.diff(tape.t)[:, None]
    moves = step[:, 0] > SHORTEST_STEP / RATE_HZ  # the instant of take-off is there twice
    gaps = (
        (np.diff(x, axis=0)[moves] / step[moves] - (y[1:] + y[:-1])[moves] / 2, most)
        for x, y, most in ((tape.q[:, 7:], rate, RATE_GAP), (rate, tape.a[:, 6:], ACCELERATION_GAP))
    )
    along, load = np.linalg.norm(tape.f[..., :2], axis=-1), np.maximum(tape.f[..., 2], LOADED_N)
    given = (
        np.all(np.abs(tape.tau) <= effort * left) and np.all(np.abs(rate) <= speed) and np.all(along <= FRICTION * load)
    )
    return bool(given and all(np.abs(gap).max() <= most for gap, most in gaps))


def _travel(robot, q: np.ndarray) -> dict[str, np.ndarray]:
    """How far the middle between the soles moves (3,) [m], and by how much the feet turn about the vertical [rad]."""
    model, data = robot.model, robot.model.createData()
    ends, turn = [], []
    for x in q:
        pin.framesForwardKinematics(model, data, x)
        frames = [data.oMf[model.getFrameId(name)] for name in robot.foot.frames]
        ends.append(np.mean([f.act(robot.foot.center) for f in frames], axis=0))
        left = np.mean([f.rotation[:, 1] for f in frames], axis=0)  # it stays level in a flip, too
        turn.append(np.arctan2(-left[0], left[1]))
    turned = np.unwrap(turn)
    return {"soles_travel": ends[-1] - ends[0], "feet_turn": np.array(turned[-1] - turned[0])}


class Legs:
    """Contact as functions of the chart, mapped over many instants."""

    def __init__(self, b: SpatialTerms):
        self.b, n = b, len(b.model.names)
        q, v, a = (ca.SX.sym(k, n) for k in "qva")
        rows = b.contact_rows(q)
        slope = ca.jtimes(rows, q, v)
        drift = ca.jtimes(slope, ca.vertcat(q, v), ca.vertcat(v, a))
        self._levels = ca.Function("levels", [q, v, a], [rows, slope, drift], {"cse": True})
        self._slope = ca.Function("slope", [q], [rows, ca.jacobian(rows, q)], {"cse": True})
        bodies = sorted({j for k in b.feet for j in b.chain(k)})
        self.columns = np.array([1, 3, 4] * b.short + [len(CHART) - 1 + j for j in bodies])
        self.pitches = np.cumsum([len(held) + 3 for held in b.held]) - 1  # rows that say how the feet pitch

    def held(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, flat: np.ndarray) -> tuple[np.ndarray, ...]:
        """Charts, rates and accelerations (n, .) with the legs moved so that the feet stay in their places.

        Where not ``flat`` (n,) the feet pitch as they did.
        """
        n, (q, v, a) = len(q), (x.copy() for x in (q, v, a))
        goals = [x.full().T.copy() for x in self._levels.map(n)(q.T, v.T, a.T)]
        for goal in goals:
            pitch = np.where(flat[:, None], 0.0, goal[:, self.pitches])
            goal[:] = 0.0
            goal[:, self.pitches] = pitch
        for _ in range(LEG_STEPS):
            rows, slope = (x.full() for x in self._slope.map(n)(q.T))
            slope = slope.reshape(rows.shape[0], n, -1).transpose(1, 0, 2)
            q[:, self.columns] += self._solved(slope, goals[0] - rows.T)
        slope = self._slope.map(n)(q.T)[1].full().reshape(goals[0].shape[1], n, -1).transpose(1, 0, 2)
        v[:, self.columns] += self._solved(slope, goals[1] - self._levels.map(n)(q.T, v.T, a.T)[1].full().T)
        a[:, self.columns] += self._solved(slope, goals[2] - self._levels.map(n)(q.T, v.T, a.T)[2].full().T)
        return q, v, a

    def _solved(self, slope: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Least changes (n, .) of the columns that make up for what rows are off by (n, .)."""
        rows = slope[:, :, self.columns]
        across = rows.transpose(0, 2, 1)
        return (across @ np.linalg.solve(rows @ across, off[..., None]))[..., 0]


def _launch(terms, phases, legs: Legs, t: np.ndarray, gravity: float):
    """Charts, rates, accelerations (n, .) and the feet's wrenches (n, 2, 6) about the world's origin at times ``t``."""
    flat, toe = phases["flat"], phases["toe"]
    first = t < flat.duration
    times = t[first], np.minimum(t[~first] - flat.duration, toe.duration)
    sampled = [np.concatenate(x) for x in zip(flat.sample(times[0]), toe.sample(times[1]), strict=True)]
    q, v, a = _balanced(legs, sampled, first, t, gravity)
    wrench = []
    for name, phase, at in (("flat", flat, times[0]), ("toe", toe, times[1])):
        b = terms[name]
        edges = [generators(b, side) for side in (0, 1)]
        z = np.stack([np.interp(at, phase.t, x) for x in phase.z[:, : b.n_forces].T], -1)
        wrench.append(np.stack([x @ e.T for x, e in zip(np.hsplit(z, 2), edges, strict=True)], 1))
    return q, v, a, np.concatenate(wrench)


def _balanced(legs: Legs, motion, flat: np.ndarray, t: np.ndarray, gravity: float):
    """The motion with feet held, its base moved by some micrometres so that the ground's force stays on the toes.

    Heels up, no ground force has a moment about the line of the toes: what the motion between nodes needs of it goes.
    """
    from scipy.integrate import cumulative_trapezoid  # slow to import

    up, model = np.flatnonzero(~flat), legs.b.model
    x = float(legs.b.places[:, 0].mean() + (legs.b.robot.foot.toe - legs.b.robot.foot.heel) / 2)
    q, v, a = (y.copy() for y in motion)
    push = np.eye(q.shape[1])[0]

    def moment(change: np.ndarray | float = 0.0):
        held = legs.held(q[up], v[up], a[up] + change, flat[up])
        need = np.array(list(_needed(model, *held, gravity)))
        return need[:, 4] + x * need[:, 2]

    missing = moment()
    gained = moment(push) - missing  # hardly changed by the corrections
    for k in range(BALANCING):
        more = -(moment() if k else missing) / gained
        rate = cumulative_trapezoid(more, t[up], initial=0.0)
        for y, change in ((q, cumulative_trapezoid(rate, t[up], initial=0.0)), (v, rate), (a, more)):
            y[up, 0] += change
    return legs.held(q, v, a, flat)


def _needed(model: SpatialModel, q: np.ndarray, v: np.ndarray, a: np.ndarray, gravity: float):
    """Wrenches (6,) about the world's origin that motions, as charts (n, .), need from the ground, one by one."""
    tree = model.model.copy()
    tree.gravity.linear = np.array([0.0, 0.0, -gravity])
    data = tree.createData()
    for motion in zip(*model.to_pinocchio(q, v, a), strict=True):
        need, (x, y, z, w) = pin.rnea(tree, data, *motion)[:6], motion[0][3:7]
        base = pin.Quaternion(w, x, y, z).toRotationMatrix()
        force = base @ need[:3]
        yield np.concatenate([force, base @ need[3:] + np.cross(motion[0][:3], force)])


def _flight(b: SpatialTerms, flight: PhaseSolution, chart0, stood, t: np.ndarray, gravity: float):
    """Configurations (n, nq), twists and accelerations (n, nv): joints as planned, the base as momentum demands.

    It begins where the launch ends, as charts and as Pinocchio has it; the joints are as planned a little later, and
    legs end where the feet meet their places, whatever the base has drifted by.
    """
    model, data = b.model, b.model.model.createData()
    pin.computeCentroidalMomentum(model.model, data, *stood[:2])
    pin.centerOfMass(model.model, data, *stood[:2])
    spin, com = data.hg.angular.copy(), (data.com[0].copy(), data.vcom[0].copy())
    halves = np.concatenate([t, (t[1:] + t[:-1]) / 2])
    planned = [x[:, 3:] for x in flight.sample(halves)]
    off = [x[len(CHART) :] - y[0] for x, y in zip(chart0, planned, strict=True)]
    joints = [x + y for x, y in zip(planned, _fading(off, halves), strict=True)]
    s = halves / t[-1]
    bends = (
        s**3 * (10 - 15 * s + 6 * s**2),
        30 * s**2 * (1 - s) ** 2 / t[-1],
        60 * s * (1 - s) * (1 - 2 * s) / t[-1] ** 2,
    )

    def moved():
        chart, rates = _turning(model, joints, chart0[0][3:6], spin, t)
        return _falling(model, [x[: len(t)] for x in joints], chart, rates, com, t, gravity)

    missed = _missed(b, flight, moved()[0][-1], gravity)
    joints = [x + missed * y[:, None] for x, y in zip(joints, bends, strict=True)]
    return moved()


def _turning(model: SpatialModel, joints, chart0: np.ndarray, spin: np.ndarray, t: np.ndarray):
    """Angles of the base (n, 3) and their rates at times ``t``, from L; ``joints`` are given there and half-way."""
    data, zero, neutral = model.model.createData(), np.zeros(6), pin.neutral(model.model)[:7]
    own, carried = np.empty((len(joints[0]), 3, 3)), np.empty((len(joints[0]), 3))
    for k, (qj, vj) in enumerate(zip(*joints[:2], strict=True)):
        pin.ccrba(model.model, data, np.concatenate([neutral, qj]), np.concatenate([zero, vj]))
        own[k], carried[k] = data.Ag[3:, 3:6], data.hg.angular
    own, (x, y, z) = np.linalg.inv(own), spin.tolist()

    def rate(angles, k):
        (cy, cr, cp), (sy, sr, sp) = np.cos(angles).tolist(), np.sin(angles).tolist()
        ahead, left = cy * x + sy * y, cy * y - sy * x
        up = cr * z - sr * left
        seen = np.array([cp * ahead - sp * up, cr * left + sr * z, sp * ahead + cp * up])  # L in base axes
        wx, wy, wz = (own[k] @ (seen - carried[k])).tolist()
        yaw = (cp * wz - sp * wx) / cr
        return np.array([yaw, cp * wx + sp * wz, wy - sr * yaw])

    n, chart = len(t), np.empty((len(t), 3))
    chart[0] = chart0
    for k in range(n - 1):  # Runge and Kutta, fourth order
        h, here, mid = t[k + 1] - t[k], chart[k], n + k
        k1 = rate(here, k)
        k2 = rate(here + h / 2 * k1, mid)
        k3 = rate(here + h / 2 * k2, mid)
        chart[k + 1] = here + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(here + h * k3, k + 1))
    return chart, np.array([rate(angles, k) for k, angles in enumerate(chart)])


def _missed(b: SpatialTerms, flight: PhaseSolution, q: np.ndarray, gravity: float) -> np.ndarray:
    """By what joints (nj,) of the last configuration ``q`` (nq,) have to change for the feet to stand as planned."""
    tree, c, t, still = b.model.model, flight.constants, flight.duration, np.zeros((1, b.model.model.nv))
    data, q = tree.createData(), q.copy()
    planned = b.model.to_pinocchio(np.concatenate([np.zeros(3), flight.q[-1]])[None], still, still)[0][0]
    com = np.array([c[f"com_{x}"] + c[f"vel_{x}"] * t for x in "xyz"]) - [0.0, 0.0, gravity * t**2 / 2]
    planned[:3] = com - pin.centerOfMass(tree, data, planned)
    pin.forwardKinematics(tree, data, planned)
    goals, first = [data.oMi[body + 1].copy() for body in b.feet], q[7:].copy()
    for _ in range(LEG_STEPS):
        pin.computeJointJacobians(tree, data, q)
        for body, goal in zip(b.feet, goals, strict=True):
            legs = 5 + np.array(b.chain(body))
            slope = pin.getJointJacobian(tree, data, body + 1, pin.ReferenceFrame.LOCAL)[:, legs]
            q[1 + legs] += np.linalg.pinv(slope) @ pin.log6(data.oMi[body + 1].inverse() * goal).vector
    return q[7:] - first


def _fading(off, t: np.ndarray) -> list[np.ndarray]:
    """A motion (n, k) on three levels that begins with ``off`` (k,) each and has ended after :data:`JOINING_S`."""
    s = np.clip(t / JOINING_S, 0.0, 1.0)
    ends = np.array([[1, 1, 1], [3, 4, 5], [6, 12, 20]])  # value, slope and curvature of s^3, s^4, s^5 at one
    x, v, a = (y * JOINING_S**k for k, y in enumerate(off))
    rest = np.linalg.solve(ends, -np.array([x + v + a / 2, v + a, a]))
    powers = np.concatenate([[x, v, a / 2], rest])  # (6, k) of a polynomial in s
    out = []
    for order in range(3):
        out.append(np.stack([s**k for k in range(len(powers))], -1) @ powers / JOINING_S**order)
        powers = powers[1:] * np.arange(1, len(powers))[:, None]
    return out


def _falling(model: SpatialModel, joints, chart, rates, com, t, gravity):
    """The base's place and accelerations where nothing but gravity acts."""
    tree, n = model.model.copy(), len(t)
    tree.gravity.linear = np.array([0.0, 0.0, -gravity])
    data, (qj, vj, aj) = tree.createData(), joints
    place, zero = np.zeros((n, 3)), np.zeros((n, 3))
    q, v, a = model.to_pinocchio(
        *(np.concatenate(x, 1) for x in ((place, chart, qj), (zero, rates, vj), (zero, zero, aj)))
    )
    fall = np.array([0.0, 0.0, -gravity])
    for k in range(n):
        pin.centerOfMass(tree, data, q[k], v[k])
        turn = data.oMi[1].rotation
        q[k, :3] = com[0] + com[1] * t[k] + fall * t[k] ** 2 / 2 - data.com[0]
        v[k, :3] = turn.T @ (com[1] + fall * t[k] - data.vcom[0])
        a[k, :6] = 0.0
        missing = pin.rnea(tree, data, q[k], v[k], a[k])[:6]
        inertia = np.triu(pin.crba(tree, data, q[k]))[:6, :6]
        a[k, :6] = -np.linalg.solve(inertia + np.triu(inertia, 1).T, missing)
    return q, v, a


def forces(
    robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray, wrench: np.ndarray, standing: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Wrenches at the feet's frames (n, 2, 6), motor torques, CoM with velocity (n, 6), L about the CoM (n, 3).

    What inverse dynamics misses of the ``wrench`` (n, 2, 6) about the origin is shared out among the feet by load.
    """
    model, data, n, world = robot.model, robot.model.createData(), len(q), pin.ReferenceFrame.WORLD
    frames = [model.getFrameId(name) for name in robot.foot.frames]
    joints = [model.frames[frame].parentJoint for frame in frames]
    need, com, spin = np.empty((n, model.nv)), np.empty((n, 6)), np.empty((n, 3))
    places, soles, slopes = np.zeros((standing, 2, 3)), np.zeros((standing, 2, 3)), np.zeros((standing, 2, 6, model.nv))
    base, turn = np.zeros((standing, 3)), np.zeros((standing, 3, 3))
    for k in range(n):
        need[k] = pin.rnea(model, data, q[k], v[k], a[k])
        pin.computeCentroidalMomentum(model, data, q[k], v[k])
        com[k, :3], com[k, 3:], spin[k] = data.com[0], data.hg.linear / robot.total_mass, data.hg.angular
        if k < standing:
            pin.computeJointJacobians(model, data, q[k])
            pin.updateFramePlacements(model, data)
            base[k], turn[k] = data.oMi[1].translation, data.oMi[1].rotation
            for i, (frame, joint) in enumerate(zip(frames, joints, strict=True)):
                places[k, i], soles[k, i] = data.oMf[frame].translation, data.oMf[frame].act(robot.foot.center)
                slopes[k, i] = pin.getJointJacobian(model, data, joint, world)
    force, moment = (np.einsum("nij,nj->ni", turn, need[:standing, at : at + 3]) for at in (0, 3))
    missing = np.concatenate([force, moment + np.cross(base, force)], axis=1) - wrench[:standing].sum(1)
    total = wrench[:standing] + _shared(
        wrench[:standing], soles, missing, LEAST_LOAD * robot.total_mass * robot.gravity
    )
    f = np.zeros((n, 2, 6))
    f[:standing] = total
    f[:standing, :, 3:] -= np.cross(places, total[..., :3])
    need[:standing] -= np.einsum("nkij,nki->nj", slopes, total)
    tau = need[:, 6:] + robot.lost_torque(v[:, 6:]) if robot.lossy else need[:, 6:]
    return f, tau, com, spin


def _shared(wrench: np.ndarray, soles: np.ndarray, missing: np.ndarray, least: float) -> np.ndarray:
    """What each foot (n, 2, 6) adds of ``missing`` (n, 6) about the origin: by its load, at its centre of pressure."""
    loaded = wrench[..., 2] > 0  # else in the middle of the sole (n, 2, 3)
    up = np.where(loaded, wrench[..., 2], 1.0)
    pressed = np.stack([-wrench[..., 4] / up, wrench[..., 3] / up, 0 * up], -1)
    x, y, z = np.moveaxis(np.where(loaded[..., None], pressed, soles), -1, 0)
    column, zero = np.tile(np.eye(6), (*wrench.shape[:2], 1, 1)), np.zeros_like(x)
    arm = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    column[..., 3:, :3] = arm.reshape(*x.shape, 3, 3)
    share = np.maximum(wrench[..., 2], least)[..., None] * np.repeat([1.0, WRENCH_ARM_M**2], 3)
    weighted = share[..., None] * np.swapaxes(column, -1, -2)  # (n, 2, 6, 6)
    whole = np.einsum("nkij,nkjl->nil", column, weighted)
    given = weighted @ np.linalg.solve(whole, missing[..., None])[:, None]
    return np.einsum("nkij,nkj->nki", column, given[..., 0])
