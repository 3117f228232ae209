"""Stage 2's own rows: what a term sees, both solvers, weights, switches, and what is refused before any solve."""

from functools import cache
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest

import jumplab as jl
from jumplab import stages
from jumplab.models.full import FullBody
from jumplab.stages.joint_qp import (
    CvxpySolver,
    DirectSolver,
    JointMapper,
    Options,
    StepPoint,
    map_to_joints,
    terms_table,
)
from jumplab.stages.joint_qp.changes import BLOCKS

TARGETS = [(1.0, 0.5), (0.0, 0.3), (0.3, 0.2), (0.5, 0.5), (0.7, 0.4), (0.9, 0.2)]


def term(expression, name="mine", weight=None, unit="rad/s^2", **bounds):
    return jl.Term(name, "ours", unit, "node", expression, weight, **bounds)


def swing(p):
    return p.joint_accelerations.shoulder


@cache
def stage1(distance_m=1.0, height_m=0.5):
    return stages.srmp.SrmpPlanner(jl.Robot.load()).plan(jl.JumpTask(distance_m, height_m))


@cache
def plain(method="direct"):
    return map_to_joints(stage1(), jl.Robot.load(), method=method)


def mapped(method="direct", **changes):
    return map_to_joints(stage1(), jl.Robot.load(), method=method, **changes)


# ------------------------------------------------------------------------------------------ what a term sees


@pytest.fixture(scope="module")
def instant():
    """A random state: body, q, v, theta'', F, and the points of launch and flight there."""
    body, rng = FullBody(jl.Robot.load()), np.random.default_rng(5)
    q = pin.integrate(body.model, pin.neutral(body.model), 0.5 * rng.standard_normal(body.nv))
    v, a, F = (rng.standard_normal(n) for n in (body.nv, body.nv, 12))
    terms = body.terms(q, v)
    return body, q, v, a, F, StepPoint(body, 12, terms, 0.1), StepPoint(body, 0, terms, 0.1)


def value(x, a, F):
    unknowns = np.r_[F, a][-x.matrix.shape[1] :]
    return x.matrix @ unknowns + x.offset


def second_difference(body, q, v, a, of, h=1e-4):
    """Second derivative of a function of the configuration along a motion with constant accelerations."""
    before, after = (of(pin.integrate(body.model, q, s * h * v + h * h / 2 * a)) for s in (-1, 1))
    return (before - 2 * of(q) + after) / h**2


@pytest.mark.parametrize(
    "name", ["left_hand", "right_hand", "left_toe", "right_heel", "left_sole", "trunk", "right_knee"]
)
def test_points_move_as_pinocchio_says(instant, name):
    body, q, v, a, F, *points = instant
    for p in points:
        place = p.point(name)
        moved = second_difference(
            body, q, v, a, lambda x: StepPoint(body, 0, body.terms(x, v), 0.0).point(name).position
        )
        np.testing.assert_allclose(value(place.acceleration, a, F), moved, atol=1e-5)
    data = body.model.createData()
    pin.forwardKinematics(body.model, data, q, v)
    if body.model.existFrame(name):
        pin.updateFramePlacements(body.model, data)
        frame = body.model.getFrameId(name)
        np.testing.assert_allclose(place.position, data.oMf[frame].translation, atol=1e-12)
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        np.testing.assert_allclose(
            place.velocity, pin.getFrameVelocity(body.model, data, frame, axes).linear, atol=1e-12
        )


def test_quantities_are_pinocchios(instant):
    """Torques by inverse dynamics, momentum's rate by the centroidal one, inertia's by differences."""
    body, q, v, a, F, launch, flight = instant
    model, data, robot = body.model, body.model.createData(), body.robot
    needed = pin.rnea(model, data, q, v, a)[6:]
    given = body.terms(q, v).J[:, 6:].T @ F
    for joint in ("left_knee", "right_shoulder_pitch"):
        k = robot.joint_names.index(joint)
        np.testing.assert_allclose(value(getattr(flight.torques, joint), a, F), needed[k], atol=1e-9)
        np.testing.assert_allclose(value(getattr(launch.torques, joint), a, F), (needed - given)[k], atol=1e-9)
        np.testing.assert_allclose(value(getattr(launch.joint_accelerations, joint), a, F), a[6 + k])
        assert (getattr(launch.joints, joint), getattr(launch.joint_rates, joint)) == (q[7 + k], v[6 + k])
    rate = pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
    np.testing.assert_allclose(value(launch.L_rate, a, F), rate.angular[1], atol=1e-9)
    np.testing.assert_allclose(value(launch.com_acceleration, a, F), rate.linear / body.mass, atol=1e-9)
    rho = second_difference(body, q, v, a, lambda x: body.terms(x, v).rho)
    np.testing.assert_allclose(value(flight.inertia_acceleration, a, F), rho, atol=1e-4)
    np.testing.assert_array_equal(value(launch.wrench, a, F), F)
    np.testing.assert_array_equal(value(flight.accelerations, a, F), a)
    x = body.terms(q, v)
    assert (launch.L, launch.inertia, launch.inertia_rate, launch.time) == (x.momentum[4], x.rho, x.rho_rate, 0.1)
    assert np.array_equal(launch.com, x.com) and np.array_equal(launch.com_velocity, x.com_velocity)


