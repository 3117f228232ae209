"""Each term's expression at a random state: the whole-body program's against Pinocchio, stage 1's against formulas.

Every term of both is looked at, in the plane and in space, its weight and all boxes too, and so is all that an own term
sees by name.
"""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import LIMBS
from test_terms_table import program

from jumplab.ocp import Problem, Term
from jumplab.ocp.problem import Phase, Point
from jumplab.robot.reach import reach
from jumplab.stages import srmp
from jumplab.stages.srmp import SrmpSettings
from jumplab.stages.whole_body import Contacts, Limits, Weights, coordinates
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import SIDES, jump_contacts
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.settings import LATE_SHARE, RESERVE_SHARE, Mesh

G, LIM, S = 9.8, Limits(), SrmpSettings()
BOTH = np.array([1.0, -1.0])


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
        np.testing.assert_allclose(found, flat(value), rtol=1e-8, atol=1e-7, err_msg=name)


def flat(x) -> np.ndarray:
    """Numbers and arrays in lists, in a row."""
    return np.concatenate([flat(y) for y in x]) if isinstance(x, list | tuple) else np.ravel(x)


def of(problem: Problem, phase: str, *places: str) -> dict[str, Term]:
    return {t.name: t for owner, t in problem.terms() if owner == phase and t.at in places}


# the whole-body program -----------------------------------------------------------------------------------------
PLANE = dict(distance=0.6, side=0.0, yaw=0.0, platform=0.2, edge=0.35, along=[1.0, 0.0], takeoff_speed=2.8,
             rotation=0.0, gravity=G, straight=1.0, momentum=-3.0, launch_s=[0.7, 0.1])  # fmt: skip
SPACE = PLANE | dict(side=0.2, yaw=0.4, along=[0.8, 0.6], rotation=0.1)
SEEDS = range(3)
# program and phase -> side of each foot that carries there, and how; of a jump in the plane and in space, and of a hop
LAUNCH = {"flat": {0: "flat", 1: "flat"}, "toe": {0: "toe", 1: "toe"}}
MODES = {(name, phase): modes for name in ("whole body", "spatial") for phase, modes in LAUNCH.items()}
MODES |= {("hop", "2 L"): {0: "flat"}, ("hop", "3 l"): {0: "toe"}}
EDGES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])  # of a friction pyramid


@pytest.fixture(scope="module")
def body(bhr):
    return Body(bhr)


@pytest.fixture(scope="module")
def programs(body):
    out = {name: program(body, name) for name in ("direct", "whole body", "spatial")}
    return out | {"hop": program(body, "spatial", Contacts.hop(body.robot))}


def turn_about_z(yaw: float) -> np.ndarray:
    return pin.rpy.rpyToMatrix(0.0, 0.0, float(yaw))


def random_point(problem: Problem, name: str, seed: int, parameters: dict, **how) -> tuple[Phase, Point]:
    """A phase of the program, and a point of it: random motion, forces that push, random footholds and constants."""
    rng = np.random.default_rng(seed)
    phase = next(p for p in problem.phases if p.name == name)
    push = [name.startswith("force") for name in phase.states]
    z = np.where(push, rng.uniform(0, 150, len(push)), 40 * rng.normal(size=len(push)))
    constants = {k: 0.4 * rng.normal() for k in phase.constants}
    return phase, point(phase, rng, parameters, **({"z": z, "c": constants} | how))


