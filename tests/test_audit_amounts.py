"""Every check of the audit says the right amount, instant and place: tapes of random numbers, judged here once more.

No planner, and nothing of the audit's own: bodies are summed one by one, rates are differences, distances coal's.
"""

from __future__ import annotations

import math
from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest

from jumplab.auditing import audit
from jumplab.auditing.replay import replay
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.task import JumpTask

ROBOT = Robot.load()
FEET, JOINTS = ROBOT.foot.frames, ROBOT.joint_names
COLUMNS = ("base x", "base y", "base z", "base roll", "base pitch", "base yaw", *JOINTS)
LAUNCH, FLIGHT = 12, 13  # samples
TASKS = [
    JumpTask(0.2, 0.05),
    JumpTask(-0.3, 0.1, platform_m=0.25, rotation_rad=-2 * math.pi, gravity=9.0),
    JumpTask(0.4, 0.1, platform_m=-0.3, rotation_rad=2 * math.pi, gravity=11.0),
    None,
]


def random_tape(seed: int) -> Tape:
    """Numbers about a stance that are no motion at all, on steps of 0.5 to 1.5 ms."""
    rng, model, n = np.random.default_rng(seed), ROBOT.model, LAUNCH + FLIGHT
    t = np.cumsum([0.0, *rng.uniform(0.5e-3, 1.5e-3, LAUNCH - 1), 0.0, *rng.uniform(0.5e-3, 1.5e-3, FLIGHT - 1)])
    quiet = np.where(np.arange(model.nv) < 6, 1.0, 0.1 if seed in (5, 7) else 1.0)  # base or joints are askew
    q = np.array(
        [pin.integrate(model, stance_configuration(ROBOT), rng.normal(0, 0.1, model.nv) * quiet) for _ in range(n)]
    )
    q[:, 2] += rng.uniform(-0.02, 0.2, n)
    q[LAUNCH:, 0] += np.linspace(0.0, rng.normal(0, 0.5), FLIGHT)
    q[:, 3:7] *= 1 + rng.normal(0, 1e-9, (n, 1))  # less than what moves anything else
    f = rng.normal(0, [20.0, 20.0, 150.0, 5.0, 5.0, 5.0], (n, 2, 6))
    f[..., 2] += 100.0
    loud = {
        1: (2.0, 3000.0, 60.0),
        2: (2.0, 30.0, 1.0),
        6: (0.1, 300.0, 0.1),
    }  # of v, a and tau: each decides somewhere
    v, a, tau = (
        rng.normal(0, size, (n, k))
        for size, k in zip(loud.get(seed, (2.0, 30.0, 60.0)), (model.nv, model.nv, model.nv - 6), strict=True)
    )
    phase = np.array(["launch"] * LAUNCH + ["flight"] * FLIGHT)
    return Tape(t, q, v, a, tau, phase, np.array(FEET), f, np.array(JOINTS))


