"""Targets that name the feet of take-off and landing, and the steps of a run-up: schedule, plan, audit, words."""

from dataclasses import replace
from functools import cache

import pytest
from fixtures_core import refused
from test_advice import raised

import jumplab as jl
from jumplab.auditing import audit
from jumplab.cli.main import main
from jumplab.errors import InfeasibleError, InputError
from jumplab.robot.stance import leg_length
from jumplab.sim import Ranges
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body.contacts import LONGER, STEP_SHARE
from jumplab.studies import advice

FLIGHT_S = (0.1, 1.0)
STANDING = "{0}: only a jump from a stand, off both feet and onto both, turns; leave out takeoff, landing and run_up, "
STANDING += "or the {0}"
OFF_THE_LEFT = jl.JumpTask(0.25, 0.06, takeoff="left")


@cache
def hop() -> jl.JumpPlan:
    return jl.plan(OFF_THE_LEFT)


# targets ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"takeoff": "lft"}, "takeoff = 'lft': choose one of left, right, both"),
        ({"takeoff": None}, "takeoff = None: choose one of left, right, both"),
        ({"landing": 1}, "landing = 1: choose one of left, right, both"),
        ({"run_up": -1}, "run_up = -1 must be a whole number of steps, 0 to 30"),
        ({"run_up": 40}, "run_up = 40 must be a whole number of steps, 0 to 30"),
        ({"run_up": 1.5}, "run_up = 1.5 must be a whole number of steps, 0 to 30"),
        ({"run_up": True}, "run_up must be a number, got True"),
        ({"takeoff": "left", "yaw_rad": 1.0}, STANDING.format("yaw")),
        ({"run_up": 1, "rotation_rad": 6.283185307}, STANDING.format("rotation")),
        (
            {"run_up": 2, "distance_m": -0.2},
            "run_up = 2 with a distance of -0.2 m: a run-up goes ahead, so the distance must be 0 or more",
        ),
    ],
)
def test_feet_and_steps_that_cannot_be(asked, sentence):
    assert refused(jl.JumpTask, **{"distance_m": 0.3, "height_m": 0.1, **asked}) == sentence


def test_a_jump_from_a_stand_has_the_numbers_that_it_always_had():
    """Keys of studies and files stay; those of earlier versions are read."""
    stand = jl.JumpTask(0.3, 0.1)
    assert list(stand.numbers) == "distance_m height_m platform_m rotation_rad gravity side_m yaw_rad".split()
    assert stand.standing and jl.JumpTask(**stand.numbers) == stand
    run = jl.JumpTask(0.3, 0.1, takeoff="right", run_up=2.0)
    assert not run.standing and run.run_up == 2 and jl.JumpTask(**run.numbers) == run
    assert run.numbers["takeoff"] == "right" and run.numbers["landing"] == "both"
    for other in ({"takeoff": "left"}, {"landing": "left"}, {"run_up": 1}):
        assert not jl.JumpTask(0.3, 0.1, **other).standing


# schedules ----------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("asked", "letters"),
    [
        ({"takeoff": "left"}, "LR L l - LR"),
        ({"takeoff": "right", "landing": "right"}, "LR R r - R LR"),
        ({"landing": "left"}, "LR lr - L LR"),
        ({"takeoff": "left", "run_up": 2}, "LR L lR R Lr L l - LR"),
        ({"takeoff": "right", "run_up": 2}, "LR R Lr L lR R r - LR"),
        ({"takeoff": "right", "landing": "left", "run_up": 1}, "LR L lR R r - L LR"),
        ({"run_up": 1}, "LR R Lr L LR lr - LR"),
        ({"run_up": 3}, "LR R Lr L lR R Lr L LR lr - LR"),
    ],
)
def test_the_schedule_of_a_target(bhr, asked, letters):
    contacts = jl.Contacts.to(jl.JumpTask(0.3, 0.1, **asked), bhr, FLIGHT_S)
    assert " ".join(p.feet for p in contacts.phases) == letters
    assert contacts.aimed and contacts.phases[contacts.last_flight].time_s == FLIGHT_S
    aimed = [contacts.is_aimed(i) for i in range(len(contacts.landings))]
    assert aimed == [False] * (len(aimed) - 2) + [True] * 2


def test_steps_before_a_target_are_free_but_not_towards_an_edge(bhr):
    step = STEP_SHARE * leg_length(bhr)
    run = jl.JumpTask(0.5, 0.1, takeoff="left", run_up=2)
    contacts = jl.Contacts.to(run, bhr, FLIGHT_S)
    assert [p.ahead_m for p in contacts.places] == pytest.approx([step, (1 + LONGER) * step, 0, 0])
    assert [p.free_m[0] for p in contacts.places[:2]] == pytest.approx([step / 2] * 2)
    assert contacts == jl.Contacts.to(replace(run, distance_m=0.8, height_m=0.2), bhr, FLIGHT_S)
    onto = jl.Contacts.to(replace(run, platform_m=0.1), bhr, FLIGHT_S)
    assert [p.free_m[0] for p in onto.places[:2]] == [0, 0]
    side_by_side = jl.Contacts.to(replace(run, takeoff="both"), bhr, FLIGHT_S).places[:3]
    assert [p.free_m[0] for p in side_by_side] == [0, 0, 0]
    assert side_by_side[1] == side_by_side[2]


