"""Each term's expression at a random state: stage 3's against Pinocchio, stage 1's against formulas written out here.

Every term of both stages is looked at, its weight and all boxes too, and so is all that an own term sees by name.
"""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import full_state, inverse_dynamics, turned

from jumplab.ocp import Problem, Term
from jumplab.ocp.problem import Phase, Point
from jumplab.robot import Robot
from jumplab.robot.reach import reach
from jumplab.stages import srmp, whole_body
from jumplab.stages.srmp import SrmpSettings
from jumplab.stages.whole_body import Limits, Weights

G, LIM, S = 9.8, Limits(), SrmpSettings()
SIDES = np.array([1.0, -1.0])


def point(phase: Phase, rng: np.random.Generator, parameters: dict, **fixed) -> Point:
    """A point of a phase at random numbers."""
    n, sx = len(phase.coordinates), ca.SX
    values = {k: fixed.get(k, size * rng.normal(size=n)) for k, size in (("q", 0.4), ("v", 2.0), ("a", 8.0), ("j", 90))}
    z = np.asarray(fixed.get("z", 0.3 * rng.normal(size=len(phase.states))))
    names = {k: sx(float(v)) for k, v in fixed.get("c", {}).items()}
    refs = {k: sx(rng.normal(size=size)) for k, size in phase.references.items()}
    data = {k: sx(np.asarray(v, float)) for k, v in parameters.items()}
    spaces = (SimpleNamespace(**x) for x in (names, data, refs))
    x = [sx(values[k]) for k in "qvaj"]
    return Point(*x, sx(z), sx(fixed.get("duration", 0.6)), sx(fixed.get("s", 0.35)), *spaces, view=phase.view)


def numbers(x) -> np.ndarray:
    x = ca.vertcat(*x) if isinstance(x, list | tuple) else ca.SX(x)
    return np.array(ca.evalf(x)).ravel()


def check(terms: dict[str, Term], expected: dict, *seen) -> None:
    """Every term of a phase at these places has the value that is expected."""
    assert set(terms) == set(expected)
    for name, value in expected.items():
        found = numbers(terms[name].expression(*seen))
        np.testing.assert_allclose(found, np.ravel(value), rtol=1e-8, atol=1e-7, err_msg=name)


def of(problem: Problem, phase: str, *places: str) -> dict[str, Term]:
    return {t.name: t for owner, t in problem.terms() if owner == phase and t.at in places}