class Truth:
    """Values of a tape, worked out without the audit; ``said`` is check -> (value, time, label)."""

    def __init__(self, tape: Tape, task: JumpTask | None):
        self.tape, self.task, self.said = tape, task, {}
        self.model = pin.buildModelFromXML(ROBOT.urdf, pin.JointModelFreeFlyer())
        self.g = task.gravity if task else 9.8
        self.model.gravity.linear = np.array([0, 0, -self.g])
        self.mass = sum(body.mass for body in self.model.inertias)
        self.weight = self.mass * self.g
        self.data = self.model.createData()
        rows = [self.row(i) for i in range(len(tape.t))]
        for name in rows[0]:
            setattr(
                self, name, [row[name] for row in rows] if name == "foot" else np.array([row[name] for row in rows])
            )
        f = ROBOT.foot
        points = [
            np.array([x, y, f.sole_z]) for y in (-f.half_width, f.half_width) for x in np.linspace(f.heel, f.toe, 7)
        ]
        self.sole = np.array([[[place.act(p) for p in points] for place in row] for row in self.foot])
        self.toe, self.heel = self.sole[:, :, [6, 13]], self.sole[:, :, [0, 7]]

    def sums(self, q, v) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """CoM, its velocity, angular momentum about it, energy: a sum over the bodies."""
        pin.forwardKinematics(self.model, self.data, q, v)
        com, speed, parts = np.zeros(3), np.zeros(3), []
        for body, place, twist in list(zip(self.model.inertias, self.data.oMi, self.data.v, strict=True))[1:]:
            omega = place.rotation @ twist.angular
            rate = place.rotation @ (twist.linear + np.cross(twist.angular, body.lever))
            spin = place.rotation @ body.inertia @ twist.angular
            parts.append((body.mass, place.act(body.lever), rate, spin, omega))
            com, speed = com + body.mass * parts[-1][1] / self.mass, speed + body.mass * rate / self.mass
        spin = sum(s + m * np.cross(c - com, u - speed) for m, c, u, s, _ in parts)
        energy = sum(m * u @ u / 2 + s @ w / 2 + m * self.g * c[2] for m, c, u, s, w in parts)
        return com, speed, spin, energy

    def row(self, i: int) -> dict:
        q, v, a, h = self.tape.q[i], self.tape.v[i], self.tape.a[i], 1e-6
        com, speed, spin, energy = self.sums(q, v)
        beside = [self.sums(pin.integrate(self.model, q, s * v + s * s * a / 2), v + s * a) for s in (h, -h)]
        pin.framesForwardKinematics(self.model, self.data, q)
        feet = [self.data.oMf[self.model.getFrameId(name)].copy() for name in FEET]
        need = pin.rnea(self.model, self.data, q, v, a)
        for name, wrench in zip(FEET, self.tape.f[i], strict=True):
            axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            need -= pin.computeFrameJacobian(self.model, self.data, q, self.model.getFrameId(name), axes).T @ wrench
        change = [(x - y) / (2 * h) for x, y in zip(*beside, strict=True)]
        return {"com": com, "speed": speed, "spin": spin, "energy": energy, "acceleration": change[1],
                "spin_rate": change[2], "foot": feet, "need": need[6:]}  # fmt: skip

    def worst(self, name, values, t=None, labels=None, least=False):
        """Expect the largest (or least) of (N,) or (N, M) values."""
        values, t = np.asarray(values, float), self.tape.t if t is None else t
        at = np.unravel_index((np.argmin if least else np.argmax)(values), values.shape)
        self.said[name] = (values[at], t[at[0]], None if labels is None else labels[at[1]])

    def record(self):
        tape, t, m = self.tape, self.tape.t, self.model
        step = np.diff(t)
        inside = step > 0
        self.said["finite numbers"] = self.said["order of phases"] = (0, None, None)
        self.worst("time step", 1e3 * step, t[1:])
        self.worst("unit quaternion", np.abs(np.sqrt((tape.q[:, 3:7] ** 2).sum(axis=1)) - 1))
        mean = (tape.v[1:] + tape.v[:-1]) / 2 - np.diff(tape.a, axis=0) * step[:, None] / 12
        h = np.where(inside, step, 1.0)[:, None]
        moved = np.array([pin.difference(m, p, q) for p, q in zip(tape.q[:-1], tape.q[1:], strict=True)])
        self.worst("rates against positions", np.abs(moved / h - mean)[inside], t[1:][inside], COLUMNS)
        off = np.abs(np.diff(tape.v, axis=0) / h - (tape.a[1:] + tape.a[:-1]) / 2)[inside]
        self.worst("accelerations against rates", off, t[1:][inside], COLUMNS)
        place, rate = [], []
        for i in range(len(t)):
            if i in (0, LAUNCH):
                q, v = tape.q[i], tape.v[i]
            else:
                q = pin.integrate(m, q, mean[i - 1] * step[i - 1])
                v = v + (tape.a[i] + tape.a[i - 1]) / 2 * step[i - 1]
            place.append(1e3 * np.abs(pin.difference(m, tape.q[i], q)))
            rate.append(np.abs(v - tape.v[i]))
        self.worst("re-integrated positions", place, labels=COLUMNS)
        self.worst("re-integrated rates", rate, labels=COLUMNS)
        now = t[LAUNCH : LAUNCH + 1]
        self.worst("position at the switch", 1e3 * np.abs(moved[[LAUNCH - 1]]), now, COLUMNS)
        for name, x in (("rate", tape.v), ("acceleration", tape.a)):
            self.worst(f"{name} at the switch", np.abs(x[[LAUNCH]] - x[LAUNCH - 1]), now, COLUMNS)

    def symmetry(self):
        q, tau, f = self.tape.q, self.tape.tau, self.tape.f
        other = {"left": "right", "right": "left"}
        posture, effort = [], []
        for i, name in enumerate(JOINTS):
            side, rest = name.split("_", 1)
            k = JOINTS.index(f"{other[side]}_{rest}")
            sign = -1 if rest.endswith(("yaw", "roll")) else 1
            posture.append(q[:, 7 + k] - sign * q[:, 7 + i])
            effort.append((tau[:, k] - sign * tau[:, i]) / ROBOT.actuators[name]["effort"])
        posture += [q[:, 1] - q[0, 1], 2 * q[:, 3], 2 * q[:, 5]]
        effort += [(f[:, 0, 1] + f[:, 1, 1]) / self.weight, (f[:, 0, 2] - f[:, 1, 2]) / self.weight]
        names = ("lateral shift", "roll", "yaw")
        self.worst("left/right posture", 1e3 * np.abs(np.transpose(posture)), labels=(*JOINTS, *names))
        self.worst(
            "left/right effort", 100 * np.abs(np.transpose(effort)), labels=(*JOINTS, "lateral force", "foot load")
        )

    def dynamics(self):
        tape, share = self.tape, 100 / self.weight
        t, f, up, norm = tape.t, tape.f, np.array([0, 0, self.g]), lambda x: np.sqrt((x * x).sum(axis=-1))
        origin = np.array([[place.translation for place in row] for row in self.foot])
        push, moment = f[..., :3].sum(axis=1), np.zeros((len(t), 3))
        for k in range(2):
            moment += f[:, k, 3:] + np.cross(origin[:, k] - self.com, f[:, k, :3])
        self.worst("base force residual", share * norm(self.mass * (self.acceleration + up) - push))
        self.worst("base moment residual", share * norm(self.spin_rate - moment))
        peak = np.array([ROBOT.actuators[name]["effort"] for name in JOINTS])
        self.worst("joint torque consistency", 100 * np.abs(tape.tau - self.need) / peak, labels=JOINTS)
        step, sums = np.diff(t)[:, None], []
        for rate in (push - self.mass * up, moment):
            sums.append(np.cumsum(np.vstack([np.zeros(3), (rate[1:] + rate[:-1]) / 2 * step]), axis=0)[:LAUNCH])
        gained = self.mass * (self.speed - self.speed[0])[:LAUNCH]
        there = self.mass * norm(self.speed[LAUNCH - 1])
        self.worst("linear impulse", 100 * norm(gained - sums[0]) / there)
        self.worst("angular impulse", norm((self.spin - self.spin[0])[:LAUNCH] - sums[1]))
        last = [LAUNCH - 1]
        self.worst("zero force at take-off", share * norm(push[last]), t[last])
        self.worst("zero moment at take-off", share * norm(moment[last]), t[last])
        both = [LAUNCH - 1, LAUNCH]
        self.worst("free fall at take-off", 100 / self.g * norm(self.acceleration[both] + up), t[both])
        power = (tape.tau * tape.v[:, 6:]).sum(axis=1)
        work = np.cumsum([0.0, *((power[1:] + power[:-1]) / 2 * step[:, 0])])
        span = self.energy.max() - self.energy.min()
        self.worst("energy balance", 100 * np.abs(self.energy - self.energy[0] - work) / span)
        lift = (self.acceleration + up)[:LAUNCH, 2]
        moved = np.linalg.lstsq(lift[:, None], push[:LAUNCH, 2], rcond=None)[0][0]
        self.said["mass"] = (100 * abs(moved / self.mass - 1), None, None)

    def flying(self):
        s, t, norm = slice(LAUNCH, None), self.tape.t[LAUNCH:], lambda x: np.sqrt((x * x).sum(axis=-1))
        since, com, f = (t - t[0])[:, None], self.com[s], self.tape.f[s]
        path = com[0] + self.speed[LAUNCH] * since - np.array([0, 0, self.g]) * since**2 / 2
        self.worst("ballistic CoM", 1e3 * norm(com - path), t)
        powers = np.vander(since[:, 0] * 100, 3)
        curve = np.linalg.lstsq(powers, com[:, 2], rcond=None)[0][0] * 2e4
        self.said["gravity in flight"] = (100 * abs(-curve / self.g - 1), None, None)
        self.worst("angular momentum in flight", norm(self.spin[s] - self.spin[LAUNCH]), t)
        self.worst("no force in flight", norm(f[..., :3]) + norm(f[..., 3:]), t, FEET)

    def surface(self, x):
        """Height under x: the landing surface begins 5 cm behind the landing soles, or ends 5 cm ahead of the toes."""
        x = np.asarray(x)
        if self.task is None:
            low = self.sole[-1, ..., 2].min()
        else:
            low = self.task.platform_m
        ahead = 1 if self.toe[-1, ..., 0].mean() >= self.toe[0, ..., 0].mean() else -1
        first, last = (ahead * self.sole[[0, -1], ..., 0]).max(axis=(1, 2))[0], (ahead * self.sole[-1, ..., 0]).min()
        edge = min(max(last - 0.05, first), last) if low > 0 else first + 0.05
        self.low, self.ahead, self.edge = low, ahead, ahead * edge
        return np.where(ahead * x >= edge if low > 0 else ahead * x > edge, low, 0.0)

    def contact(self):
        t, f = self.tape.t, self.tape.f
        slip = np.hypot(*np.moveaxis((self.toe - self.toe[0])[:LAUNCH, ..., :2], -1, 0)).max(axis=-1)
        self.worst("toe slip", 1e3 * slip, t, FEET)
        left = np.array([[place.rotation[:2, 1] for place in row] for row in self.foot[:LAUNCH]])
        heading = np.arctan2(-left[..., 0], left[..., 1])
        self.worst("foot turn", 1e3 * np.abs(heading - heading[0]), t, FEET)
        self.worst("toe on the ground", 1e3 * np.abs(self.toe[:LAUNCH, ..., 2]).max(axis=-1), t, FEET)
        above = 1e3 * (self.sole[..., 2] - self.surface(self.sole[..., 0])).min(axis=-1)
        self.worst("penetration", -above, labels=FEET)
        air = t[-1] - t[LAUNCH]
        middle = (t >= t[LAUNCH] + 0.3 * air) & (t <= t[LAUNCH] + 0.7 * air)
        self.worst("foot clearance", above[middle], t[middle], FEET, least=True)
        beyond, tipped, twist, used = (np.zeros((len(t), 2)) for _ in range(4))
        for i, k in np.ndindex(len(t), 2):
            force, moment, place = f[i, k, :3], f[i, k, 3:], self.foot[i][k]
            used[i, k] = np.hypot(*force[:2]) / max(force[2], 10.0)
            loaded, beyond[i, k] = force[2] > 50.0, -np.inf
            if not loaded:
                continue
            # moment about the point: moment + (place - point) x force, horizontal parts zero on the ground
            across = np.array([[0.0, force[2]], [-force[2], 0.0]])
            ground = self.surface(self.toe[i, k].mean(axis=0)[0])
            about = moment + np.cross(place.translation - [0.0, 0.0, ground], force)
            cop = np.array([*np.linalg.solve(across, about[:2]), ground])
            torsion = (moment + np.cross(place.translation - cop, force))[2]
            toe, heel = self.toe[i, k].mean(axis=0)[:2], self.heel[i, k].mean(axis=0)[:2]
            along = place.rotation[:2, 0] / np.hypot(*place.rotation[:2, 0])
            x, y = along @ (cop[:2] - toe), along[0] * (cop[1] - toe[1]) - along[1] * (cop[0] - toe[0])
            beyond[i, k] = 1e3 * max(x, -x - along @ (toe - heel), abs(y) - ROBOT.foot.half_width)
            tipped[i, k] = 1e3 * abs(x) * (self.heel[i, k, :, 2].min() > 0.005)
            twist[i, k] = 100 * abs(torsion) / (0.5 * 0.05 * force[2])
        some = (f[..., 2] > 50.0).any(axis=1)
        self.worst("CoP in the sole", beyond[some], t[some], FEET)
        for name, x in (("CoP at the toe", tipped), ("torsional friction", twist), ("friction used", used)):
            self.worst(name, x, labels=FEET)
        self.worst("ground only pushes", -f[..., 2], labels=FEET)

    def joints(self):
        tape, motors = self.tape, [ROBOT.actuators[name] for name in JOINTS]
        low, high, peak, top, corner = (
            np.array([m[k] for m in motors]) for k in ("lower", "upper", "effort", "speed", "corner_speed")
        )
        angle, speed, torque = tape.q[:, 7:], tape.v[:, 6:], np.abs(tape.tau)
        self.worst("joint range", 1e3 * np.maximum(angle - high, low - angle), labels=JOINTS)
        self.worst("joint speed", 100 * np.abs(speed) / top, labels=JOINTS)
        self.worst("joint torque", 100 * torque / peak, labels=JOINTS)
        left = np.clip((top - np.abs(speed)) / (top - corner), 0.01, 1.0)
        left = np.where(tape.tau * speed > 0, left, 1.0)
        self.worst("torque at speed", 100 * torque / (left * peak), labels=JOINTS)

    def target(self):
        t, end, task = self.tape.t, self.tape.t[-1:], self.task
        low = self.sole[-1, ..., 2].min() if task is None else task.platform_m
        self.worst("sole on the surface", 1e3 * np.abs(self.sole[-1:, ..., 2] - low).max(axis=-1), end, FEET)
        tilt = [[math.acos(min(1.0, place.rotation[2, 2])) for place in self.foot[-1]]]
        self.worst("sole flat at touchdown", 1e3 * np.array(tilt), end, FEET)
        if task is None:
            return
        self.worst("start at rest", np.abs(self.tape.v[:1]), t[:1], ("base",) * 6 + JOINTS)
        travel = (self.toe[-1] - self.toe[0]).mean(axis=1)
        miss = [[math.hypot(x - task.distance_m, y) for x, y, _ in travel]]
        self.worst("distance", 1e3 * np.array(miss), end, FEET)
        height = self.com[LAUNCH:, 2]
        rise = abs(height.max() - height[0] - task.height_m)
        self.said["rise"] = (1e3 * rise, t[LAUNCH + np.argmax(height)], None)
        pitch = [[math.atan2(-p.rotation[2, 0], p.rotation[2, 2]) for p in row] for row in self.foot]
        self.turned = turn = np.sum((np.diff(pitch, axis=0) + np.pi) % (2 * np.pi) - np.pi, axis=0)
        self.worst("rotation", 1e3 * np.abs(turn - task.rotation_rad)[None], end, FEET)

    def collisions(self):
        """Distances by coal, at every other sample and the last."""
        shapes = list(pin.buildGeomFromUrdfString(self.model, ROBOT.urdf, pin.GeometryType.COLLISION).geometryObjects)
        self.surface(0.0)
        world, (low, high) = (
            [("ground", coal.Halfspace(np.array([0, 0, 1.0]), min(0.0, self.low)), pin.SE3.Identity())],
            (sorted([0.0, self.low])),
        )
        if high - low > 1e-6:
            towards = self.ahead if self.low > 0 else -self.ahead
            middle = np.array([self.edge + 10.0 * towards, 0.0, high - 10.0])
            world.append(("platform", coal.Box(20.0, 20.0, 20.0), pin.SE3(np.eye(3), middle)))
        feet = {self.model.frames[self.model.getFrameId(name)].parentJoint for name in FEET}
        rows = [*range(0, len(self.tape.t), 2)]
        rows += [] if rows[-1] == len(self.tape.t) - 1 else [len(self.tape.t) - 1]
        inner, outer, names = [], [], [[], []]
        for i in rows:
            pin.forwardKinematics(self.model, self.data, self.tape.q[i])
            place = [self.data.oMi[s.parentJoint] * s.placement for s in shapes]
            near = self.model.parents
            found, names[0] = [], []
            for a, one in enumerate(shapes):
                for b in range(a + 1, len(shapes)):
                    p, c = one.parentJoint, shapes[b].parentJoint
                    if p != c and near[p] != c and near[c] != p:
                        found.append(gap(one.geometry, place[a], shapes[b].geometry, place[b]))
                        names[0].append(f"{one.name} - {shapes[b].name}")
            inner.append(found)
            found, names[1] = [], []
            for name, shape, there in world:
                for s, here in zip(shapes, place, strict=True):
                    if s.parentJoint not in feet:
                        found.append(gap(s.geometry, here, shape, there))
                        names[1].append(f"{s.name} - {name}")
            outer.append(found)
        self.worst("self-collision", inner, self.tape.t[rows], names[0], least=True)
        self.worst("body clearance", outer, self.tape.t[rows], names[1], least=True)
        self.said["sole as in the URDF"], self.said["links have mass"] = (0.0, None, None), (0, None, None)