class Seen:
    """The full robot in the state of a point of the whole-body program, through Pinocchio alone."""

    def __init__(self, body: Body, phase: Phase, p: Point, modes: dict[int, str]):
        self.body = body
        self.robot = body.robot
        self.tree = body.robot.model
        self.p = p
        self.plane = "y" not in phase.coordinates
        self.names = self.robot.joint_names
        self.modes = modes
        self.sides = [k for k in modes if not self.plane or k == 0]
        self.par = {k: np.squeeze(numbers(v)) for k, v in vars(p.p).items()}
        self.c = {k: float(v) for k, v in vars(p.c).items()}
        self.ref = {k: numbers(v) for k, v in vars(p.ref).items()}
        x = [numbers(getattr(p, k)) for k in "qva"]
        self.chart, self.rates, self.accels = (self.full(y) for y in x)
        n = 7 if self.plane else len(self.chart)
        raised = [k for k in self.sides if self.modes[k] == "toe"]
        self.pitch = {k: [y[n + raised.index(k)] if k in raised else 0.0 for y in x] for k in self.sides}
        self.jerks = numbers(p.j)
        self.z = numbers(p.z)
        self._move()
        self._forces()

    def full(self, x: np.ndarray) -> np.ndarray:
        """All coordinates (20,) from those of the phase: in the plane the right side moves as the left one."""
        if not self.plane:
            return x[: 6 + len(self.names)]
        out = np.zeros(6 + len(self.names))
        out[[0, 2, 5]] = x[:3]
        for i, role in enumerate(LIMBS):
            for name, sign in zip(self.robot.joints[role], self.robot.sagittal.signs[i], strict=True):
                out[6 + self.names.index(name)] = x[3 + i] * sign * self.robot.sagittal.signs[i, 0]
        return out

    def _move(self) -> None:
        tree = self.tree
        motion = (x[None] for x in (self.chart, self.rates, self.accels))
        self.q, self.v, self.a = (x[0] for x in self.body.model.to_pinocchio(*motion))
        self.data = data = tree.createData()
        pin.ccrba(tree, data, self.q, self.v)
        self.rho = float(data.Ig.inertia[1, 1])
        self.momentum = data.hg.angular.copy()
        self.com = data.com[0].copy()
        self.com_velocity = data.hg.linear / self.robot.total_mass
        other = tree.createData()
        h = 1e-5
        around = []
        for step in (-h, h):
            pin.ccrba(tree, other, pin.integrate(tree, self.q, step * self.v), self.v)
            around.append(float(other.Ig.inertia[1, 1]))
        self.rho_rate = (around[1] - around[0]) / (2 * h)
        pin.computeJointJacobians(tree, data, self.q)
        pin.forwardKinematics(tree, data, self.q, self.v, self.a)
        pin.updateFramePlacements(tree, data)
        self.frames = [tree.getFrameId(name) for name in self.robot.foot.frames]
        self.base = data.oMi[1]

    def foot(self, side: int) -> pin.SE3:
        return self.data.oMf[self.frames[side]]

    def tip(self, side: int) -> np.ndarray:
        return self.foot(side).act(self.robot.foot.tip)

    def middle(self, side: int) -> np.ndarray:
        return self.foot(side).act(self.robot.foot.center)

    def rates_of(self, side: int, local) -> tuple[np.ndarray, np.ndarray]:
        """Velocity of a point of the foot, and angular velocity, in the foot's axes."""
        rate = pin.getFrameVelocity(self.tree, self.data, self.frames[side], pin.ReferenceFrame.LOCAL)
        return rate.linear + np.cross(rate.angular, local), rate.angular

    def gains_of(self, side: int, local) -> tuple[np.ndarray, np.ndarray]:
        """Acceleration of a point of the foot, and angular acceleration, in the foot's axes."""
        axes = pin.ReferenceFrame.LOCAL
        frame = self.frames[side]
        gain, spin = (f(self.tree, self.data, frame, axes) for f in (pin.getFrameClassicalAcceleration,
                                                                      pin.getFrameVelocity))  # fmt: skip
        w = spin.angular
        b = gain.angular
        return gain.linear + np.cross(b, local) + np.cross(w, np.cross(w, local)), b

    def _forces(self) -> None:
        """Forces at the soles from the edges of the friction pyramids, and what inverse dynamics has left over."""
        foot = self.robot.foot
        width = self.robot.foot.half_width - LIM.side_margin_m
        edges = EDGES[:2] if self.plane else EDGES
        z = iter(self.z)
        self.pushed = {}
        self.local = {}
        wrench = {}
        for side in self.sides:
            back = (0.0, -(foot.toe - foot.heel - LIM.cop_margin_m)) if self.modes[side] == "flat" else (0.0,)
            across = (0.0,) if self.plane else (width, -width)
            self.local[side] = [np.array([x, y, 0.0]) for x in back for y in across]
            self.pushed[side] = []
            total = np.zeros(3)
            about = np.zeros(3)  # of a standing foot: in the axes of its foothold, about its tip
            for _ in self.local[side]:
                along = np.array([next(z) for _ in edges])
                self.pushed[side].append(np.append(LIM.friction * along @ edges, along.sum()))
            turn = self.foot(side).rotation @ pin.rpy.rpyToMatrix(0.0, self.pitch[side][0], 0.0).T
            for place, force in zip(self.local[side], self.pushed[side], strict=True):
                total += turn @ force
                about += np.cross(self.foot(side).rotation @ place, turn @ force)
            wrench[side] = total, about
        if self.plane and self.sides:
            wrench[1] = wrench[0]  # all in the plane, so its mirror image too
        self.tau = np.array(list(z))
        model = self.tree.copy()
        model.gravity.linear = np.array([0.0, 0.0, -G])
        left = pin.rnea(model, model.createData(), self.q, self.v, self.a)
        for side, (force, moment) in wrench.items():
            moment = moment + np.cross(self.tip(side) - self.foot(side).translation, force)
            slope = pin.getFrameJacobian(self.tree, self.data, self.frames[side], pin.LOCAL_WORLD_ALIGNED)
            left = left - slope.T @ np.concatenate([force, moment])
        self.wrench = wrench
        self.base_force = self.base.rotation @ left[:3]
        self.base_moment = self.base.rotation @ left[3:6]
        self.needed = left[6:]

    # what is the same in all phases -----------------------------------------------------------------------------
    @property
    def joints(self) -> list[int]:
        """Joints that are free."""
        if not self.plane:
            return list(range(len(self.names)))
        return [self.names.index(self.robot.joints[role][0]) for role in LIMBS]

    @property
    def moving(self) -> list[int]:
        """Joints that move, those of the right side included."""
        if not self.plane:
            return self.joints
        return sorted(self.names.index(name) for role in LIMBS for name in self.robot.joints[role])

    def motor(self, key: str) -> np.ndarray:
        return np.array([self.robot.actuators[self.names[k]][key] for k in self.joints])

    def sagittal(self, x: np.ndarray) -> np.ndarray:
        """Hip, knee, ankle, shoulder of the left side in sagittal signs, from angles or rates (20,)."""
        left = [self.names.index(self.robot.joints[role][0]) for role in LIMBS]
        return self.robot.sagittal.signs[:, 0] * x[[6 + k for k in left]]

    def ground(self, x: np.ndarray, nearer: float = 0.0) -> float:
        beyond = self.par["along"] @ x[:2] - self.par["edge"] + nearer * np.sign(self.par["platform"])
        return self.par["platform"] * (1 + np.tanh(beyond / LIM.edge_smoothing_m)) / 2

    def joint(self, name: str) -> pin.SE3:
        return self.data.oMi[self.tree.getJointId(name)]

    def hand(self, side: int) -> np.ndarray:
        x, z = self.robot.sagittal.points["hand"][1]
        return self.joint(self.robot.joints["shoulder_pitch"][side]).act(np.array([x, 0.0, z]))

    @property
    def both(self) -> list[int]:
        return [0] if self.plane else [0, 1]

    @property
    def attitude(self) -> list[int]:
        """Coordinates of the base that turn it."""
        return [5] if self.plane else [3, 4, 5]

    @property
    def moved(self) -> list[int]:
        """Coordinates that turn the base and all joints."""
        return self.attitude + [6 + k for k in self.moving]

    def common(self) -> dict:
        """Terms at the nodes of every phase."""
        free = [6 + k for k in self.joints]
        tau = np.zeros(len(self.names))
        for k, torque in zip(self.joints, self.tau, strict=True):
            tau[k] = torque
        if self.plane:
            tau = self.full(np.concatenate([np.zeros(3), self.tau]))[6:]
        effort = self.motor("effort")
        slope = LIM.torque_share * self.motor("effort")
        slope = slope / (self.motor("no_load_speed") - self.motor("corner_speed"))
        x = {"acceleration": self.accels[self.moved], "torque": tau}
        x["joint dynamics"] = (self.needed[self.joints] - self.tau) / effort
        x["base forces"] = self.base_force[[0, 2] if self.plane else [0, 1, 2]]
        x["base moments"] = self.base_moment[[1] if self.plane else [0, 1, 2]]
        x["torque-speed"] = (self.tau + slope * self.rates[free]) / effort
        places = [self.joint(self.robot.joints["knee"][k]).translation for k in self.both]
        places += [self.hand(k) for k in self.both]
        face = self.body.shank_m + LIM.shank_clearance_m
        over = float(self.par["platform"]) + face  # it is above the ground here
        steps = [self.ground(y, face) / self.par["platform"] for y in self.shanks()]
        heights = [y[2] - over * step for y, step in zip(self.shanks(), steps, strict=True)]
        x["body clearance"] = [*(y[2] - self.ground(y, LIM.edge_clearance_m) for y in places), *heights]
        if not self.plane:
            x["sides apart"] = self.apart()
        for side in self.sides:
            x |= self.standing(side)
        for side in self.both:
            if side not in self.modes:
                x[f"clearance of {('left', 'right')[side]} sole"] = self.swinging(side)
        if self.sides:
            x["force"] = self.z[: len(self.z) - len(self.tau)]
        return x

    def apart(self) -> list[float]:
        """Distances across of knees, ankles, toes and heels, and of the hands from the middle, seen from the trunk."""
        heel = np.array([self.robot.foot.heel, 0.0, self.robot.foot.sole_z])
        pairs = [[self.joint(name).translation for name in self.robot.joints["knee"]]]
        pairs.append([self.data.oMi[self.body.feet[k] + 1].translation for k in (0, 1)])
        pairs += [[self.foot(k).act(x) for k in (0, 1)] for x in (self.robot.foot.tip, heel)]
        rows = [self.base.actInv(left)[1] - self.base.actInv(right)[1] for left, right in pairs]
        return [*rows, *(sign * self.base.actInv(self.hand(k))[1] for k, sign in enumerate((1, -1)))]

    def pressed(self, share: float) -> dict:
        """CoP of flat feet, how far off both ends of the sole it stays, at a share of the phase."""
        foot = self.robot.foot
        reserve = 0.125 * (foot.toe - foot.heel)
        reserve *= np.clip(min(share / RESERVE_SHARE[0], (1 - share) / RESERVE_SHARE[1]), 0, 1)
        length = foot.toe - foot.heel - LIM.cop_margin_m
        rows = []
        for side in self.sides:
            load = sum(f[2] for f in self.pushed[side]) / self.body.mg
            pushes = zip(self.local[side], self.pushed[side], strict=True)
            behind = sum(-at[0] * f[2] for at, f in pushes) / self.body.mg
            rows += [behind - reserve * load, (length - reserve) * load - behind]
        return {"CoP reserve": rows}

    def shanks(self) -> list[np.ndarray]:
        """Five places along the middle of each shank's box, from its far end up."""
        out = []
        for side in self.both:
            name = self.robot.joints["knee"][side]
            (box,) = [s for s in self.body.shapes if s.body == 1 + self.names.index(name)]
            way = box.axes[:, np.argmax(box.half)] * box.half.max()
            frame = self.joint(name)
            own = self.body.model.bodies[box.body].own
            out += [frame.act(own @ (box.centre + share * way)) for share in (-0.8, -0.4, 0.0, 0.4, 0.8)]
        return out

    def standing(self, side: int) -> dict:
        """Rows of a foot that carries: its place, heading, roll and pitch, on all three levels."""
        name = ("left", "right")[side]
        axes = self.foot(side).rotation
        tip = self.robot.foot.tip
        at = np.array([self.c[f"{name}_{k}"] for k in "xyz"])
        yaw = self.c[f"{name}_yaw"]
        phi, rate, gain = self.pitch[side]
        ahead = turn_about_z(yaw).T @ axes[:, 0]
        place = [*(self.tip(side) - at), ahead[1], axes[2, 1], axes[2, 0] + np.sin(phi)]
        levels = [place]
        for (linear, angular), tipping in ((self.rates_of(side, tip), rate), (self.gains_of(side, tip), gain)):
            levels.append([*linear, angular[2], angular[0], angular[1] - tipping])
        rows = [0, 2, 5] if self.plane else list(range(6))
        words = "in place", "still", "held"
        return {f"{name} foot {k}": np.array(x)[rows] for k, x in zip(words, levels, strict=True)}

    def swinging(self, side: int) -> list[float]:
        """Height of a sole in the air above the wanted one, and of its ankle above its place."""
        foot = self.robot.foot
        if self.plane:
            length = foot.toe - foot.heel
            local = [[foot.toe - share * length, 0.0, foot.sole_z] for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
        else:
            local = [[x, y, foot.sole_z] for x in (foot.toe, foot.heel) for y in (foot.half_width, -foot.half_width)]
        asked = self.ref[f"{('left', 'right')[side]}_clearance"][0]
        places = [self.foot(side).act(np.array(x)) for x in local]
        ankle = self.data.oMi[self.body.feet[side] + 1].translation
        least = LIM.ankle_margin_m - foot.sole_z  # the ankle of a flat sole is that high
        return [*(x[2] - self.ground(x) - asked for x in places), ankle[2] - self.ground(ankle) - least]

    def constant(self, kind: str) -> np.ndarray:
        """A vector among the flight's constants."""
        return np.array([self.c.get(f"{kind}_{x}", 0.0) for x in "xyz"])

    @property
    def places(self) -> list[int]:
        return [0, 2] if self.plane else [0, 1, 2]

    @property
    def spins(self) -> list[int]:
        return [1] if self.plane else [0, 1, 2]

    def flying(self) -> dict:
        """Rows of a flight at its nodes."""
        t = float(numbers(self.p.time)[0])
        com = self.constant("com") + t * self.constant("vel") - [0.0, 0.0, G * t * t / 2]
        speed = self.constant("vel") - [0.0, 0.0, G * t]
        rows = {"ballistic CoM": (self.com - com)[self.places]}
        rows["ballistic CoM velocity"] = (self.com_velocity - speed)[self.places]
        return rows | {"angular momentum": (self.momentum - self.constant("L"))[self.spins]}

    def touchdown(self) -> dict:
        """Rows at the end of a jump."""
        yaw = self.par["yaw"]
        turn = turn_about_z(self.par["yaw"])
        way = np.array([self.par["distance"], self.par["side"], self.par["platform"]])
        feet = []
        spins = []
        sticking = []
        for side in self.both:
            first = self.body.places[side] - [(self.robot.foot.toe - self.robot.foot.heel) / 2, 0.0, 0.0]
            axes = self.foot(side).rotation
            off = turn.T @ (self.middle(side) - way) - first
            row = np.array([*off, turn[:, 0] @ axes[:, 1], axes[2, 1], axes[2, 0]])
            feet.append(row[[0, 2, 5]] if self.plane else row)
            linear, angular = self.rates_of(side, self.robot.foot.center)
            speed = axes @ linear
            spins.append((axes @ angular)[self.spins])
            sticking.append(EDGES @ speed[:2] - LIM.touchdown_slope * speed[2])
        asked = np.array([0.0, 0.0, 0.0, yaw, 0.0, self.par["rotation"]])
        knees = [self.robot.joints["knee"][k] for k in self.both]
        rows = {"touchdown of the feet": feet, "foot rates at touchdown": spins}
        if not self.plane:
            rows["soles that stick at touchdown"] = sticking
        rows["attitude at touchdown"] = (self.chart[:6] - asked)[self.attitude]
        rows["knees at touchdown"] = [self.chart[6 + self.names.index(name)] for name in knees]
        rows["joint rates at touchdown"] = self.rates[[6 + k for k in self.joints]]
        return rows | {"trunk rates at touchdown": self.rates[self.attitude], "capture window": self.caught()}

    def caught(self) -> np.ndarray:
        ahead = turn_about_z(self.par["yaw"]) @ [LIM.capture_offset_m, 0.0, 0.0]
        middle = np.mean([self.middle(side) for side in self.both], axis=0)
        off = middle - self.com - ahead - LIM.capture_slope_s * self.constant("vel")
        return off[[0] if self.plane else [0, 1]]

    def tracking(self) -> dict:
        """Differences of the motion from stage 1's."""
        rows = {"track inertia": self.rho - self.ref["rho"], "track inertia rate": self.rho_rate - self.ref["rho_rate"]}
        if not self.modes:
            return rows | {"ankle rate": self.sagittal(self.rates)[2]}
        rows["track velocity"] = self.com_velocity[[0, 2]] - self.ref["velocity"]
        rows["track momentum"] = self.momentum[1] - self.ref["L"]
        if self.modes[0] == "toe":
            heel = np.array([self.robot.foot.heel, 0.0, self.robot.foot.sole_z])
            rows["heel velocity"] = (self.foot(0).rotation @ self.rates_of(0, heel)[0])[2]
        return rows


def looked_at(programs, body, place, seed):
    """Phase, point, and what is expected there, of a program's phase on the ground."""
    name, phase = place
    phase, p = random_point(programs[name], phase, seed, PLANE if name == "whole body" else SPACE)
    return phase, p, Seen(body, phase, p, MODES[place])


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("place", MODES, ids=str)
def test_terms_of_the_whole_body_on_the_ground(programs, body, place, seed):
    phase, p, x = looked_at(programs, body, place, seed)
    problem = programs[place[0]]
    expected = x.common()
    if place[0] == "whole body":
        expected |= x.tracking()
    elif place[1] == "flat":
        expected["load of each foot"] = [sum(f[2] for f in x.pushed[side]) for side in x.sides]
    if place[1] == "flat":
        expected |= x.pressed(0.35)
    mg = body.mg
    for side in () if place[0] == "whole body" else x.sides:
        pushes = list(zip(x.local[side], x.pushed[side], strict=True))
        total = sum(f for _, f in pushes) / mg
        about = sum(np.cross(at, f) for at, f in pushes) / mg
        arm = LIM.friction * LIM.torsion_arm_m * total[2] ** 2
        expected[f"spin of {SIDES[side]} foot"] = arm - BOTH * (total @ about)
    check(of(problem, phase.name, "node"), expected, p)
    check(of(problem, phase.name, "mid"), {"jerk": x.full(x.jerks)[x.moved]}, p)
    end = {}
    if place == ("whole body", "toe"):
        slack = max(LIM.momentum_share * 3.0, LIM.momentum_slack)
        end["L at take-off"] = slack - BOTH * (x.momentum[1] + 3.0)
    check(of(problem, phase.name, "start", "end", "interval"), end, p)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["whole body", "spatial"])