# stage 3 --------------------------------------------------------------------------------------------------------
class Body:
    """The full robot in the state of a point, through Pinocchio alone."""

    def __init__(self, robot: Robot, p: Point, flying: bool):
        q, self.v, self.a = (numbers(x) for x in (p.q, p.v, p.a))
        self.q, self.v, self.a = (np.pad(x, (5 - len(x), 0)) for x in (q, self.v, self.a))
        self.robot, self.m, self.c = robot, robot.sagittal, {k: float(v) for k, v in vars(p.c).items()}
        first = self._place(np.zeros(2), np.zeros(2), np.zeros(2))
        self.relative = first
        if not flying:
            self.toe, self.toe_velocity = np.zeros(2), np.zeros(2)
            self._take(first)
            self.force = robot.total_mass * (first["acceleration"] + np.array([0.0, G]))
            x, z = first["com"]
            moment = first["L_rate"] + z * self.force[0] - x * self.force[1]
            self.wrench = np.array([*self.force, moment])
            left = inverse_dynamics(robot, *first["state"], self.wrench, (0.0, 0.0))
        else:
            t, c = float(p.time), self.c
            com = np.array([c["com_x"] + c["vel_x"] * t, c["com_z"] + c["vel_z"] * t - G * t * t / 2])
            self.toe = com - first["com"]
            self.toe_velocity = np.array([c["vel_x"], c["vel_z"] - G * t]) - first["com_velocity"]
            self._take(self._place(self.toe, self.toe_velocity, np.array([0.0, -G]) - first["acceleration"]))
            self.wrench = np.zeros(3)
            left = inverse_dynamics(robot, *self.state, self.wrench, self.toe)
            # a robot in free fall whose L changes needs a moment from nowhere; joint torques do not see it
        model, tau = robot.model, np.zeros(4)
        for name, row, sign in robot.role_signs():
            tau[row] += sign * left[model.idx_vs[model.getJointId(name)]]
        self.torques, self.base_left = tau, left[:6]
        self.joints, self.rates, self.accels = (self.m.joint_angles(x) for x in (self.q, self.v, self.a))

    def _take(self, found: dict) -> None:
        for key, value in found.items():
            setattr(self, key, value)

    def _place(self, toe, velocity, acceleration) -> dict:
        robot, model = self.robot, self.robot.model
        q, v, a = full_state(robot, self.q, self.v, self.a, toe, velocity, acceleration)
        data = model.createData()
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        pin.ccrba(model, data, q, v)
        mass = robot.total_mass
        found = dict(state=(q, v, a), com=data.com[0][[0, 2]].copy(), L=data.hg.angular[1], L_rate=data.dhg.angular[1])
        found |= dict(com_velocity=data.hg.linear[[0, 2]] / mass, acceleration=data.dhg.linear[[0, 2]] / mass)

        def inertia(h):
            pin.ccrba(model, data, pin.integrate(model, q, h * v), v)
            return float(data.Ig.inertia[1, 1])

        return found | dict(rho=inertia(0.0), rho_rate=(inertia(1e-5) - inertia(-1e-5)) / 2e-5)

    def point(self, link: int, arm) -> np.ndarray:
        """(x, z) of a point fixed in a link: the chain of spans below it, each turned by its own angle."""
        below = [turned(self.q[i], self.m.span[i]) for i in range(link)]
        return self.toe + sum(below, np.zeros(2)) + turned(self.q[link], arm)

    def named(self, name: str) -> np.ndarray:
        return self.point(*self.m.points[name])

    def velocity(self, name: str) -> np.ndarray:
        link, arm = self.m.points[name]
        parts = [*(self.m.span[i] for i in range(link)), arm]
        turn = [turned(self.q[i], d) for i, d in enumerate(parts)]
        return self.toe_velocity + sum(w * np.array([r[1], -r[0]]) for w, r in zip(self.v, turn, strict=False))


PARAMETERS = dict(stance=np.zeros(5), distance=0.6, platform=0.2, edge=0.35, takeoff_speed=2.8, rotation=0.0, gravity=G,
                  momentum=-3.0, launch_s=[0.7, 0.1])  # fmt: skip
CONSTANTS = dict(com_x=0.15, com_z=0.7, vel_x=0.9, vel_z=2.7)
SEEDS = range(3)


def ground(x: float) -> float:
    return 0.2 * (1 + np.tanh((x - 0.35) / LIM.edge_smoothing_m)) / 2


def motor(m, tau, rate):
    slope = m.effort / (m.speed - m.corner_speed) * LIM.torque_share
    return [*(tau + slope * rate), *(-tau - slope * rate)]


def common(b: Body, p: Point) -> dict:
    x = {"joint acceleration": [*b.accels, b.a[3]], "torque": b.torques, "joint range": b.joints}
    x |= {"joint speed": b.rates, "joint torque": b.torques, "torque-speed": motor(b.m, b.torques, b.rates)}
    rho, rate = (numbers(getattr(p.ref, k)) for k in ("rho", "rho_rate"))
    x |= {"track inertia": b.rho - rho, "track inertia rate": b.rho_rate - rate}
    places = (b.named(n) for n in ("hand", "mid-arm", "knee"))
    return x | {"body clearance": [z - ground(x + LIM.edge_clearance_m) for x, z in places]}


@pytest.fixture(scope="module")
def body(bhr):
    return whole_body.build_problem(bhr)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["flat", "toe"])
