"""Stage 2's own rows: what a term sees, both solvers, weights, switches, and what is refused before any solve."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import refused
from paper.joint_qp_studies import CvxpySolver

import jumplab as jl
from jumplab import stages
from jumplab.errors import nearest
from jumplab.models.full import FullBody
from jumplab.ocp.qp import QpSolver
from jumplab.stages.changes import StageChanges
from jumplab.stages.joint_qp import JointMapper, Options, StepPoint, build_problem, map_to_joints

TERMS = {p.name: p.terms for p in build_problem(Options()).phases}
TARGETS = [(1.0, 0.5), (0.0, 0.3), (0.3, 0.2), (0.5, 0.5), (0.7, 0.4), (0.9, 0.2)]


def term(expression, name="mine", weight=None, unit="rad/s^2", **bounds):
    return jl.Term(name, "ours", unit, "node", expression, weight, **bounds)


def swing(p):
    return p.joint_accelerations.shoulder


@cache
def stage1(distance_m=1.0, height_m=0.5):
    return stages.srmp.SrmpPlanner(jl.Robot.load()).plan(jl.JumpTask(distance_m, height_m))


@cache
def plain():
    return map_to_joints(stage1(), jl.Robot.load())


def mapped(**changes):
    return map_to_joints(stage1(), jl.Robot.load(), changes=StageChanges(**changes))


def changed_mapper(**changes):
    return JointMapper(stage1(), jl.Robot.load(), changes=StageChanges(**changes))


def qp_of(phase, mapper):
    return mapper.launch if phase == "launch" else mapper.flight_from(plain().state(plain().rows("flight").start))


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
        (x[0] + [1.0, 2.0], vx[0] + [1.0, 2.0]),
    ]:  # fmt: skip
        np.testing.assert_allclose(value(made, a, F), np.atleast_1d(wanted), atol=1e-12)
    with pytest.raises(TypeError, match="a QP's rows are affine"):
        x * y


# ------------------------------------------------------------------------------------------ in the QPs


def test_weight_zero_and_no_change_leave_the_motion():
    for changes in ({"terms": {"flight": [term(swing, weight=0.0)]}}, {"terms": {}}, {"weights": {"com": 1.0}}):
        other = mapped(**changes)
        for key in ("q", "v", "a", "f", "tau"):
            np.testing.assert_allclose(getattr(other, key), getattr(plain(), key), atol=1e-6)


@pytest.mark.parametrize("phase", TERMS)
def test_a_growing_weight_lowers_the_terms_own_value_at_every_step(phase):
    """At one and the same state an optimum's term can only fall as its weight grows, however large."""
    for k in (1, 12, 25):
        state, sizes = plain().state(plain().rows(phase).start + k), []
        for weight in (1e-6, 1e-3, 1.0, 1e3, 1e6):
            mapper = changed_mapper(terms={phase: [term(swing, weight=weight)]})
            qp = qp_of(phase, mapper)
            x = QpSolver().solve(mapper.step(qp, k, state)[2]).x
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
    plans = [mapped(terms=own), changed_mapper(terms=own).run(CvxpySolver())]
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


@pytest.mark.parametrize("phase", TERMS)
def test_every_term_has_a_row_in_the_table(phase):
    mapper = JointMapper(stage1(), jl.Robot.load())
    program = mapper.step(qp_of(phase, mapper), 0, plain().state(plain().rows(phase).start))[2]
    rows = {r["name"]: r for r in mapper.problem.table() if r["phase"] == phase}
    assert all(r["unit"] and r["equation"] and r["value"] for r in rows.values())
    assert {name for name, r in rows.items() if r["kind"] == "cost"} == set(program.costs)
    assert set(rows) == {*program.costs, *program.equalities, *program.limits}


def test_every_weight_of_the_settings_is_a_terms():
    """A weight ten times as large changes the term of its name alone, feet flat, on the toes, or in flight."""
    names = {"posture": "joints", "trunk": "trunk turn", "foot_level": "foot level"}
    names |= {"com_x": "com", "force_x": "force", "inertia_toe": "inertia"}
    for phase in TERMS:
        usual, before = getattr(Options(), phase), squares(phase)
        for field, value in vars(usual).items():
            if field != "inertia_fade_s":
                after = squares(phase, Options(**{phase: replace(usual, **{field: 10 * value})}))
                changed = {name for name in before if not np.allclose(after[name], before[name], rtol=1e-9)}
                assert changed == {names.get(field, field)}, (phase, field)


def squares(phase, options=None):
    """Cost -> weight times the squares of every row's coefficients, at the first and the last step of a phase."""
    mapper = JointMapper(stage1(), jl.Robot.load(), options=options or Options())
    qp, first = qp_of(phase, mapper), plain().rows(phase).start
    steps = [mapper.step(qp, k, plain().state(first + k))[2].costs for k in (0, len(qp.steps) - 1)]
    return {name: np.r_[*(step[name].weight * (step[name].matrix ** 2).sum(1) for step in steps)] for name in steps[0]}


@pytest.mark.parametrize("phase", TERMS)
def test_factors_and_switches_reach_their_term_alone(phase):
    """A factor of 4 is on the weight of a cost; a switch leaves its rows out; all others stay."""
    state = plain().state(plain().rows(phase).start)

    def blocks(**changes):
        mapper = changed_mapper(**changes)
        program = mapper.step(qp_of(phase, mapper), 0, state)[2]
        return {b.name: b for b in (*program.costs.values(), *program.constraints())}

    before = blocks()
    for name, one in before.items():
        if name != "base dynamics":
            assert set(blocks(off=(f"{phase}/{name}",))) == set(before) - {name}
        if one.weight is not None:
            for other, b in blocks(weights={f"{phase}/{name}": 4.0}).items():
                weight = before[other].weight if before[other].weight is not None else 1.0
                np.testing.assert_allclose(
                    1.0 if b.weight is None else b.weight, (4.0 if other == name else 1.0) * weight
                )
                np.testing.assert_allclose(b.matrix, before[other].matrix, rtol=1e-12)