def test_terms_of_the_whole_body_in_flight(programs, body, name, seed):
    problem = programs[name]
    phase, p = random_point(problem, "flight", seed, PLANE if name == "whole body" else SPACE)
    x = Seen(body, phase, p, {})
    expected = x.common() | x.flying()
    if name == "whole body":
        expected |= x.tracking()
    check(of(problem, "flight", "node"), expected, p)
    check(of(problem, "flight", "mid"), {"jerk": x.full(x.jerks)[x.moved]}, p)
    check(of(problem, "flight", "end"), x.touchdown(), p)
    missing = x.constant("vel")[-1] - x.par["takeoff_speed"]
    check(of(problem, "flight", "start"), {"vertical take-off speed": missing}, p)
    # angles of the base from node to node: cubic accelerations, so that rates need no rows
    h = 0.02
    at = [2] if x.plane else [3, 4, 5]
    _, right = random_point(problem, "flight", seed + 10, PLANE)
    (q0, v0, a0), (q1, v1, a1) = ([numbers(getattr(y, k))[at] for k in "qva"] for y in (p, right))
    turned_by = q1 - q0 - h * (v0 + v1) / 2 - h * h * (a0 - a1) / 12
    check(of(problem, "flight", "interval"), {"base turns": turned_by}, p, right, ca.SX(h))


