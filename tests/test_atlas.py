"""An atlas of plans: what it answers costs hardly more than a solve, is as sound, and it says what it is not for."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from jumplab.auditing import audit
from jumplab.errors import InputError
from jumplab.robot import Robot
from jumplab.robot.stance import configuration, stance_angles
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import WholeBodyPlanner
from jumplab.stages.whole_body.planner import IPOPT
from jumplab.studies.atlas import Atlas, Node, key_of
from jumplab.studies.envelope import envelope
from jumplab.task import JumpTask

DISTANCES, HEIGHTS = (0.5, 0.7, 0.9), (0.3, 0.45)


@cache
def atlas() -> Atlas:
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
    assert all(0.3 < n.share <= 1.0 and n.limiting for n in atlas().nodes.values())
    assert repr(atlas()) == "Atlas(bhr, 0.5 ... 0.9 m far, 0.3 ... 0.45 m high, 6 of 6 planned)"


@pytest.mark.parametrize("place", [(0.6, 0.37), (0.83, 0.41), (0.52, 0.3)])
def test_a_target_between_nodes_is_a_few_steps_away(place):
    task = JumpTask(*place)
    plan = planner().plan(task, "direct")
    cold = planner().program().plan(task)
    s, most = plan.whole_body.solution.statistics, IPOPT["acceptable_constr_viol_tol"]
    assert [x.start for x in plan.attempts] == ["neighbour"] and s.residual <= most
    assert 2 * s.iterations <= sum(x.iterations for x in cold.attempts)
    assert audit(plan.tape, plan.robot, task).passed
    assert plan.planned_distance_m == pytest.approx(task.distance_m, abs=1e-3)
    best = optimum(task, plan)
    # rows may be missed by so little that the cost is a hundred-thousandth less
    assert best * (1 - 5e-5) <= s.objective <= 1.002 * best


def test_at_a_node_it_is_the_node():
    task = JumpTask(0.7, 0.45)
    plan = planner().plan(task, "direct")
    assert plan.whole_body.solution.statistics.objective == pytest.approx(atlas().nodes[0.7, 0.45].cost, rel=1e-3)


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


@pytest.mark.parametrize("task, sentence", [
    (JumpTask(1.2, 0.4), "distance = 1.2 m: the atlas goes from 0.5 to 0.9 m; its nearest plan is 0.9 m far and 0.45 m "
                         "high, where {} is used by {:.0f} %"),
    (JumpTask(0.5, 0.1), "height = 0.1 m: the atlas goes from 0.3 to 0.45 m; its nearest plan is 0.5 m far and 0.3 m "
                         "high, where {} is used by {:.0f} %"),
])  # fmt: skip
def test_outside_it_says_what_limits_there(task, sentence):
    place = (0.9, 0.45) if task.distance_m > 1 else (0.5, 0.3)
    node = atlas().nodes[place]
    assert atlas().beyond(task) == sentence.format(node.limiting, 100 * node.share)
    assert atlas().starts(task) == []
    assert planner().plan(task, "direct").whole_body.began("schedule")


@pytest.mark.parametrize("other", [{"platform_m": 0.2}, {"rotation_rad": 2 * np.pi}, {"gravity": 3.7}, {"side_m": 0.1}])
def test_other_kinds_of_jumps_are_not_its_business(other):
    assert atlas().starts(replace(JumpTask(0.6, 0.4), **other)) == []


def test_refusals():
    with pytest.raises(InputError) as e:
        planner().plan(JumpTask(0.6, 0.4), "three-step")
    assert str(e.value) == "method 'three-step': an atlas holds direct plans; choose 'direct', or leave it away"
    with pytest.raises(InputError) as e:
        Planner(Robot.load(), limits={"torque_share": 0.8}, atlas=atlas()).plan(JumpTask(0.6, 0.4), "direct")
    assert str(e.value) == (
        "the atlas is of robot bhr with other limits, terms or mesh than this planner of bhr; build one for it, or "
        "leave the atlas away"
    )
    with pytest.raises(InputError, match=r"^the distances of an atlas must be rising, at least one; got 2 values$"):
        Atlas.build(Robot.load(), (0.5, 0.4), HEIGHTS)
    with pytest.raises(InputError, match=r"^the atlas has 60 x 60 nodes, at most 2500$"):
        Atlas.build(Robot.load(), np.linspace(0, 1, 60), np.linspace(0.1, 0.5, 60))


def test_file_comes_back_and_goes_on(tmp_path, monkeypatch):
    atlas().save(tmp_path)
    again = Atlas.load(tmp_path)
    assert (again.key, again.distances, again.heights) == (atlas().key, DISTANCES, HEIGHTS)
    for place, node in atlas().nodes.items():
        np.testing.assert_array_equal(again.nodes[place].x, node.x)
        assert replace(again.nodes[place], x=None) == replace(node, x=None)
    from jumplab.studies import atlas as module

    monkeypatch.setattr(module, "_plan_row", lambda *_: pytest.fail("planned again"))
    assert len(Atlas.build(Robot.load(), DISTANCES, HEIGHTS, folder=tmp_path).nodes) == 6
    half = Atlas("bhr", DISTANCES, HEIGHTS, {p: n for p, n in atlas().nodes.items() if p[1] == 0.3}, atlas().key)
    half.save(tmp_path, done=[0.3])
    asked = []
    row = [n for p, n in atlas().nodes.items() if p[1] == 0.45]
    monkeypatch.setattr(module, "_plan_row", lambda _, height, __: (asked.append(height), (height, row))[1])
    assert len(Atlas.build(Robot.load(), DISTANCES, HEIGHTS, folder=tmp_path).nodes) == 6 and asked == [0.45]


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
    with pytest.raises(InputError) as e:
        Atlas.load(tmp_path)
    assert str(e.value).startswith(f"{str(path)!r} is damaged or no atlas (")
    assert str(e.value).endswith("); delete it and build it again")


def test_files_of_something_else_are_refused(tmp_path):
    with pytest.raises(InputError) as e:
        Atlas.load(tmp_path)
    assert str(e.value) == f"{str(tmp_path)!r} has no atlas.npz; build one with 'jumplab atlas'"
    path = atlas().save(tmp_path)
    with pytest.raises(InputError) as e:
        Atlas.build(Robot.load(), DISTANCES, (0.3, 0.4), folder=tmp_path)
    assert str(e.value) == f"{str(path)!r} has another grid of distances and heights; choose another folder"
    with pytest.raises(InputError, match=r"with other limits, terms or mesh, not of this bhr; choose another folder$"):
        Atlas.build(Robot.load(), DISTANCES, HEIGHTS, folder=tmp_path, limits={"torque_share": 0.8})


def test_key_follows_weights_and_own_terms():
    plain = key_of(planner().program())
    assert plain == atlas().key == key_of(Planner(Robot.load()).program())
    for how in (
        {"weights": {"whole body/torque": 2.0}},
        {"off": ["whole body/clearance of left sole"]},
        {"mesh": {"flight": 24}},
    ):
        assert key_of(Planner(Robot.load(), **how).program()) != plain


def test_a_cheaper_neighbour_replaces_a_dear_node():
    dear = replace(atlas().nodes[0.7, 0.45], cost=2 * atlas().nodes[0.7, 0.45].cost)
    other = Atlas("bhr", DISTANCES, HEIGHTS, {**atlas().nodes, (0.7, 0.45): dear}, atlas().key)
    assert other._swept(planner().program()) == 1
    assert isinstance(other.nodes[0.7, 0.45], Node)
    assert other.nodes[0.7, 0.45].cost == pytest.approx(atlas().nodes[0.7, 0.45].cost, rel=0.01)


def test_a_map_begins_with_an_atlas():
    one, (cell,) = atlas(), envelope(Robot.load(), (0.55,), (0.35,), atlas=atlas()).cells
    (cold,) = envelope(Robot.load(), (0.55,), (0.35,)).cells
    assert cell.solved and 0 < 2 * cell.iterations <= cold.iterations and 0.3 < cell.share <= 1.0
    other = Robot.load().with_mass("trunk", factor=1.1)
    with pytest.raises(InputError, match="the atlas is of robot bhr with other limits, terms or mesh"):
        envelope(other, (0.55,), (0.35,), atlas=one)
