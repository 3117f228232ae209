"""Stage 3 as printed: its coordinates, its rows against two other derivations, and what its answer gets wrong."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import LIMBS, full_state, inverse_dynamics, jump, refused, turned
from paper.expansion import expand
from paper.lagrange import five_links
from paper.violations import planar_motion, violations
from paper.whole_body_printed import (
    LINK_OF_THETA,
    MOTION,
    PaperCoordinates,
    PrintedPlan,
    PrintedTerms,
    PrintedWholeBody,
    planar_numbers,
)

from jumplab.ocp.problem import Point
from jumplab.robot.stance import stance_configuration
from jumplab.stages.whole_body.settings import Weights

G, MASS = 9.8, 42.0
BROKEN = {"heel up and a moment about the toe", "moment about the toe, heel up", "CoP outside the sole",
          "c_z'' at take-off, off -g", "force residual, launch", "force residual, flight", "drift of L in flight",
          "jump length error", "sole off the surface at touchdown", "foot pitch at touchdown"}  # fmt: skip


@pytest.fixture(scope="module")
def planner(bhr):
    return PrintedWholeBody(bhr)


@pytest.fixture(scope="module")
def ours():
    return jump(1.0, 0.5)


@pytest.fixture(scope="module")
def printed(planner, ours):
    return planner.plan(ours.srmp, ours.joints)


def states(count, seed=0):
    """Random theta, theta', theta'', each (count, 7)."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.2, 1.2, (count, 7)), *(rng.normal(scale=s, size=(count, 7)) for s in (3, 30))


def rows_function(robot, flying):
    """base_rows and tau_y as a function of theta, theta', theta'', F and the reference's dL/dt."""
    q, v, a, z, rate = (ca.SX.sym(n, k) for n, k in (("q", 7), ("v", 7), ("a", 7), ("z", 2), ("rate", 1)))
    space, terms = SimpleNamespace, PrintedTerms(robot, Weights())
    point = Point(q, v, a, None, z, 1.0, 0.0, space(), space(gravity=G), space(L_rate=rate))
    return ca.Function("rows", [q, v, a, z, rate], [terms.base_rows(point, flying), terms.tau_y(point)])


def one(motion, k):
    return {name: motion[name][k] for name in MOTION}


def pinocchio_state(robot, motion, k):
    x = one(motion, k)
    return full_state(robot, *(x[name] for name in MOTION))


# coordinates ----------------------------------------------------------------------------------------------------
def test_coordinates_there_and_back(bhr):
    paper, given = PaperCoordinates(bhr.sagittal), states(5)
    for there, back in zip(given, paper.theta(paper.links(*given)), strict=True):
        np.testing.assert_allclose(back, there, atol=1e-11)


def test_link_angles_are_those_of_the_robot(bhr):
    theta = states(3, seed=1)[0]
    np.testing.assert_allclose(theta @ LINK_OF_THETA.T, bhr.sagittal.link_angles(theta[:, 3:], theta[:, 2]), atol=1e-14)


def test_derivatives_of_the_toe(bhr):
    paper, h = PaperCoordinates(bhr.sagittal), 1e-5
    theta, rate, accel = states(4, seed=2)
    before, after = (paper.links(theta + t * rate + t * t / 2 * accel, rate + t * accel, accel) for t in (-h, h))
    now = paper.links(theta, rate, accel)
    for name, slope in (("toe", "toe_velocity"), ("toe_velocity", "toe_acceleration")):
        np.testing.assert_allclose(now[slope], (after[name] - before[name]) / (2 * h), rtol=1e-6, atol=1e-5)


def test_base_is_the_base_link_of_the_robot(bhr):
    """theta's x, z and pitch are the free-flyer's, with rates; its joints are the robot's up to their sign."""
    motion = PaperCoordinates(bhr.sagittal).links(*states(3, seed=3))
    for k in range(3):
        q, v, _ = pinocchio_state(bhr, motion, k)
        theta, rate, _ = (x[k] for x in states(3, seed=3))
        np.testing.assert_allclose(q[[0, 2]], theta[:2], atol=1e-12)
        np.testing.assert_allclose(turned(theta[2], v[[0, 2]]), rate[:2], atol=1e-10)
        assert 2 * np.arctan2(q[4], q[6]) == pytest.approx(theta[2])
        for i, role in enumerate(LIMBS):
            column = bhr.model.idx_qs[bhr.model.getJointId(bhr.joints[role][0])]
            assert bhr.sagittal.signs[i, 0] * q[column] == pytest.approx(theta[3 + i])