def test_the_direct_program_is_the_tracking_one_without_what_follows_stage_1(programs, body):
    """Term by term the same values; so what is said of the one holds for the other."""
    for name in ("flat", "toe", "flight"):
        more = {t.name: t for t in next(p for p in programs["whole body"].phases if p.name == name).terms}
        phase, p = random_point(programs["direct"], name, 0, PLANE)
        assert {t.name for t in phase.terms} < set(more)
        for t in phase.terms:
            if t.at not in ("interval", "problem"):
                other = more[t.name]
                assert numbers(t.expression(p)) == pytest.approx(numbers(other.expression(p)), abs=1e-12), t.name
                assert (t.weight, t.at, t.skip, t.scale) == (other.weight, other.at, other.skip, other.scale)


def test_terms_that_join_the_whole_body(programs):
    rng, ends = np.random.default_rng(5), {}
    for phase in programs["whole body"].phases:
        c = dict.fromkeys(phase.constants, 0.1)
        pair = (point(phase, rng, PLANE, c=c, s=s, duration=0.3 + rng.random()) for s in (0.0, 1.0))
        ends[phase.name] = SimpleNamespace(start=next(pair), end=next(pair))
    expected = {"track durations": [float(ends[k].end.duration) - x for k, x in (("flat", 0.7), ("toe", 0.1))]}
    check(of(programs["whole body"], "whole body", "problem"), expected, ends)
    assert not programs["direct"].joints and not programs["spatial"].joints


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("name", ["whole body", "spatial"])
@pytest.mark.parametrize("share", [0.05, 0.35, 0.94])
def test_launches_keep_their_pressure_off_both_ends_of_the_sole(body, name, share, flip):
    """In the middle of the phase by an eighth of the sole, at its ends by less; of each foot by its own load."""
    problem = program(body, name, flip=flip)
    phase, p = random_point(problem, "flat", 4, PLANE, s=share)
    x = Seen(body, phase, p, LAUNCH["flat"])
    found = of(problem, "flat", "node")
    check({"CoP reserve": found["CoP reserve"]}, x.pressed(share), p)
    if not flip:
        return
    loads = [sum(f[2] for f in x.pushed[side]) for side in x.sides]
    check({"load of each foot": found["load of each foot"]}, {"load of each foot": loads}, p)
    least = Limits().of_flip().least_push / 2 if name == "whole body" else LIM.foot_share
    assert found["load of each foot"].lower == pytest.approx(least * body.mg)