def gap(one, place, other, there) -> float:
    """Distance between two shapes [mm], negative if they overlap."""
    result, at = coal.DistanceResult(), [coal.Transform3s(x.rotation, x.translation) for x in (place, there)]
    return 1e3 * coal.distance(one, at[0], other, at[1], coal.DistanceRequest(), result)


GROUPS = ("record", "symmetry", "dynamics", "flying", "contact", "joints", "target", "collisions")


@cache
def truth(seed: int) -> Truth:
    found = Truth(random_tape(seed), TASKS[seed % len(TASKS)])
    for group in GROUPS:
        getattr(found, group)()
    return found


@pytest.mark.parametrize("seed", range(8))
def test_every_amount_instant_and_place(seed):
    known = truth(seed)
    found = audit(known.tape, ROBOT, known.task)
    assert {c.name for c in found.checks} == set(known.said)
    for c in found.checks:
        value, time, label = known.said[c.name]
        assert c.value == pytest.approx(value, rel=1e-5, abs=1e-6), c.name
        assert c.time == time, c.name
        assert label is None or c.note.endswith(f"; worst: {label}"), c.name


def test_where_the_surfaces_change_on_the_way_to_a_side():
    """3, 4 and 5 tenths: the way to a platform at the side, and where on it the two surfaces meet."""
    tape, task = random_tape(0), JumpTask(0.3, 0.2, 0.1, side_m=0.4)
    told, found = (replay(tape, ROBOT, task, x) for x in (0.2, None))
    points = np.array([[1.0, 0.0, 7.0], [0.0, 1.0, 7.0], [2.0, -1.0, 0.0]])
    np.testing.assert_allclose(told.along(points), [0.6, 0.8, 0.4])
    assert told.heading == found.heading == 1.0
    soles = told.sole_points
    middle = soles[0].reshape(-1, 3).mean(axis=0)
    toes = 0.6 * middle[0] + 0.8 * middle[1] + ROBOT.foot.toe - ROBOT.foot.center[0]
    assert told.edge == pytest.approx(toes + 0.2, abs=1e-12)
    launched, landed = (x[..., 0] * 0.6 + x[..., 1] * 0.8 for x in (soles[0], soles[-1]))
    natural = min(max(landed.min() - 0.05, launched.max()), landed.min())
    assert found.edge == pytest.approx(natural, abs=1e-12)
    np.testing.assert_array_equal(told.surface(told.edge + np.array([-1e-3, 0.0, 1e-3])), [0.0, 0.1, 0.1])