def test_start_is_the_stance(bhr, planner, printed):
    first = one(printed.motion, 0)
    q = full_state(bhr, *(first[name] for name in MOTION))[0]
    np.testing.assert_allclose(q, stance_configuration(bhr), atol=1e-9)
    # slopes of the polynomial at its ends are rounded
    assert max(np.abs(first["rates"]).max(), np.abs(first["toe_velocity"]).max()) < 1e-12


# rows -----------------------------------------------------------------------------------------------------------
def test_rows_against_lagrange(bhr):
    """First three of M theta'' + H with the base at the hip; the third is then taken about the trunk's top."""
    rows, second, s = rows_function(bhr, True), five_links(bhr.sagittal), bhr.sagittal
    for theta, rate, accel in zip(*states(5, seed=4), strict=True):
        arm = -turned(theta[2], s.base)  # from the trunk's top to the hip
        across = np.array([arm[1], -arm[0]])
        hip = [np.array([*(x[:2] + d), *x[2:]]) for x, d in
               ((theta, arm), (rate, rate[2] * across), (accel, accel[2] * across - rate[2] ** 2 * arm))]  # fmt: skip
        f_x, f_z, about_hip = second(*hip).full().ravel()[:3]
        got = rows(theta, rate, accel, np.zeros(2), 0.0)[0].full().ravel()
        np.testing.assert_allclose(got, [f_x, f_z, about_hip + arm[1] * f_x - arm[0] * f_z], atol=1e-8)


def test_rows_against_pinocchio(bhr):
    """M theta'' + H - J' F_ext of the full robot, with the ground's force and the paper's tau_y at the toes."""
    rows, motion = rows_function(bhr, False), PaperCoordinates(bhr.sagittal).links(*states(4, seed=5))
    for k, (theta, rate, accel) in enumerate(zip(*states(4, seed=5), strict=True)):
        force, l_rate = np.array([150.0, 700.0]), 40.0
        got, tau_y = (x.full().ravel() for x in rows(theta, rate, accel, force, l_rate))
        left = inverse_dynamics(bhr, *pinocchio_state(bhr, motion, k), [*force, tau_y[0]], motion["toe"][k])
        np.testing.assert_allclose(got, [*turned(theta[2], left[[0, 2]]), left[4]], atol=1e-7)


def test_tau_y_makes_the_third_row_momentum(bhr):
    """With Newton's two rows kept, the moment's row is dL/dt - dL/dt of the reference, whatever the reference is."""
    rows, given = rows_function(bhr, False), states(3, seed=6)
    x = planar_numbers(bhr, PaperCoordinates(bhr.sagittal).links(*given), G)
    for k, state in enumerate(zip(*given, strict=True)):
        got = rows(*state, x["force"][k], 25.0)[0].full().ravel()
        np.testing.assert_allclose(got, [0.0, 0.0, x["L_rate"][k, 0] - 25.0], atol=1e-8)


def test_every_printed_equation_is_there(planner):
    launch, flight = ({r["equation"] for r in nlp.problem.table()} for nlp in (planner.launch, planner.flight))
    assert {"WL-J1", "WL-J2", "WL-J3", "WL-D1..D3", "WL-K1", "WL-K2", "WL-E1", "WL-S, WF-S"} <= launch
    assert {"WF-J1", "WF-J2", "WF-D1", "WF-L1", "WF-L2", "WF-L3", "WF-E1", "WF-E2", "WL-S, WF-S"} <= flight


# the answer -----------------------------------------------------------------------------------------------------
def at_nodes(robot, phase):
    """Planar quantities at the nodes of a solved phase."""
    motion = PaperCoordinates(robot.sagittal).links(phase.q, phase.v, phase.a)
    return motion | planar_numbers(robot, motion, G)


def test_launch_solves_and_flight_does_not(bhr, printed):
    """The launch ends with the ground still pushing; a flight that starts there and falls freely cannot exist."""
    assert printed.launch_status == "Solve_Succeeded"
    assert printed.flight_status == "Infeasible_Problem_Detected"
    assert printed.repaired_status == "Solve_Succeeded"
    assert np.linalg.norm(at_nodes(bhr, printed.launch.phases["launch"])["force"][-1]) > 0.1 * MASS * G