def test_terms_of_the_whole_body_in_launch(bhr, body, name, seed):
    phase = next(p for p in body.phases if p.name == name)
    p = point(phase, np.random.default_rng(seed), PARAMETERS)
    b, mu = Body(bhr, p, False), LIM.friction
    (fx, fz, moment), expected = b.wrench, common(b, p)
    pushed = {"unilateral": fz, "friction": [mu * fz - fx, mu * fz + fx]}
    if name == "flat":
        pushed["CoP in the sole"] = [moment, (-b.m.heel[0] - LIM.cop_margin_m) * fz - moment]
    else:
        pushed["CoP at the toe"] = moment
        expected["heel velocity"] = b.velocity("heel")[1]
    expected |= pushed
    expected |= {"track velocity": b.com_velocity - numbers(p.ref.velocity)}
    expected |= {"track momentum": b.L - numbers(p.ref.L)}
    check(of(body, name, "node"), expected, p)
    middle = {f"{k} (mid)": v for k, v in {**pushed, "joint torque": b.torques}.items()}
    check(of(body, name, "mid"), middle | {"jerk": numbers(p.j)}, p)
    slack = max(LIM.momentum_share * 3.0, LIM.momentum_slack)
    if name == "toe":
        end = {"zero wrench at take-off": b.wrench, "vertical take-off speed": b.com_velocity[1] - 2.8}
        end["L at take-off"] = slack - SIDES * (b.L + 3.0)
        check(of(body, name, "end"), end, p)
    np.testing.assert_allclose(b.base_left, 0.0, atol=1e-8)  # the wrench is all that the base needs