def test_a_table_tells_own_terms_and_what_is_left():
    own = {"launch": [term(swing, "calm", 0.5)], "flight": [term(lambda p: p.L_rate, "L", lower=-1, upper=1)]}
    mapper = changed_mapper(terms=own, off=("symmetry",), weights={"calm": 2.0})
    rows = {(r["phase"], r["name"]): r["value"] for r in mapper.problem.table()}
    assert rows["launch", "calm"] == "weight 1" and rows["flight", "L"] == "-1 ... 1"
    assert not any(name == "symmetry" for _, name in rows)
    assert len(rows) == len(build_problem(Options()).table()) + 2 - 2


def test_an_own_term_that_cannot_hold_is_named():
    with pytest.raises(jl.errors.SolverError, match=r"of the launch no joint motion follows stage 1.*'pull'"):
        own = {"launch": [term(lambda p: p.wrench[2], "pull", None, "N", lower=-np.inf, upper=-10.0)]}
        map_to_joints(stage1(), jl.Robot.load(), options=Options(), changes=StageChanges(own))


# ------------------------------------------------------------------------------------------ what is refused

LAUNCH = "term 'mine' of 'joint qp/launch'"
KNOWN = sorted({t.name for terms in TERMS.values() for t in terms})
NO_SUCH = "the problem 'joint qp' has no such term; it has "
REFUSED = [
    ({"terms": {"air": [term(swing)]}}, "term 'mine': 'joint qp' has no phase 'air'; it has launch, flight, and "
     "'joint qp' for terms that join them"),
    ({"terms": {"launch": [3]}}, "an own term of 'joint qp/launch' must be a Term, got 3"),
    ({"terms": {"launch": [term(swing, "com", 1.0)]}},
     "term 'com' of 'joint qp/launch': another term has this name; choose another one"),
    ({"terms": {"launch": [term(swing, weight=1.0)] * 2}}, f"{LAUNCH}: another term has this name; choose another one"),
    ({"terms": {"launch": [term(swing, "a/b", 1.0)]}}, "term 'a/b' of 'joint qp/launch': a name must not hold a '/'"),
    ({"terms": {"launch": [jl.Term("mine", "ours", "m", "end", swing, 1.0)]}},
     f"{LAUNCH}: at = 'end', skip = (0, 0), must be 'node' and (0, 0), since every step has its own QP"),
    ({"terms": {"launch": [term(swing, weight=-1.0)]}}, "weight 'mine' = -1.0: it must be a number of 0 or more"),
    ({"terms": {"launch": [term(lambda p: 1.0, weight=1.0)]}},
     f"{LAUNCH}: its expression is float, must be rows that depend on the accelerations, such as "
     "p.joint_accelerations.knee"),
    ({"terms": {"launch": [term(lambda p: swing(p) * np.nan, weight=1.0)]}},
     f"{LAUNCH}: its expression is not finite at t = 0.000 s"),
    ({"terms": {"launch": [term(lambda p: swing(p) * swing(p), weight=1.0)]}},
     f"{LAUNCH}: its expression fails (two quantities that depend on the accelerations were multiplied; a QP's rows "
     "are affine)"),
    ({"terms": {"launch": [term(swing, lower=[1, 2, 3], upper=9)]}},
     f"{LAUNCH}: lower = [1, 2, 3] does not fit its expression, which has 2 rows; give one number, or one per row"),
    ({"terms": {"launch": [term(swing, lower="low")]}}, f"{LAUNCH}: lower = 'low' is not a number"),
    ({"terms": {"launch": [term(swing, lower=2.0, upper=1.0)]}}, f"{LAUNCH}: lower = 2.0 is above upper = 1.0"),
    ({"terms": {"flight": [term(lambda p: p.wrench, weight=1.0)]}},
     "term 'mine' of 'joint qp/flight': its expression fails (a point of this phase has no 'wrench'; it has L, L_rate, "
     "accelerations, affine, com, com_acceleration, com_velocity, forces, inertia, inertia_acceleration, inertia_rate, "
     "joint_accelerations, joint_rates, joints, point, time, torques)"),
    ({"weights": {"knee": 1.0}}, f"weight or switch 'knee': {NO_SUCH}{nearest(KNOWN, 'knee')}"),
    ({"off": ("launch/foot",)}, f"weight or switch 'launch/foot': {NO_SUCH}{nearest(KNOWN, 'foot')}"),
    ({"weights": {"torque": 2.0}}, "joint qp: 'torque' is a constraint and has no weight; switch it off instead"),
    ({"weights": {"com": -2}}, "weight 'com' of 'joint qp' = -2: its factor must be a number of 0 or more"),
    ({"off": ("base dynamics",)},
     "term 'base dynamics' ties the plan into one motion, as dynamics and links do; it cannot be switched off"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "sentence"), REFUSED)
def test_refused_in_a_sentence_before_any_solve(changes, sentence, monkeypatch):
    monkeypatch.setattr(JointMapper, "run", lambda *_: pytest.fail("solved"))
    assert refused(mapped, **changes, by=jl.errors.InputError) == sentence