@pytest.mark.parametrize("turns", [1, -1])
def test_flips_are_caught_by_their_momentum(body, turns):
    """By L about the middle of the sole, within bounds that depend on the direction."""
    limits = Limits().of_flip()
    problem = program(body, "whole body", flip=True)
    given = PLANE | {"rotation": turns * 2 * np.pi}
    q = np.array([0.6, 1.0, 2 * np.pi * turns, -1.0, 1.2, -0.3, 0.2])
    phase, p = random_point(problem, "flight", 2, given, q=q)
    x = Seen(body, phase, p, {})
    t = float(numbers(p.time)[0])
    speed = x.constant("vel") - [0.0, 0.0, G * t]
    mass = body.robot.total_mass

    def about(place):
        return x.c["L_y"] + mass * np.cross(x.com - place, speed)[1]

    length = body.leg_m  # of the legs in the stance
    unit = mass * length * np.sqrt(G * length)
    end = of(problem, "flight", "end")
    check({"capture by momentum": end["capture by momentum"]}, {"capture by momentum": about(x.middle(0))}, p)
    asked = limits.capture_in_plane[2:] if turns > 0 else limits.capture_in_plane[:2]
    bounds = [x(given) for x in (end["capture by momentum"].lower, end["capture by momentum"].upper)]
    assert bounds == pytest.approx(unit * np.array(asked))
    stroke = {"ankles at touchdown": x.sagittal(x.chart)[2]}
    check({name: end[name] for name in stroke}, stroke, p)
    least = body.robot.sagittal.lower[2] + limits.touchdown_ankle_stroke
    assert end["ankles at touchdown"].lower == pytest.approx(least)