@pytest.mark.parametrize("seed", SEEDS)
def test_terms_of_the_whole_body_in_flight(bhr, body, seed):
    phase = next(p for p in body.phases if p.name == "flight")
    p = point(phase, np.random.default_rng(seed), PARAMETERS, c=CONSTANTS)
    b, m = Body(bhr, p, True), bhr.sagittal
    np.testing.assert_allclose(b.acceleration, [0.0, -G], atol=1e-9)
    # joint torques of an inverse dynamics that holds the CoM's fall, whatever moment the base lacks
    expected = common(b, p) | {"ankle rate": b.rates[2], "angular momentum": b.L_rate}
    for name in ("torque", "joint torque", "torque-speed"):
        expected.pop(name)
    shape, sole = (4 * 0.35 * 0.65) ** 3, [b.point(0, share * m.heel) for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    expected["sole clearance"] = [z - ground(x) - LIM.clearance_m * shape for x, z in sole]
    terms = of(body, "flight", "node")
    torques = {name: terms.pop(name) for name in ("torque", "joint torque", "torque-speed")}
    check(terms, expected, p)
    tau = numbers(torques["torque"].expression(p))
    # without ground the joints' torques turn the links; what they do to each is Newton's and Euler's
    np.testing.assert_allclose(tau, free_torques(b), rtol=1e-8, atol=1e-7)
    np.testing.assert_allclose(numbers(torques["joint torque"].expression(p)), tau)
    np.testing.assert_allclose(numbers(torques["torque-speed"].expression(p)), motor(m, tau, b.rates))
    middle = {"jerk": numbers(p.j), "joint torque (mid)": tau, "angular momentum (mid)": b.L_rate}
    check(of(body, "flight", "mid"), middle, p)
    end = {"touchdown place": b.toe - [0.6, 0.2], "foot flat at touchdown": b.q[0], "knee at touchdown": b.joints[1]}
    end |= {"trunk at touchdown": b.q[3], "joint rates at touchdown": b.rates, "trunk rate at touchdown": b.v[3]}
    ahead = b.point(0, m.sole_center)[0] - b.com[0]
    end |= {"foot rate at touchdown": b.v[0]}
    end |= {"capture window": ahead - LIM.capture_offset_m - LIM.capture_slope_s * 0.9}
    check(of(body, "flight", "end"), end, p)


def free_torques(b: Body) -> np.ndarray:
    """Hip, knee, ankle, shoulder torques from each link's own balance of moments, CoM in free fall [N m]."""
    m, com_rel = b.m, b.relative["acceleration"]
    force, moment, places = np.zeros((5, 2)), np.zeros(5), np.zeros((5, 2))
    lower = np.zeros((5, 2))
    for i in range(5):
        turns = [turned(b.q[j], d) for j, d in enumerate([*m.span[:i], m.com[i]])]
        places[i] = sum(turns)
        lower[i] = sum(turns[:-1], np.zeros(2))
        acc = sum(w1 * np.array([r[1], -r[0]]) - w * w * r for w, w1, r in zip(b.v, b.a, turns, strict=False))
        force[i], moment[i] = m.mass[i] * (acc - com_rel), m.inertia[i] * b.a[i]

    def needed(joint, links):  # moment of the inertial forces of these links about the joint
        arm = places[links] - lower[joint]
        return float(np.sum(moment[links] + arm[:, 1] * force[links, 0] - arm[:, 0] * force[links, 1]))

    return np.array([-needed(3, [3, 4]), -needed(2, [2, 3, 4]), -needed(1, [1, 2, 3, 4]), needed(4, [4])])


def test_terms_that_join_the_whole_body(bhr, body):
    rng, ends = np.random.default_rng(5), {}
    for phase in body.phases:
        c = CONSTANTS if phase.name == "flight" else {}
        pair = (point(phase, rng, PARAMETERS, c=c, s=s, duration=0.3 + rng.random()) for s in (0.0, 1.0))
        ends[phase.name] = SimpleNamespace(start=next(pair), end=next(pair))
    scales, expected = {"q": 1.0, "v": 10.0, "a": 100.0}, {}
    for one, two in (("flat", "toe"), ("toe", "flight")):
        a, b = ends[one].end, ends[two].start
        left = {k: np.pad(numbers(getattr(a, k)), (5 - len(numbers(a.q)), 0)) for k in "qva"}
        expected[f"{one} to {two}"] = [(left[k] - numbers(getattr(b, k))) / scales[k] for k in "qva"]
    b = Body(bhr, ends["toe"].end, False)
    expected["ballistic CoM"] = [*(b.com - [0.15, 0.7]), *(b.com_velocity - [0.9, 2.7])]
    expected["track durations"] = [float(ends[k].end.duration) - x for k, x in (("flat", 0.7), ("toe", 0.1))]
    check(of(body, "whole body", "problem"), expected, ends)


@pytest.mark.parametrize("name", ["flat", "toe", "flight"])
def test_what_a_term_of_the_whole_body_sees(bhr, body, name):
    phase = next(p for p in body.phases if p.name == name)
    p = point(phase, np.random.default_rng(7), PARAMETERS, c=CONSTANTS if name == "flight" else {})
    b = Body(bhr, p, name == "flight")
    torques = free_torques(b) if name == "flight" else b.torques
    for seen, value in (
        (p.joints, b.joints), (p.joint_rates, b.rates), (p.torques, torques), (p.posture, b.q[3]), (p.com, b.com),
        (p.com_velocity, b.com_velocity), (p.L, b.L), (p.inertia, b.rho), (p.inertia_rate, b.rho_rate),
        (p.wrench, b.wrench), (p.point("hand"), b.named("hand")), (p.point_velocity("hand"), b.velocity("hand")),
        (p.joint_rates.knee, b.rates[1]), (p.torques.ankle, torques[2]), (p.time, 0.35 * 0.6),
    ):  # fmt: skip
        np.testing.assert_allclose(numbers(seen), np.ravel(value), rtol=1e-8, atol=1e-7)


# stage 1 --------------------------------------------------------------------------------------------------------
class Rod:
    """The pendulum written out: a rod (theta, phi) from the pivot, and a barbell (theta_pl, varphi) on it."""

    def __init__(self, p: Point, mass: float):
        (th, r, psi, k), (w, u, wp, ku), (al, ur, ap, kur) = (numbers(x) for x in (p.q, p.v, p.a))
        s, c = np.sin(th), np.cos(th)
        self.th, self.r, self.psi, self.u = th, r, psi, u
        self.com = np.array([r * s, r * c])
        self.velocity = np.array([u * s + r * w * c, u * c - r * w * s])
        self.acceleration = np.array([ur * s + 2 * u * w * c + r * al * c - r * w * w * s,
                                      ur * c - 2 * u * w * s - r * al * s - r * w * w * c])  # fmt: skip
        self.rho, self.rho_rate = mass * k * k, 2 * mass * k * ku
        self.rho_accel = 2 * mass * (ku * ku + k * kur)
        self.L, self.L_rate = self.rho * (w + wp), self.rho * (al + ap) + self.rho_rate * (w + wp)
        self.force = mass * (self.acceleration + np.array([0.0, G]))
        self.torque = self.L_rate + self.com[1] * self.force[0] - self.com[0] * self.force[1]
        self.along = float(self.force @ [s, c])


ROD = dict(start=np.zeros(4), distance=0.6, platform=0.2, takeoff_speed=2.8, rotation=0.0, gravity=G)
SPIN = dict(L=-4.0, com_x=0.15, com_z=0.7, vel_x=0.9, vel_z=2.7, leg=0.68)


@pytest.fixture(scope="module")
def rod(bhr):
    return srmp.build_problem(bhr)


def upright(rng):
    return np.array([0.3, 0.6, 0.2, 0.3]) + 0.05 * rng.normal(size=4)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["flat", "toe"])