def test_affine_quantities_add_and_scale(instant):
    *_, a, F, p, _ = instant
    x, y = p.joint_accelerations.knee, p.joint_accelerations.hip
    vx, vy, M = value(x, a, F), value(y, a, F), np.array([[1.0, 2.0], [0.0, -1.0], [3.0, 1.0]])
    for made, wanted in [
        (x + y, vx + vy), (x - y, vx - vy), (2 * x / 4 + 1, vx / 2 + 1), (3 - x, 3 - vx), (-x, -vx), (M @ x, M @ vx),
        (np.ones(2) + x, vx + 1), (np.array([1.0, 2.0]) * x, [1, 2] * vx), (x[1], vx[1]), (x[::-1], vx[::-1]),
        (x[0] + [1.0, 2.0], vx[0] + [1.0, 2.0]), (type(x).stack(x, y), np.r_[vx, vy]),
    ]:  # fmt: skip
        np.testing.assert_allclose(value(made, a, F), np.atleast_1d(wanted), atol=1e-12)
    with pytest.raises(TypeError, match="a QP's rows are affine"):
        x * y


# ------------------------------------------------------------------------------------------ in the QPs


def test_weight_zero_and_no_change_leave_every_bit():
    for changes in ({"terms": {"flight": [term(swing, weight=0.0)]}}, {"terms": {}}, {"weights": {"com": 1.0}}):
        other = mapped(**changes)
        for key in ("q", "v", "a", "f", "tau"):
            np.testing.assert_array_equal(getattr(other, key), getattr(plain(), key))


@pytest.mark.parametrize("target", [TARGETS[0], *(pytest.param(x, marks=pytest.mark.slow) for x in TARGETS[1:])])
def test_a_growing_weight_lowers_the_terms_own_value(target):
    """Over the whole roll-out as long as no stop brakes the arms; steps that do, which no QP foresees, add 5 %."""
    robot, srmp, sizes, free = jl.Robot.load(), stage1(*target), [], []
    arms = [k for k, name in enumerate(robot.joint_names) if "shoulder_pitch" in name]
    for weight in (0.0, *10.0 ** np.arange(-4, 4)):
        plan = map_to_joints(srmp, robot, method="direct", terms={"flight": [term(swing, weight=weight)]})
        steps = range(plan.rows("flight").start, plan.rows("flight").stop - 1)
        qp, a = JointMapper(srmp, robot).flight_from(plan.state(steps[0])), plan.a[steps][:, 6:]
        ends = [qp.joints.acceleration(plan.q[k, 7:], plan.v[k, 6:], qp.step) for k in steps]
        braked = np.any([np.abs(a - x) < 1e-3 * (1 + np.abs(x)) for x in np.moveaxis(ends, 1, 0)], axis=0)
        squares = a[:, arms] ** 2
        sizes.append(squares.sum())
        free.append(squares[~braked[:, arms]].sum())
    assert all(later < before for before, later in pairwise(free)), free
    assert all(later < before for before, later in pairwise(sizes[:5])) and sizes[4] < 0.5 * sizes[0], sizes
    assert all(size < 1.05 * min(sizes[:k]) for k, size in enumerate(sizes) if k), sizes


@pytest.mark.parametrize("solver", [DirectSolver, CvxpySolver])
def test_a_growing_weight_lowers_the_terms_own_value_at_every_step(solver):
    """At one and the same state an optimum's term can only fall as its weight grows, however large."""
    for phase in ("launch", "flight"):
        for k in (1, 12, 25):
            state, sizes = plain().state(plain().rows(phase).start + k), []
            for weight in (1e-6, 1e-3, 1.0, 1e3, 1e6):
                own = {phase: [term(swing, weight=weight)]}
                mapper = JointMapper(stage1(), jl.Robot.load(), terms=own)
                begin = plain().state(plain().rows("flight").start)
                qp = mapper.launch if phase == "launch" else mapper.flight_from(begin)
                matrices = mapper.problem(qp, k, state)[2]
                x = solver(matrices).solve(matrices, phase, 0.0).x
                sizes.append(np.abs(x[qp.first + 6 :][[6, 13]]).max())
            assert all(later <= before * (1 + 1e-6) + 1e-6 for before, later in pairwise(sizes)), (phase, k, sizes)
            assert sizes[-1] < sizes[0]