def test_flips_in_space_are_caught_by_their_momentum(body):
    """About both axes along the ground through the middle between the soles."""
    limits = Limits().of_flip()
    problem = program(body, "spatial", flip=True)
    phase, p = random_point(problem, "flight", 3, SPACE)
    x = Seen(body, phase, p, {})
    t = float(numbers(p.time)[0])
    arm = x.com - np.mean([x.middle(side) for side in (0, 1)], axis=0)
    speed = x.constant("vel") - [0.0, 0.0, G * t]
    expected = {"capture by momentum": (x.constant("L") + body.robot.total_mass * np.cross(arm, speed))[:2]}
    term = of(problem, "flight", "end")["capture by momentum"]
    check({"capture by momentum": term}, expected, p)
    unit = body.robot.total_mass * body.leg_m * np.sqrt(G * body.leg_m)
    assert (term.lower, term.upper) == pytest.approx((-limits.capture_moment * unit, limits.capture_moment * unit))


@pytest.mark.parametrize("share, begun", [(0.45, 0.0), (1 - LATE_SHARE + 0.025, 0.5), (0.9, 1.0)])
def test_a_tuck_opens_slowly_if_asked(body, share, begun):
    limits = Limits(opening_speed_share=0.5, opening_torque_share=0.3)
    problem = Schedule(body, jump_contacts(limits, Mesh()), limits, Weights(), free=coordinates.even(body)).problem()
    phase, p = random_point(problem, "flight", 1, PLANE, s=share)
    speed, torque = (of(problem, "flight", "node")[f"opening {x}"] for x in ("speed", "torque"))
    x = Seen(body, phase, p, {})
    torques = begun * x.tau / x.motor("effort")
    found = {"opening speed": begun * x.rates[[6 + k for k in x.joints]], "opening torque": torques}
    check({"opening speed": speed, "opening torque": torque}, found, p)
    assert speed.upper == pytest.approx(0.5 * x.motor("speed")) and speed.lower == pytest.approx(-speed.upper)
    assert (torque.lower, torque.upper) == (-0.3, 0.3)


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
    expected = {"launch time": float(flat.duration) + float(toe.end.duration)}
    q, v, a, z = (float(numbers(y)[0]) for y in (fly.q, fly.v, fly.a, fly.z))
    expected |= {"lean link": x.th - z, "momentum link": x.L + 4.0}
    expected["inertia link"] = [x.rho - q, (x.rho_rate - v) / 20, (x.rho_accel - a) / 200]
    expected["ballistic CoM"] = [*(x.com - [0.15, 0.7]), *(x.velocity - [0.9, 2.7])]
    angle = float(numbers(land.z)[0])
    ahead = -0.68 * np.sin(angle)
    expected["jump length"] = 0.15 + 0.9 * float(land.duration) + ahead - 0.6
    expected["capture window"] = ahead - S.capture_offset_m - S.capture_slope_s * 0.9
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