def test_terms_of_the_rod_in_launch(bhr, rod, name, seed):
    rng, phase, e = np.random.default_rng(seed), next(p for p in rod.phases if p.name == name), reach(bhr)
    p = point(phase, rng, ROD, q=upright(rng))
    x, mu, fit = Rod(p, bhr.total_mass), S.friction, np.polyval
    (fx, fz), low, high = x.force, fit(e.inertia_low_fit, x.r), fit(e.inertia_high_fit, x.r)
    margin, speed, strong = S.inertia_margin * (high - low), fit(e.speed_fit, x.r), fit(e.force_fit, x.r)
    fade = (speed - x.u) / ((1 - S.corner_speed) * speed)
    expected = {"CoM velocity": x.velocity, "L rate": x.L_rate, "turn": x.psi, "trunk range": x.th + x.psi}
    expected |= {"inertia envelope": [x.rho - low - margin, high - margin - x.rho], "L range": x.L, "unilateral": fz}
    expected |= {"friction": [mu * fz - fx, mu * fz + fx], "leg force": [strong - fz, strong * fade - fz]}
    expected |= {"leg speed": S.speed_share * speed - x.u}
    usual = e.usual_flat_fit if name == "flat" else e.usual_toe_fit
    expected |= {"usual inertia": x.rho - fit(usual, x.r)}
    heel, toe = e.cop
    edges = (heel + S.cop_margin_m, toe, 0.0) if name == "flat" else (toe - S.toe_band_m, toe, S.toe_slack_n_m)
    cop = [edges[2] - x.torque - edges[0] * fz, edges[2] + edges[1] * fz + x.torque]
    if name == "flat":
        slope, offset = e.low_com_fit
        below = fit(e.easy_com_fit, x.com[0]) - x.com[1]
        expected["crouch depth"] = (below + np.hypot(below, S.crouch_smoothing_m)) / 2
        expected["CoM not too low"] = x.com[1] - slope * x.com[0] - offset
    check(of(rod, name, "node"), expected | {"CoP": cop}, p)
    check(of(rod, name, "mid"), {"CoP (mid)": cop, "jerk": np.sqrt(S.w_jerk) * numbers(p.j)}, p)
    if name == "flat":
        h, rows = 0.02, []
        q, v, a, j = (numbers(y) for y in (p.q, p.v, p.a, p.j))
        for t in (0.005, 0.01, 0.015):
            th, r = (q + t * v + t * t / 2 * a + t**3 / 6 * j)[:2]
            rows.append(r * np.cos(th) - slope * r * np.sin(th) - offset)
        check(of(rod, name, "interval"), {"CoM not too low (between)": rows}, p, p, ca.SX(h))
    else:
        end = {"posture at take-off": x.th + x.psi, "posture range": x.th + x.psi, "L at take-off": x.L}
        end |= {"take-off speed": x.velocity[1] - 2.8, "rod force zero": x.along, "pivot torque zero": x.torque}
        check(of(rod, name, "end"), end | {"L rate zero": x.L_rate, "take-off length": x.r}, p)