def test_inequalities_and_equalities_hold_alike_in_both_solvers():
    """A knee that must not push as much, and legs that turn about the vertical in flight."""
    names = jl.Robot.load().joint_names
    knee, yaw = names.index("left_knee"), 6 + names.index("left_hip_yaw")
    assert plain().tau[plain().rows("launch"), knee].min() < -105 and np.abs(plain().a[:, yaw]).max() < 0.1
    own = {
        "launch": [term(lambda p: p.torques.knee, "weak knee", None, "N m", lower=[-100.0, -100.0], upper=np.inf)],
        "flight": [term(lambda p: p.joint_accelerations.left_hip_yaw, "turn", None, lower=0.5, upper=0.5)],
    }
    plans = [mapped(method, terms=own) for method in ("direct", "cvxpy")]
    for plan in plans:
        assert plan.tau[plan.rows("launch"), knee].min() > -100 - 1e-6
        np.testing.assert_allclose(plan.a[plan.rows("flight"), yaw], 0.5, atol=1e-6)
    np.testing.assert_allclose(plans[0].q, plans[1].q, atol=1e-4)


def test_the_middle_of_the_step_is_a_terms_time():
    seen = []
    mapped(terms={"flight": [term(lambda p: seen.append(p.time) or swing(p), weight=1e-9)]})
    plan = plain()
    t = plan.t[plan.rows("flight")] - plan.t[plan.rows("flight").start]
    assert seen[0] == 0 and set(np.round(seen, 9)) >= set(np.round((t[1:] + t[:-1]) / 2, 9))


@pytest.mark.parametrize("phase", BLOCKS)
def test_every_block_has_a_row_in_the_table(phase):
    """The table speaks of the blocks that the QPs have, and every weight of the settings is a block's."""
    mapper = JointMapper(stage1(), jl.Robot.load())
    qp = mapper.launch if phase == "launch" else mapper.flight_from(plain().state(plain().rows("flight").start))
    assert set(qp.layout.blocks) == set(BLOCKS[phase])
    rows = {r["name"]: r for r in terms_table() if r["phase"] == phase}
    assert set(rows) == set(BLOCKS[phase]) and all(r["unit"] and r["equation"] and r["value"] for r in rows.values())
    for name, (matrix, _) in qp.layout.blocks.items():
        assert rows[name]["kind"] == ("cost" if matrix == "A" else "constraint")
    fields = {f for block in BLOCKS[phase].values() for f in block.weights}
    assert fields == {f for f in vars(getattr(Options(), phase)) if f != "inertia_fade_s"}


@pytest.mark.parametrize("phase", BLOCKS)
def test_factors_and_switches_reach_their_block_alone(phase):
    """A factor of 4 doubles the rows of a block in A and b; a switch makes them zero; all others stay."""
    state = plain().state(plain().rows(phase).start)

    def rows(**changes):
        mapper = JointMapper(stage1(), jl.Robot.load(), **changes)
        qp = mapper.problem(mapper.launch if phase == "launch" else mapper.flight_from(state), 0, state)[2]
        sides = {"A": (qp.A, qp.b), "E": (qp.E, qp.e), "G": (qp.G, qp.h), "R": (qp.R, qp.lower, qp.upper)}
        return {name: [x[at] for x in sides[matrix]] for name, (matrix, at) in qp.layout.blocks.items()}

    before = rows()
    for name, block in BLOCKS[phase].items():
        cases = [] if name == "base dynamics" else [(0.0, {"off": (f"{phase}/{name}",)})]
        cases += [(2.0, {"weights": {f"{phase}/{name}": 4.0}})] if block.weights else []
        for factor, changes in cases:
            for other, parts in rows(**changes).items():
                for x, y in zip(parts, before[other], strict=True):
                    np.testing.assert_allclose(x, (factor if other == name else 1.0) * y, rtol=1e-12)


def test_a_table_tells_own_terms_and_what_is_left():
    own = {"launch": [term(swing, "calm", 0.5)], "flight": [term(lambda p: p.L_rate, "L", lower=-1, upper=1)]}
    mapper = JointMapper(stage1(), jl.Robot.load(), terms=own, off=("symmetry",), weights={"calm": 2.0})
    rows = {(r["phase"], r["name"]): r["value"] for r in terms_table(mapper.options)}
    assert rows["launch", "calm"] == "weight 1" and rows["flight", "L"] == "-1 ... 1"
    assert not any(name == "symmetry" for _, name in rows)
    assert len(rows) == len(terms_table()) + 2 - 2