def test_launch_keeps_what_is_printed_at_its_nodes(bhr, ours, printed):
    end = printed.launch.phases["launch"]
    x = at_nodes(bhr, end)
    np.testing.assert_allclose(x["force"], end.z, atol=1e-2)
    np.testing.assert_allclose(x["toe_velocity"], 0.0, atol=1e-5)
    heel = x["heel"][:, 1] + x["toe"][:, 1]
    assert np.all(np.diff(heel) > -1e-3)
    velocity = x["com_velocity"][-1] + x["toe_velocity"][-1]
    np.testing.assert_allclose(velocity, ours.srmp.launch.com_velocity[-1], atol=1e-5)
    l_rate = np.interp(end.t, ours.srmp.launch.t, ours.srmp.launch.L_rate)
    np.testing.assert_allclose(x["L_rate"][:, 0], l_rate, atol=1e-2)
    assert end.duration == pytest.approx(ours.srmp.launch_s)


def test_flight_keeps_what_is_printed(bhr, ours, printed):
    launch, flight = printed.launch.phases["launch"], printed.flight.phases["flight"]
    for key in "qva":
        np.testing.assert_allclose(getattr(flight, key)[0], getattr(launch, key)[-1], atol=1e-6)
    np.testing.assert_allclose(flight.v[-1, 3:], 0.0, atol=1e-6)
    np.testing.assert_allclose(flight.a[-1, 3:], 0.0, atol=1e-4)
    assert flight.duration == pytest.approx(ours.srmp.flight_s)
    x = at_nodes(bhr, flight)
    np.testing.assert_allclose(x["force"][1:], 0.0, atol=1e-2)
    np.testing.assert_allclose(x["L_rate"][1:], 0.0, atol=1e-2)
    ahead = (x["sole"] - x["com"])[:, 0]
    assert ahead[-1] == pytest.approx(-ahead[0], abs=1e-5)


def test_samples_are_those_of_the_planner(printed):
    m, launch = printed.motion, printed.launch.phases["launch"]
    down = int((~m["flying"]).sum())
    assert m["t"][down - 1] == m["t"][down] and np.all(np.diff(m["t"])[: down - 1] > 0)
    assert m["t"][-1] - m["t"][down] == pytest.approx(printed.flight.phases["flight"].duration)
    assert len(m["t"]) == len(printed.F_x) == len(printed.F_z) == len(printed.tau_y) == len(m["angles"])
    assert not np.any(printed.F_z[down:]) and printed.F_z[down - 1] == pytest.approx(launch.z[-1, 1])
    for name, slope in (("angles", "rates"), ("rates", "accels")):
        steps = (m[slope][1:down] + m[slope][: down - 1]) / 2 * np.diff(m["t"][:down])[:, None]
        np.testing.assert_allclose(np.diff(m[name][:down], axis=0), steps, atol=2e-4)


# violations -----------------------------------------------------------------------------------------------------
def table(plan, robot):
    return {row["name"]: row for row in violations(plan, robot)}


def test_printed_breaks_physics_and_ours_does_not(bhr, printed, ours):
    theirs, mine = table(printed, bhr), table(ours, bhr)
    assert list(theirs) == list(mine)
    assert {name for name, row in theirs.items() if not row["kept"]} >= BROKEN
    assert all(row["kept"] for row in mine.values()), [r for r in mine.values() if not r["kept"]]
    assert theirs["heel up and a moment about the toe"]["amount"] > 100
    assert theirs["moment about the toe, heel up"]["amount"] > 30
    assert theirs["c_z'' at take-off, off -g"]["amount"] > 1


def recount(robot, printed):
    """Per sample of the launch: heel height, force and moment about the toe, CoP from the toe; from Pinocchio alone."""
    model = robot.model
    data, motion = model.createData(), printed.motion
    frame = model.getFrameId(robot.foot.frames[0])
    corners = [np.array([x, 0.0, robot.foot.sole_z]) for x in (robot.foot.heel, robot.foot.toe)]
    heel, force, moment, c_zz = [], [], [], []
    for k in np.flatnonzero(~motion["flying"]):
        q, v, a = pinocchio_state(robot, motion, k)
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        back, toe = (data.oMf[frame].act(c) for c in corners)
        push = data.dhg.linear + np.array([0.0, 0.0, MASS * G])
        lever = toe - data.com[0]
        heel.append(back[2])
        force.append(push[[0, 2]])
        moment.append(data.dhg.angular[1] - (lever[2] * push[0] - lever[0] * push[2]))
        c_zz.append(data.dhg.linear[2] / MASS)
    return np.array(heel), np.array(force), np.array(moment), np.array(c_zz)