def test_every_weight_is_the_setting_of_its_name(body, programs, rod):
    """The same in all phases; inertias and L are shares of the stance's inertia, whose rate has its own in flight."""
    w = {name: x for name, x in vars(Weights()).items() if not name.startswith("follow_")}
    model = body.robot.model
    w = w | {"track_durations": w["track_duration"]}
    q = body.model.to_pinocchio(body.stance[None], *np.zeros((2, 1, 20)))[0][0]
    data = model.createData()
    pin.ccrba(model, data, q, np.zeros(model.nv))
    stood = data.Ig.inertia[1, 1]
    for name in ("direct", "whole body", "spatial"):
        costs = [(owner, t) for owner, t in programs[name].terms() if t.is_cost]
        for owner, t in costs:
            key = "track_flight_inertia_rate" if (owner, t.name) == ("flight", "track inertia rate") else None
            share = {"inertia", "momentum"} & set(t.name.split())
            want = w[key or t.name.replace(" ", "_")] / (stood**2 if share else 1.0)
            assert t.weight == pytest.approx(want, rel=1e-9), (owner, t.name)
    # of uneven motions, robots with a waist, flights, and the whole problem
    others = {"mirror", "posture", "track_flight_inertia_rate", "track_duration"}
    assert set(w) == others | {t.name.replace(" ", "_") for _, t in programs["whole body"].terms() if t.is_cost}
    for owner, t in rod.terms():
        assert not t.is_cost or t.weight == ROD_WEIGHTS[t.name], (owner, t.name)


def same_boxes(problem, expected, data):
    """Every bound of a problem as it is expected: (phase, name) -> on, where, lower, upper."""
    found = {(owner, b.name): b for owner, b in problem.bounds()}
    assert set(found) == set(expected)
    for name, (on, where, *ends) in expected.items():
        b = found[name]
        assert (b.on, b.where) == (on, where), name
        for x, end in zip((b.lower, b.upper), ends, strict=True):
            np.testing.assert_allclose(x(data) if callable(x) else x, end, err_msg=str(name))