# plans --------------------------------------------------------------------------------------------
def test_its_plan_has_what_was_asked():
    plan = hop()
    assert plan.task == OFF_THE_LEFT and plan.schedule == ("LR", "L", "l", "-", "LR")
    assert plan.planned_distance_m == pytest.approx(0.25, abs=1e-3)
    assert plan.planned_rise_m == pytest.approx(0.06, abs=1e-3)
    assert plan.audit.passed, plan.audit.table()
    assert plan.audit["distance"].value < 1 and plan.audit["rise"].value < 1
    assert "off the left" not in plan.line() and "0.25 m far" in plan.line()


@pytest.mark.parametrize(("change", "failed"), [({"distance_m": 0.26}, "distance"), ({"height_m": 0.07}, "rise")])
def test_the_audit_sees_another_distance_and_rise(change, failed):
    plan = hop()
    report = audit(plan.tape, plan.robot, replace(plan.task, **change))
    assert [check.name for check in report.failed] == [failed]


def test_another_target_begins_with_its_plan():
    plan = hop()
    further = Planner(plan.robot).replan(plan, replace(OFF_THE_LEFT, distance_m=0.3))
    assert further.attempts[0].start == "neighbour"
    assert further.planned_distance_m == pytest.approx(0.3, abs=1e-3)


def test_commands_and_folders(tmp_path, capsys):
    out = str(tmp_path / "hop")
    words = ["--distance-m", "0.25", "--height-m", "0.06", "--takeoff", "left"]
    assert main(["plan", *words, "--out", out]) == 0
    again = jl.load(out).plan
    assert again.task == OFF_THE_LEFT and again.schedule == hop().schedule and jl.audit(again).passed
    assert again.summary["target"]["takeoff"] == "left"
    assert main(["plan", "--takeoff", "lft", "--out", out]) == 2
    assert "'lft'" in capsys.readouterr().err
    assert main(["plan", "--run-up", "40", "--out", out]) == 2
    assert "--run-up must be a whole number from 0 to 30, got '40'" in capsys.readouterr().err
    assert main(["plan", "--contacts", "hop", "--run-up", "2", "--out", out]) == 2
    assert "--run-up cannot be used with --contacts" in capsys.readouterr().err
    assert jl.plots.describe_task(replace(OFF_THE_LEFT, run_up=2, landing="right")) == (
        "0.25 m forward, CoM rise 0.06 m, run-up of 2 steps, take-off from the left foot, landing on the right foot"
    )


# refused ------------------------------------------------------------------------------------------
def test_what_only_a_jump_from_a_stand_has(bhr):
    said = "method 'three-step': its stages plan jumps from a stand, off both feet and onto both; "
    said += "choose 'direct', or leave out takeoff, landing and run_up"
    assert refused(jl.plan, OFF_THE_LEFT, method="three-step") == said
    with pytest.raises(InputError, match=r"^starts = 2: only method 'direct' compares several starts, and only in "):
        Planner(bhr).plan(OFF_THE_LEFT, starts=2)
    with pytest.raises(InputError, match=r"^takeoff, landing and run_up: a jump like a clip, or one that allows for "):
        jl.plan(OFF_THE_LEFT, robust=Ranges())


def test_records_after_steps_are_of_rise_and_distance_on_level_ground(bhr):
    run = jl.JumpTask(0.3, 0.1, takeoff="left", run_up=2)
    for what, given in (("platform_m", run), ("distance_m", replace(run, platform_m=0.1))):
        assert refused(jl.record, bhr, what, given) == (
            f"what = {what!r}: after steps, or on one foot, only height_m and distance_m on level ground have a "
            "record; leave out takeoff, landing and run_up"
        )


def test_an_edge_under_the_feet_is_refused_with_the_phase(bhr):
    onto = jl.JumpTask(0.2, 0.3, 0.2, takeoff="left", run_up=1)
    with pytest.raises(InfeasibleError) as e:
        Planner(bhr).plan(onto)
    assert str(e.value).startswith("phase '7 LR': feet come down on a surface 0.2 m higher that would begin ")
    assert e.value.number == "distance_m"
    task = replace(onto, distance_m=e.value.bound)
    assert Planner(bhr).program(task).surface(task).height_m == 0.2


def test_advice_names_the_run_up_that_reaches_the_distance(monkeypatch):
    class Fake:
        """Jumps half a metre from a stand, and a metre with a run-up."""

        robot = jl.Robot.load("bhr")

        def plan(self, task, method="usual", **options):
            if task.distance_m > (1.0 if task.run_up else 0.5):
                raise InfeasibleError("too far")

    monkeypatch.setattr(advice, "refused", lambda planner, task, method: raised(planner.plan, task, method))
    near = "too far; ask for a distance of 0.48 m, which has a plan; or for a run-up of 2 steps (takeoff='left', "
    near += "run_up=2), which reaches 0.8 m"
    far = "too far; ask for a distance of 0.43 m and a height of 0.06 m, which has a plan"
    for distance, words in ((0.8, near), (1.2, far)):
        assert refused(advice.plan_or_advise, Fake(), jl.JumpTask(distance, 0.1), by=InfeasibleError) == words