def test_terms_of_the_rod_in_flight(bhr, rod):
    rng, phase = np.random.default_rng(1), next(p for p in rod.phases if p.name == "flight")
    p = point(phase, rng, ROD, q=[4.0], v=[3.0], a=[-20.0], z=[-0.2], c=SPIN, s=1.0)
    check(of(rod, "flight", "node"), {"inertia acceleration": -20.0}, p)
    check(of(rod, "flight", "mid"), {"inertia jerk": numbers(p.j)}, p)
    t, z = 0.6, 0.7 + 2.7 * 0.6 - G * 0.18
    end = {"inertia at touchdown": 4.0 - np.polyval(reach(bhr).usual_toe_fit, 0.68), "inertia rate at touchdown": 3.0}
    end |= {"touchdown height": z - 0.2 - 0.68 * np.cos(-0.2), "falling at touchdown": 2.7 - G * t}
    check(of(rod, "flight", "end"), end | {"lean at touchdown": -0.2}, p)
    right, j, h = point(phase, rng, ROD, z=[0.1], c=SPIN), float(numbers(p.j)[0]), 0.02
    fine = (np.arange(20000) + 0.5) / 20000 * h
    turn = np.mean(-4.0 / (4.0 + 3.0 * fine - 10.0 * fine**2 + j / 6 * fine**3)) * h
    check(of(rod, "flight", "interval"), {"rotation": 0.1 + 0.2 - turn}, p, right, ca.SX(h))


def test_terms_that_join_the_rod(bhr, rod):
    rng, ends = np.random.default_rng(5), {}
    for phase in rod.phases:
        how = dict(c=SPIN) if phase.name == "flight" else dict(q=upright(rng))
        pair = (point(phase, rng, ROD, s=s, duration=0.3 + rng.random(), **how) for s in (0.0, 1.0))
        ends[phase.name] = SimpleNamespace(start=next(pair), end=next(pair))
    (flat, toe), fly, land = (ends["flat"].end, ends["toe"]), ends["flight"].start, ends["flight"].end
    x = Rod(toe.end, bhr.total_mass)
    scales = {"q": 1.0, "v": 5.0, "a": 50.0}
    expected = {"launch time": float(flat.duration) + float(toe.end.duration)}
    joined = [(numbers(getattr(flat, k)) - numbers(getattr(toe.start, k))) / c for k, c in scales.items()]
    q, v, a, z = (float(numbers(y)[0]) for y in (fly.q, fly.v, fly.a, fly.z))
    expected |= {"flat to toe": joined, "lean link": x.th - z, "momentum link": x.L + 4.0}
    expected["inertia link"] = [x.rho - q, (x.rho_rate - v) / 20, (x.rho_accel - a) / 200]
    expected["ballistic CoM"] = [*(x.com - [0.15, 0.7]), *(x.velocity - [0.9, 2.7])]
    angle = float(numbers(land.z)[0])
    ahead = -0.68 * np.sin(angle)
    expected["jump length"] = 0.15 + 0.9 * float(land.duration) + ahead - 0.6
    expected["capture window"] = ahead - S.capture_offset_m - S.capture_slope_s * 0.9
    expected["symmetric landing"] = angle + x.th
    check(of(rod, "SRMP", "problem"), expected, ends)