@pytest.mark.parametrize("name", ["direct", "whole body", "spatial"])
def test_boxes_of_the_whole_body_are_rest_stance_and_limits(bhr, body, programs, name):
    """Joints, speeds and torques within shares of their limits, forces that push, heels that rise from rest."""
    plane = name != "spatial"
    inf = np.inf
    joints = bhr.joint_names if not plane else [bhr.joints[role][0] for role in LIMBS]
    low, high, speed, effort = (
        np.array([bhr.actuators[joint][key] for joint in joints]) for key in ("lower", "upper", "speed", "effort")
    )
    knees = np.array(["knee" in joint for joint in joints])
    base = np.full(3 if plane else 6, 15.0)
    if not plane:
        base[4] = LIM.roll_rad
    low = low + LIM.range_margin_rad
    high = high - LIM.range_margin_rad
    high = high if plane else np.where(knees, np.minimum(high, LIM.knee_rad), high)
    data = {"stance": 0.1 * np.arange(len(base) + len(joints))}
    edges, feet = (2, 1) if plane else (8, 2)  # edges of the pyramids at the toes of one foot, or at its heel
    expected = {("flat", "stance"): ("q", "start", data["stance"], data["stance"])}
    expected |= {("flat", "at rest"): ("v", "start", 0, 0), ("flat", "at rest (acceleration)"): ("a", "start", 0, 0)}
    for phase, heels, pushes in (("flat", 0, 2 * edges * feet), ("toe", feet, edges * feet), ("flight", 0, 0)):
        least = low if phase == "flight" else np.where(knees, np.maximum(low, LIM.straight_knee_rad), low)
        up = np.zeros(heels)
        free = np.full(heels, inf)
        expected[phase, "joint range"] = (
            "q", "all", [*-base, *least, *up], [*base, *high, *np.full(heels, LIM.heel_up_rad)])  # fmt: skip
        rates = np.array([*np.full(len(base), 60.0), *LIM.speed_share * speed, *free])
        expected[phase, "joint speed"] = "v", "all", -rates, rates
        torques = LIM.torque_share * effort
        push = np.zeros(pushes)
        expected[phase, "forces and torques"] = "z", "all", [*push, *-torques], [*(push + inf), *torques]
    rising = np.array([*np.full(len(base) + len(joints), inf), *np.zeros(feet)])
    for on in "qva":
        expected["toe", f"heels rise from rest ({on})"] = on, "start", -rising, rising
    none = {"flat": [*([inf] * edges + [0.0] * edges) * feet], "toe": [0.0] * edges * feet}
    for phase, forces in none.items():
        most = np.array([*forces, *np.full(len(joints), inf)])
        expected[phase, "no force where contact ends"] = "z", "end", -most, most
    same_boxes(programs[name], expected, data)


def test_footholds_of_the_whole_body_are_those_of_the_stance(body, programs):
    """In a standing jump, for which the places of the toe edges are constants that cannot move."""
    for name, sides in (("direct", ["left"]), ("spatial", ["left", "right"])):
        for phase in programs[name].phases[:2]:
            wanted = {}
            for k, side in enumerate(sides):
                names = [f"{side}_{x}" for x in ("x", "y", "z", "yaw")]
                wanted |= dict(zip(names, [*body.places[k], 0.0], strict=True))
            for end in (0, 1):
                assert {x: box[end] for x, box in phase.constants.items()} == pytest.approx(wanted)


def test_boxes_of_the_rod_are_rest_start_and_ranges(bhr, rod):
    e = reach(bhr)
    data = {"start": 0.2 * np.arange(4)}
    low, high = np.transpose([S.takeoff_lean, e.length, S.turn_rad, S.radius_m])
    margin = S.inertia_margin * (e.inertia[1] - e.inertia[0])
    rods = {("flat", "at rest"): ("v", "start", 0, 0), ("flat", "at rest (acceleration)"): ("a", "start", 0, 0)}
    rods |= {("flat", "start posture"): ("q", "start", data["start"], data["start"])}
    rods |= {(phase, "state box"): ("q", "inner", low, high) for phase in ("flat", "toe")}
    most = e.inertia[0] + S.flight_inertia * (e.inertia[1] - e.inertia[0])  # nearer than the margin
    rods["flight", "inertia range"] = "q", "all", e.inertia[0] + margin, most
    rods["flight", "inertia rate range"] = "v", "all", -S.inertia_rate, S.inertia_rate
    rods["flight", "inertia acceleration range"] = "a", "all", -S.inertia_accel, S.inertia_accel
    same_boxes(rod, rods, data)
