"""An atlas of plans: what it answers costs hardly more than a solve, is as sound, and it says what it is not for."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fixtures_core import refused

from jumplab.auditing import audit
from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.robot.stance import configuration, stance_angles
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import WholeBodyPlanner
from jumplab.stages.whole_body.starts import NEAR
from jumplab.studies.atlas import Atlas, key_of_plans
from jumplab.studies.atlas import node_row as row_of
from jumplab.studies.envelope import envelope
from jumplab.task import JumpTask

DISTANCES, HEIGHTS = (0.5, 0.7, 0.9), (0.3, 0.45)


ROWS = {}  # of the nodes, by their targets


def remembered(planner: Planner, task: JumpTask) -> dict:
    ROWS[task] = ROWS.get(task) or row_of(planner, task)
    return ROWS[task]


@cache
def atlas() -> Atlas:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jumplab.studies.atlas.node_row", remembered)
        return Atlas.build(Robot.load(), DISTANCES, HEIGHTS)


@cache
def planner() -> Planner:
    return Planner(Robot.load(), atlas=atlas())


def optimum(task: JumpTask, plan) -> float:
    """Cost of the least dear motion close to a plan: solved on until nothing changes any more."""
    body = planner().program()
    last = {"acceptable_iter": 50, "acceptable_obj_change_tol": 1e-9}
    patient = WholeBodyPlanner(body.robot, body=body.body, free=body.free, options=last)
    return patient.plan(task, near=plan.whole_body).solution.statistics.objective


def test_every_node_has_a_plan():
    assert sorted(atlas().nodes) == [(d, h) for d in DISTANCES for h in HEIGHTS]
    assert repr(atlas()) == "Atlas(bhr, 0.5 ... 0.9 m far, 0.3 ... 0.45 m high, 6 of 6 planned)"


@pytest.mark.parametrize("place", [(0.6, 0.37), (0.7, 0.45)])
def test_a_target_between_nodes_is_a_few_steps_away(place):
    task = JumpTask(*place)
    plan = planner().plan(task, "direct")
    cold = planner().stage("direct").plan(task)
    s, most = plan.whole_body.solution.statistics, NEAR["acceptable_constr_viol_tol"]
    assert [x.start for x in plan.attempts] == ["neighbour"] and s.residual <= most
    assert 2 * s.iterations <= sum(x.iterations for x in cold.attempts)
    assert audit(plan.tape, plan.robot, task).passed
    assert plan.planned_distance_m == pytest.approx(task.distance_m, abs=1e-3)
    best = optimum(task, plan)
    # rows may be missed by so little that the cost is a hundred-thousandth less
    assert best * (1 - 5e-5) <= s.objective <= 1.002 * best


def test_a_jump_begins_in_the_posture_that_is_asked_for():
    robot, task = Robot.load(), JumpTask(0.6, 0.35)
    start = stance_angles(robot) + np.array([0.0, 0.02, -0.02, 0.03, 0.0])
    plan = planner().plan(task, "direct", start=start)
    assert [x.start for x in plan.attempts] == ["neighbour"]
    np.testing.assert_allclose(plan.tape.q[0, 7:], configuration(robot, start)[7:], atol=1e-6)


def test_four_nodes_are_blended_by_their_distance():
    blend, nearest = atlas().starts(JumpTask(0.6, 0.3 + 0.15 / 4))
    shares = {(0.5, 0.3): 0.375, (0.7, 0.3): 0.375, (0.5, 0.45): 0.125, (0.7, 0.45): 0.125}
    wanted = sum(s * atlas().nodes[p].x for p, s in shares.items())
    np.testing.assert_allclose(blend.x, wanted, atol=1e-12)
    assert (nearest.distance_m, nearest.height_m) == (0.5, 0.3)


@pytest.mark.parametrize("task", [JumpTask(1.2, 0.4), JumpTask(0.5, 0.1)])
def test_outside_a_plan_begins_without_it(task):
    assert atlas().starts(task) == []
    assert planner().plan(task, "direct").whole_body.start == "schedule"


@pytest.mark.parametrize("other", [{"platform_m": 0.2}, {"rotation_rad": 2 * np.pi}, {"gravity": 3.7}, {"side_m": 0.1}])
def test_other_kinds_of_jumps_are_not_its_business(other):
    assert atlas().starts(replace(JumpTask(0.6, 0.4), **other)) == []


def test_refusals():
    said = refused(planner().plan, JumpTask(0.6, 0.4), "three-step")
    assert said == "method 'three-step': an atlas holds direct plans only; choose 'direct', or leave out the atlas"
    other = Planner(Robot.load(), limits={"torque_share": 0.8}, atlas=atlas())
    assert refused(other.plan, JumpTask(0.6, 0.4), "direct") == (
        "the atlas of robot bhr does not fit this planner of bhr: robot, limits, terms or mesh differ; build an atlas "
        "for this planner, or leave it out"
    )
    with pytest.raises(InputError, match=r"^the distances of an atlas must be one or more .*, got \(0\.5, 0\.4\)$"):
        Atlas.build(Robot.load(), (0.5, 0.4), HEIGHTS)
    with pytest.raises(InputError, match=r"^the atlas has 60 x 60 nodes, at most 2500$"):
        Atlas.build(Robot.load(), np.linspace(0, 1, 60), np.linspace(0.1, 0.5, 60))


def test_file_comes_back_and_goes_on(tmp_path, monkeypatch):
    """A finished atlas is read; one that was stopped ends as if it had not been."""
    atlas().save(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("jumplab.studies.atlas.node_row", lambda *_: pytest.fail("planned again"))
        for again in (Atlas.load(tmp_path), Atlas.build(Robot.load(), DISTANCES, HEIGHTS, folder=tmp_path)):
            same(again, atlas())
    stopped, rows = tmp_path / "stopped", []

    def stopping(planner, task):
        if len(rows) == 4:
            raise KeyboardInterrupt
        rows.append(remembered(planner, task))
        return rows[-1]

    monkeypatch.setattr("jumplab.studies.atlas.node_row", stopping)
    with pytest.raises(KeyboardInterrupt):
        Atlas.build(Robot.load(), DISTANCES, HEIGHTS, folder=stopped)
    assert not (stopped / "atlas.npz").exists()
    monkeypatch.setattr("jumplab.studies.atlas.node_row", remembered)
    same(Atlas.build(Robot.load(), DISTANCES, HEIGHTS, folder=stopped), atlas())


def same(a: Atlas, b: Atlas):
    assert (a.key, a.distances, a.heights, a.hash) == (b.key, DISTANCES, HEIGHTS, b.hash)
    for place, node in b.nodes.items():
        np.testing.assert_array_equal(a.nodes[place].x, node.x)
        assert replace(a.nodes[place], x=None) == replace(node, x=None)


@pytest.mark.parametrize("damage", ["cut", "foreign", "nan"])
def test_damaged_files_are_refused(tmp_path, damage):
    path = atlas().save(tmp_path)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:1000])
    elif damage == "foreign":
        np.savez(path, other=np.zeros(3))
    else:
        with np.load(path) as file:
            parts = {name: file[name] for name in file.files}
        parts["rows"][0, 0] = np.nan
        np.savez(path, **parts)
    said = refused(Atlas.load, tmp_path)
    assert said.startswith(f"{str(path)!r} is damaged or no atlas (")
    assert said.endswith("); delete it and build it again")


def test_files_of_something_else_are_refused(tmp_path):
    assert refused(Atlas.load, tmp_path) == f"{str(tmp_path)!r} has no atlas.npz; build one with 'jumplab atlas'"
    path = atlas().save(tmp_path)
    said = refused(Atlas.build, Robot.load(), DISTANCES, (0.3, 0.4), folder=tmp_path)
    assert said == f"{str(path)!r} has another grid of distances and heights; choose another folder"
    with pytest.raises(InputError, match=r"not fit bhr: robot, limits, terms or mesh differ; choose another folder$"):
        Atlas.build(Robot.load(), DISTANCES, HEIGHTS, folder=tmp_path, limits={"torque_share": 0.8})


def test_key_follows_weights_and_own_terms():
    plain = key_of_plans(planner().stage("direct"))
    assert plain == atlas().key == key_of_plans(Planner(Robot.load()).stage("direct"))
    for how in (
        {"weights": {"whole body/torque": 2.0}},
        {"off": ["whole body/clearance of left sole"]},
        {"mesh": {"flight": 24}},
    ):
        assert key_of_plans(Planner(Robot.load(), **how).stage("direct")) != plain


def test_a_map_begins_with_an_atlas():
    one, (cell,) = atlas(), envelope(Robot.load(), (0.55,), (0.35,), atlas=atlas()).cells
    (cold,) = envelope(Robot.load(), (0.55,), (0.35,)).cells
    assert cell.solved and 0 < 2 * cell.iterations <= cold.iterations and 0.3 < cell.share <= 1.0
    other = Robot.load().with_mass("trunk", factor=1.1)
    with pytest.raises(InputError, match="the atlas of robot bhr does not fit this planner of bhr: robot, limits,"):
        envelope(other, (0.55,), (0.35,), atlas=one)