def test_counts_are_found_again_by_pinocchio(bhr, printed):
    rows, (heel, force, moment, c_zz) = table(printed, bhr), recount(bhr, printed)
    up = heel > 0.005
    assert int((up & (np.abs(moment) > 5.0)).sum()) == rows["heel up and a moment about the toe"]["amount"]
    assert np.abs(moment[up]).max() == pytest.approx(rows["moment about the toe, heel up"]["amount"], rel=1e-6)
    firm = force[:, 1] > 100.0
    used = np.abs(force[firm, 0]) / force[firm, 1]
    assert used.max() == pytest.approx(rows["friction used"]["amount"], rel=1e-6)
    cop = -moment[firm] / force[firm, 1]
    assert max(cop.max(), 0.0) <= rows["CoP outside the sole"]["amount"] + 1e-9
    assert c_zz[-1] + G == pytest.approx(rows["c_z'' at take-off, off -g"]["amount"] * np.sign(c_zz[-1] + G), rel=1e-6)


def test_touchdown_is_found_again_by_the_expansion(bhr, printed, ours):
    """The samples expand to a tape of the full robot, which has the same length error and counts."""
    tape = expand(printed.motion, bhr, G)
    toe = tape.extra["planar_toe"]
    rows = table(printed, bhr)
    assert abs(toe[-1, 0] - toe[0, 0] - 1.0) == pytest.approx(rows["jump length error"]["amount"], abs=1e-9)
    again = table(SimpleNamespace(task=ours.task, tape=tape), bhr)
    name = "heel up and a moment about the toe"
    assert again[name]["amount"] == pytest.approx(rows[name]["amount"], abs=2)


@pytest.mark.parametrize("name, change", [
    ("pull on the ground", lambda m: m["toe_acceleration"].__setitem__((100, 1), -40.0)),
    ("toe slips", lambda m: m["toe"].__setitem__((100, 0), m["toe"][0, 0] + 0.002)),
    ("sole below the ground", lambda m: m["toe"].__setitem__((100, 1), -0.002)),
    ("joint speed of its limit", lambda m: m["rates"].__setitem__((100, 4), 60.0)),
    ("jump length error", lambda m: m["toe"].__setitem__((-1, 0), m["toe"][-1, 0] + 0.02)),
    ("sole off the surface at touchdown", lambda m: m["toe"].__setitem__((-1, 1), 0.002)),
    ("foot pitch at touchdown", lambda m: m["angles"].__setitem__((-1, 0), 0.02)),
])  # fmt: skip
def test_each_fault_is_named(bhr, ours, name, change):
    """One fault put into a sound motion is found under its own name."""
    motion = planar_motion(ours.tape, bhr)
    change(motion)
    tape = replace(ours.tape, extra={f"planar_{k}": x for k, x in motion.items()})
    assert not table(SimpleNamespace(task=ours.task, tape=tape), bhr)[name]["kept"]


def test_without_flight_nothing_is_kept_there(bhr, printed):
    down = ~printed.motion["flying"]
    motion = {k: x[down] if np.ndim(x) else x for k, x in printed.motion.items()}
    wrench = {k: getattr(printed, k)[down] for k in ("F_x", "F_z", "tau_y")}
    rows = table(replace(printed, flight=None, motion=motion, **wrench), bhr)
    for name in ("jump length error", "drift of L in flight", "force residual, flight", "foot pitch at touchdown"):
        assert np.isnan(rows[name]["amount"]) and not rows[name]["kept"]
    assert rows["moment about the toe, heel up"]["amount"] > 30


def test_without_launch_there_is_nothing_to_judge(bhr, ours):
    assert "Some_Status" in refused(violations, PrintedPlan(ours.task, launch_status="Some_Status"), bhr)


def test_a_launch_that_fails_is_a_result(bhr, ours):
    """So few iterations that nothing is found: told by the statuses, not by an error."""
    plan = PrintedWholeBody(bhr, intervals=8, options={"max_iter": 1}).plan(ours.srmp, ours.joints)
    assert plan.launch is None and plan.motion is None
    assert plan.launch_status == "Maximum_Iterations_Exceeded" and plan.flight_status == "not tried"


def test_tracking_harder_helps_but_does_not_cure(bhr, printed, ours):
    """A hundred times the weight on the CoM velocity: nearer to stage 1, still with a moment under a raised heel."""
    weights = replace(Weights(), track_velocity=100 * Weights().track_velocity)
    rows = table(PrintedWholeBody(bhr, weights).plan(ours.srmp, ours.joints), bhr)
    before = table(printed, bhr)
    assert rows["c_z'' at take-off, off -g"]["amount"] < before["c_z'' at take-off, off -g"]["amount"]
    assert not rows["heel up and a moment about the toe"]["kept"]
    assert not rows["c_z'' at take-off, off -g"]["kept"]