def test_what_a_term_of_the_rod_sees(bhr, rod):
    rng = np.random.default_rng(3)
    launch, _, flight = rod.phases
    p = point(launch, rng, ROD, q=upright(rng))
    x, f = Rod(p, bhr.total_mass), point(flight, rng, ROD, c=SPIN, z=[0.4], q=[4.0], v=[3.0])
    t = 0.35 * 0.6
    for seen, value in (
        (p.lean, x.th), (p.length, x.r), (p.posture, x.th + x.psi), (p.com, x.com), (p.com_velocity, x.velocity),
        (p.com_acceleration, x.acceleration), (p.L, x.L), (p.L_rate, x.L_rate), (p.inertia, x.rho),
        (p.inertia_rate, x.rho_rate), (p.wrench, [*x.force, x.torque]), (p.time, t), (f.lean, 0.4), (f.L, -4.0),
        (f.inertia, 4.0), (f.inertia_rate, 3.0), (f.wrench, np.zeros(3)), (f.com_velocity, [0.9, 2.7 - G * t]),
        (f.com, [0.15 + 0.9 * t, 0.7 + 2.7 * t - G * t * t / 2]),
    ):  # fmt: skip
        np.testing.assert_allclose(numbers(seen), np.ravel(value), rtol=1e-8, atol=1e-7)


# weights and boxes ----------------------------------------------------------------------------------------------
ROD_WEIGHTS = {
    "posture at take-off": S.w_posture_end,
    "CoM velocity": S.w_velocity,
    "L at take-off": S.w_momentum_end,
    "L rate": S.w_momentum_rate,
    "usual inertia": S.w_usual_inertia,
    "crouch depth": S.w_deep_crouch,
    "turn": S.w_turn,
    "launch time": S.w_time,
    "inertia acceleration": S.w_inertia_accel,
    "inertia jerk": S.w_inertia_jerk,
    "jerk": 1.0,  # its weights stand in the expression
}


def test_every_weight_is_the_setting_of_its_name(body, rod):
    """Those of jerk and inertia are the same in all phases; in flight the inertia rate may have its own."""
    w, same = vars(Weights()) | {"track_durations": Weights().track_duration}, {}
    for owner, t in body.terms():
        if t.is_cost and (t.name == "jerk" or "inertia" in t.name):
            same.setdefault(t.name, {})[owner] = t.weight
        else:
            assert not t.is_cost or t.weight == w[t.name.replace(" ", "_")], (owner, t.name)
    del same["track inertia rate"]["flight"]
    assert len(same) == 3 and all(len(set(of_phases.values())) == 1 for of_phases in same.values())
    for owner, t in rod.terms():
        assert not t.is_cost or t.weight == ROD_WEIGHTS[t.name], (owner, t.name)


def test_boxes_are_rest_stance_and_ranges(bhr, body, rod):
    e, wide, data = reach(bhr), 8.0, {"stance": 0.1 * np.arange(5), "start": 0.2 * np.arange(4)}
    low, high = np.transpose([S.takeoff_lean, e.length, S.turn_rad, S.radius_m])
    margin = S.inertia_margin * (e.inertia[1] - e.inertia[0])
    rest = {("flat", "at rest"): ("v", "start", 0, 0), ("flat", "at rest (acceleration)"): ("a", "start", 0, 0)}
    links = rest | {("flat", "stance"): ("q", "start", data["stance"][1:], data["stance"][1:])}
    links["flight", "link angles"] = "q", "all", -wide, wide
    links["toe", "heel not below ground"] = "q", "inner", [0, *4 * [-wide]], [LIM.heel_up_rad, *4 * [wide]]
    rods = rest | {("flat", "start posture"): ("q", "start", data["start"], data["start"])}
    rods |= {(phase, "state box"): ("q", "inner", low, high) for phase in ("flat", "toe")}
    most = e.inertia[0] + S.flight_inertia * (e.inertia[1] - e.inertia[0])  # nearer than the margin
    rods["flight", "inertia range"] = "q", "all", e.inertia[0] + margin, most
    rods["flight", "inertia rate range"] = "v", "all", -S.inertia_rate, S.inertia_rate
    rods["flight", "inertia acceleration range"] = "a", "all", -S.inertia_accel, S.inertia_accel
    for problem, expected in ((body, links), (rod, rods)):
        found = {(owner, b.name): b for owner, b in problem.bounds()}
        assert set(found) == set(expected)
        for name, (on, where, *ends) in expected.items():
            b = found[name]
            assert (b.on, b.where) == (on, where), name
            for x, end in zip((b.lower, b.upper), ends, strict=True):
                np.testing.assert_allclose(x(data) if callable(x) else x, end, err_msg=str(name))