def test_an_own_term_that_cannot_hold_is_named():
    with pytest.raises(jl.errors.SolverError, match=r"of the launch no joint motion follows stage 1.*'pull'"):
        own = {"launch": [term(lambda p: p.wrench[2], "pull", None, "N", lower=-np.inf, upper=-10.0)]}
        map_to_joints(stage1(), jl.Robot.load(), method="direct", options=Options(), terms=own)


# ------------------------------------------------------------------------------------------ what is refused

LAUNCH = "term 'mine' of 'joint qp/launch'"
KNOWN = (
    "com, force, moment, inertia, wrench, tiptoe, foot pitch or toe moment, ground, heel, joints, trunk turn, "
    "acceleration, base dynamics, symmetry, torque, speed and range, foot, foot level"
)
NO_SUCH = f"'joint qp' has no such term; it has {KNOWN}"
REFUSED = [
    ({"terms": {"air": []}}, "own terms of 'joint qp': no phase 'air'; it has launch, flight"),
    ({"terms": {"launch": [3]}}, "an own term of 'joint qp/launch' must be a Term, got 3"),
    ({"terms": {"launch": [term(swing, "com", 1.0)]}},
     "term 'com' of 'joint qp/launch': the name is taken; give it one of its own"),
    ({"terms": {"launch": [term(swing, weight=1.0)] * 2}}, f"{LAUNCH}: the name is taken; give it one of its own"),
    ({"terms": {"launch": [term(swing, "a/b", 1.0)]}}, "term 'a/b' of 'joint qp/launch': a name must not hold a '/'"),
    ({"terms": {"launch": [jl.Term("mine", "ours", "m", "end", swing, 1.0)]}},
     f"{LAUNCH}: at = 'end', skip = (0, 0); every step has its own QP, with at = 'node' and no skip"),
    ({"terms": {"launch": [term(swing, weight=-1.0)]}}, f"{LAUNCH}: weight = -1.0 must be a number of 0 or more"),
    ({"terms": {"launch": [term(lambda p: 1.0, weight=1.0)]}},
     f"{LAUNCH}: its expression is float, must be rows that depend on the accelerations, such as "
     "p.joint_accelerations.knee"),
    ({"terms": {"launch": [term(lambda p: swing(p) * np.nan, weight=1.0)]}},
     f"{LAUNCH}: its expression is not finite at t = 0.000 s"),
    ({"terms": {"launch": [term(lambda p: swing(p) * swing(p), weight=1.0)]}},
     f"{LAUNCH}: its expression fails (two quantities that depend on the accelerations were multiplied; a QP's rows "
     "are affine)"),
    ({"terms": {"launch": [term(swing, lower=[1, 2, 3], upper=9)]}},
     f"{LAUNCH}: lower = [1, 2, 3] does not fit its expression, which has 2 rows"),
    ({"terms": {"launch": [term(swing, lower="low")]}}, f"{LAUNCH}: lower = 'low' is no number"),
    ({"terms": {"launch": [term(swing, lower=2.0, upper=1.0)]}}, f"{LAUNCH}: lower = 2.0 is above upper = 1.0"),
    ({"terms": {"flight": [term(lambda p: p.wrench, weight=1.0)]}},
     "term 'mine' of 'joint qp/flight': its expression fails (a point of this phase has no 'wrench'; it has L, L_rate, "
     "accelerations, com, com_acceleration, com_velocity, inertia, inertia_acceleration, inertia_rate, "
     "joint_accelerations, joint_rates, joints, point, time, torques)"),
    ({"weights": {"knee": 1.0}}, f"weight or switch 'knee': {NO_SUCH}"),
    ({"off": ("launch/foot",)}, f"weight or switch 'launch/foot': {NO_SUCH}"),
    ({"weights": {"torque": 2.0}}, "'joint qp': 'torque' is a constraint and has no weight; switch it off instead"),
    ({"weights": {"com": -2}}, "weight 'com' of 'joint qp' = -2: its factor must be a number of 0 or more"),
    ({"off": "symmetry"}, "off must be a list of names, got 'symmetry'"),
    ({"off": ("base dynamics",)},
     "term 'base dynamics' of 'joint qp' links forces and motion; it cannot be switched off"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "sentence"), REFUSED)
def test_refused_in_a_sentence_before_any_solve(changes, sentence, monkeypatch):
    monkeypatch.setattr(JointMapper, "run", lambda *_: pytest.fail("solved"))
    with pytest.raises(jl.errors.InputError) as e:
        mapped(**changes)
    assert str(e.value) == sentence
