"""Chained jumps: what is refused before any solve, what enters a plan, and chains that stand, wait, and fail."""

import json
import re
from functools import cache

import numpy as np
import pytest
from matplotlib.text import Text

from jumplab import __main__ as cli
from jumplab import store
from jumplab.chains import ChainReport, ChainTrial, Course, Rehearsal, crouched, run_chain, write_chain
from jumplab.chains.foresight import Ahead, Foresight
from jumplab.chains.posture import CROUCH, Gauge
from jumplab.errors import InfeasibleError, InputError, SolverError
from jumplab.pipeline import Planner
from jumplab.plotting import chains as pictures
from jumplab.plotting.style import MIN_FONT_PT, PAGE_IN
from jumplab.robot import Robot, load_robot
from jumplab.robot.stance import configuration, stance_angles, stance_configuration
from jumplab.simulation import SLIGHT, Perturbation
from jumplab.task import JumpTask


@cache
def waiting() -> Robot:
    """The default robot in its crouch."""
    return crouched(load_robot())


@cache
def planner() -> Planner:
    return Planner(waiting())


@cache
def rehearsal() -> Rehearsal:
    return Rehearsal.of(Course.of([0.6, 0.6], 0.3), planner())


@cache
def chain(solve_s: float = 0.2, seed: int | None = None):
    """Two jumps of 0.6 m, planning charged with a given time."""
    drawn = None if seed is None else Perturbation.draw(load_robot(), seed, SLIGHT)
    return run_chain(Course.of([0.6, 0.6], 0.3), load_robot(), planner=planner(), rehearsal=rehearsal(),
                     solve_s=solve_s, perturbation=drawn)  # fmt: skip


# ------------------------------------------------------------------------------------------ courses


def test_course_of_numbers():
    course = Course.of(["0.6", 0.5, 0.4], "0.3", [0, 0.2, 0.1])
    assert course.count == 3 and course.heights_m == (0.3, 0.3, 0.3)
    assert course.goals_m == pytest.approx((0.6, 1.1, 1.5))
    assert [course.task(k).platform_m for k in range(3)] == pytest.approx([0.0, 0.2, -0.1])
    assert course.task(1, 0.55) == JumpTask(0.55, 0.3, 0.2)
    assert Course.of([0.6, 0.5], [0.3, 0.4]).heights_m == (0.3, 0.4)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (([], 0.3), "a chain has 1 ... 50 jumps, this one has 0; give one distance per jump"),
        (([0.1] * 51, 0.3), "a chain has 1 ... 50 jumps, this one has 51; give one distance per jump"),
        (([0.6, 0.6], [0.3, 0.3, 0.3]), "3 heights for 2 distances: give one per jump"),
        (([0.6, 0.6], 0.3, [0.1]), "1 platforms for 2 distances: give one per jump"),
        (([0.6, "far"], 0.3), "the distances of a chain must be numbers in m; number 2 is 'far'"),
        (([0.6, True], 0.3), "the distances of a chain must be numbers in m; number 2 is True"),
        (([0.6, None], 0.3), "the distances of a chain must be numbers in m; number 2 is None"),
        (("0.6", 0.3), "the distances of a chain must be a list of numbers, got '0.6'"),
        ((None, 0.3), "the distances of a chain must be a list of numbers, got None"),
        (([0.6], "high"), "the heights of a chain must be numbers in m; number 1 is 'high'"),
        (([0.6, float("nan")], 0.3), "jump 2 of 2: distance must be finite, got nan"),
        (([0.6, 7], 0.3), "jump 2 of 2: distance = 7 m is outside -3 ... 3 m"),
        (([0.6], 0.0), "jump 1 of 1: height = 0 m is outside 0.02 ... 1.5 m"),
        (([0.6, 0.6], 0.3, [0.8, -0.8]), "jump 2 of 2: platform = -1.6 m is outside -1 ... 1 m"),
    ],
)
def test_courses_that_cannot_be_meant(arguments, sentence):
    with pytest.raises(InputError) as e:
        Course.of(*arguments)
    assert str(e.value) == sentence


@pytest.mark.parametrize(
    ("arguments", "kind", "sentence"),
    [
        (
            ([0.6, 0.25], 0.3, [0.0, 0.2]), InputError,
            "jump 2 of 2: the surface 0.2 m high would begin under the sole that stands 0.25 m before it; place them "
            "0.34 m apart or more, toe to toe",
        ),
        (
            ([0.6, 0.2, 0.5], 0.3, [0.2, 0.1, 0.1]), InputError,
            "jump 2 of 3: the surface down at 0.1 m would begin under the sole that stands 0.2 m before it; place them "
            "0.34 m apart or more, toe to toe",
        ),
        (
            ([0.6, -0.6], 0.3, [0.2, 0.2]), InputError,
            "jump 2 of 2: -0.6 m goes back over the platforms; chains with platforms go forward, backward jumps stay "
            "on the level",
        ),
        (([0.6, 2.9], 0.3), InfeasibleError, "jump 2 of 2: distance"),
        (([0.6, 0.6], [0.3, 1.4]), InfeasibleError, "jump 2 of 2: height"),
        (([0.6, 0.6], 0.1, [0.0, 0.5]), InfeasibleError, "jump 2 of 2: platform"),
    ],
)  # fmt: skip
def test_impossible_chains_are_refused_before_any_solve(monkeypatch, arguments, kind, sentence):
    """Neither a planner's stage but the reach nor the simulation is asked."""
    monkeypatch.setattr(Planner, "plan", lambda *a, **k: pytest.fail("a jump was planned"))
    with pytest.raises(kind) as e:
        run_chain(Course.of(*arguments), load_robot(), planner=planner())
    assert str(e.value).startswith(sentence) and "\n" not in str(e.value)


def test_jump_without_a_plan_is_named_before_anything_moves(monkeypatch):
    def fail(task, method):
        raise SolverError("stage 1: no plan")

    monkeypatch.setattr(planner(), "plan", fail)
    with pytest.raises(InfeasibleError, match=r"^jump 1 of 1: stage 1: no plan$"):
        run_chain(Course.of([0.55], 0.3), load_robot(), planner=planner())


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"solve_s": -0.1}, "solve_s = -0.1 s is outside 0 ... 60 s"),
        ({"solve_s": float("nan")}, "solve_s = nan s is outside 0 ... 60 s"),
        ({"look_s": 5.0}, "look_s = 5.0 s is outside -1 ... 2 s"),
        ({"look_s": "soon"}, "look_s = 'soon' s is outside -1 ... 2 s"),
        ({"method": "magic"}, "method 'magic': choose one of three-step, direct"),
        ({"landing": "soft"}, "landing 'soft': choose one of planned, spring"),
        ({"revise_s": 3}, "revise_s = 3 s is outside 0 ... 2 s"),
    ],
)
def test_settings_that_make_no_sense(arguments, sentence):
    with pytest.raises(InputError) as e:
        run_chain(Course.of([0.6], 0.3), load_robot(), planner=planner(), **arguments)
    assert str(e.value) == sentence


def test_planner_of_another_posture_is_refused():
    with pytest.raises(InputError, match=r"make it for crouched\(robot\)$"):
        run_chain(Course.of([0.6], 0.3), load_robot(), planner=Planner(load_robot()))


def test_scene_of_platforms(bhr):
    """Every landing sole, and every sole before a step, has ground of its own level under it, 5 cm beyond its ends."""
    course = Course.of([0.6, 0.5, 0.7, 0.6], 0.3, [0.0, 0.2, 0.2, 0.05])
    scene, foot = course.scene(bhr), bhr.foot
    zero, length = foot.toe - foot.center[0], foot.toe - foot.heel
    for place, level in zip((0.0, *course.goals_m), (0.0, *course.platforms_m), strict=True):
        for x in (place + 0.049, place - length - 0.049):
            assert scene.top_at(zero + x) == level, (place, x)
    (up, high), (down, low) = course.edges(bhr)
    assert (up, high, down, low) == pytest.approx((0.6 + 0.5 - length - 0.05, 0.2, 1.8 + 0.05, 0.05))
    assert Course.of([0.6, -0.3], 0.3).scene(bhr).name == "flat"


# ------------------------------------------------------------------------------------------ postures


def test_crouch_is_a_stance_of_the_same_robot(bhr):
    other = crouched(bhr)
    assert {key: other.stance[key] for key in CROUCH} == CROUCH and other.stance["shoulder_rad"] == 0.0
    assert other.urdf == bhr.urdf and other.hash != bhr.hash and crouched(other).hash == other.hash


def test_robot_that_cannot_crouch_keeps_its_stance(bhr, monkeypatch):
    from jumplab.chains import posture

    monkeypatch.setattr(posture, "CROUCH", {"knee_rad": 3.0, "trunk_pitch_rad": 0.2})
    assert crouched(bhr) is bhr


def test_gauge_reads_what_a_configuration_was_made_of(bhr):
    gauge, angles = Gauge(bhr), stance_angles(bhr) + np.array([0.0, 0.1, -0.2, 0.15, 0.3])
    q = configuration(bhr, angles, toe=(0.7, 0.2))
    assert gauge.posture(q) == pytest.approx(angles, abs=1e-12)
    assert gauge.toe(q)[[0, 2]] == pytest.approx([0.7, 0.2], abs=1e-12)
    v = np.zeros(bhr.model.nv)
    v[0] = 2.0  # in the base's axes, which are pitched
    speed = gauge.com_velocity(q, v)
    assert np.linalg.norm(speed) == pytest.approx(2.0)
    assert gauge.com_ahead(q, v, 0.5) == pytest.approx(gauge.com(q) + 0.5 * speed - [0, 0, 9.8 * 0.125])


def test_a_plan_begins_in_the_posture_it_is_given(bhr):
    """Cold and warm, in every stage; the tape starts at rest there, and its distance is kept."""
    start = stance_angles(waiting()) + np.array([0.0, 0.02, -0.03, 0.01, 0.05])
    task = JumpTask(0.6, 0.3)
    for plan in (planner().plan(task, start=start), planner().replan(rehearsal().plans[0], task, start=start),
                 planner().plan(task, "direct", start=start)):  # fmt: skip
        assert Gauge(waiting()).posture(plan.tape.q[0]) == pytest.approx(start, abs=1e-6), plan.method
        assert np.abs(plan.tape.v[0]).max() < 1e-6
        assert plan.planned_distance_m == pytest.approx(0.6, abs=1e-4)
    with pytest.raises(InputError, match="a flip begins in the stance"):
        planner().plan(JumpTask(0.0, 0.5, rotation_rad=-2 * np.pi), start=start)


# ------------------------------------------------------------------------------------------ foresight


class Echo:
    """Stands in for a planner: its plan is what it was asked."""

    def __init__(self):
        self.asked = []

    def stage(self, name):
        return type("Stage", (), {"stance": np.zeros(5)})

    def plan(self, task, method, start):
        self.asked.append((task, start))
        return type("Plan", (), {"task": task})


def test_what_is_measured_enters_the_next_plan(bhr):
    """Foot place, shortfall, and what forecasts were wrong by, each with the number that arithmetic gives."""
    echo = Echo()
    see = Foresight(Course.of([0.6, 0.6, 0.6], 0.3), bhr, echo, None, solve_s=0.1234)
    first = see.look(0, 0.5, np.array([0.12, 0.0, 0.0]))
    assert echo.asked[-1][0].distance_m == pytest.approx(0.6) and first.solve_s == pytest.approx(0.124)
    assert first.ready_s == pytest.approx(0.624) and not first.air
    # in the air, 0.57 m are foretold: 3 cm short, to be made good and to be expected again
    second = see.look(1, 1.5, np.array([0.69, 0.0, 0.0]), True, (first, 0.12))
    assert echo.asked[-1][0].distance_m == pytest.approx(1.2 - 0.57 + 0.03)
    # it stands at 0.56 m: the forecast was 1 cm too far, and the jump 4 cm short
    see.learn_place(first, 0.12, [second], np.array([0.68, 0.0, 0.0]))
    third = see.look(2, 3.0, np.array([1.33, 0.0, 0.0]), True, (second, 0.68))
    foretold, place = 1.33 - 0.12, 1.33 - 0.12 - 0.01
    assert (third.foretold_m, third.place_m) == pytest.approx((foretold, place))
    missed = [0.04, 0.66 - (place - 0.56)]
    assert echo.asked[-1][0].distance_m == pytest.approx(1.8 - place + np.mean(missed))


def test_posture_off_the_crouch_enters_within_reason(bhr):
    see = Foresight(Course.of([0.6], 0.3), bhr, echo := Echo(), None)
    q = configuration(bhr, np.array([0.0, 0.02, -0.03, 0.5, 0.04]))
    see.learn_posture(q)
    see.look(0, 0.5, np.zeros(3))
    assert echo.asked[0][1] == pytest.approx([0.0, 0.02, -0.03, 0.1, 0.04])


def test_a_failure_of_the_planner_is_kept_as_words(bhr):
    class Refusing(Echo):
        def plan(self, task, method, start):
            raise SolverError("no plan today")

    ahead = Foresight(Course.of([0.6], 0.3), bhr, Refusing(), None).look(0, 0.5, np.zeros(3))
    assert ahead.plan is None and ahead.failure == "no plan today" and not ahead.in_time


def test_in_time_means_before_it_was_needed():
    def plan(needed):
        return Ahead(1, 2.0, True, 0.6, 0.6, np.zeros(5), np.zeros(14), 0.0, 0.5, 0.5, object(), needed_s=needed)

    assert plan(2.5).in_time and not plan(2.499).in_time and not plan(None).in_time


# ------------------------------------------------------------------------------------------ in the simulation


@pytest.mark.slow
def test_a_chain_stands_and_hits():
    result = chain()
    assert result.stood, result.reason
    assert np.abs(result.errors_m).max() < 0.01
    assert result.travels_m.sum() == pytest.approx(result.places_m[-1, 0])
    assert len(result.replans) == 2 == result.in_time and result.jumps[1].ahead is result.replans[-1]
    (ahead, revised), first = result.jumps[1].plans, result.jumps[0]
    # planned in the air: after lift-off and before touchdown of the first jump, for where that came down
    assert first.simulation.metrics.liftoff_s < ahead.looked_s < first.simulation.metrics.touchdown_s
    assert ahead.air and ahead.place_m == pytest.approx(result.places_m[1, 0], abs=0.01)
    assert ahead.ready_s == pytest.approx(ahead.looked_s + 0.2) and ahead.began_s is None
    # and again from where the feet stand: 0.1 s after touchdown, begun as soon as the robot was still enough
    assert revised.looked_s - first.simulation.metrics.touchdown_s == pytest.approx(0.1, abs=0.01)
    assert not revised.air and revised.place_m == pytest.approx(result.places_m[1, 0], abs=0.002)
    assert revised.began_s == revised.needed_s > revised.ready_s > ahead.ready_s


@pytest.mark.slow
def test_nothing_is_reset_between_jumps():
    """The log goes on from jump to jump as the engine's own step has it, and every part passes the honesty checks."""
    result = chain()
    assert all(j.simulation.honest for j in result.jumps)
    assert np.all(np.diff(result.t) > 0) and result.t[1] == pytest.approx(0.001)
    seam = len(result.jumps[0].simulation.t)
    assert result.jumps[1].start_s == pytest.approx(result.t[seam])
    assert np.abs(np.diff(result.q[:, 7:], axis=0)[seam - 1]).max() < 0.02  # [rad] in one millisecond
    assert result.com[seam] - result.com[seam - 1] == pytest.approx(np.zeros(3), abs=1e-3)


@pytest.mark.slow
def test_a_late_plan_is_waited_for_in_the_crouch():
    """Charged two seconds, the plan is late: the robot holds its crouch, then jumps as well as before."""
    late = chain(2.0)
    ahead = late.jumps[1].ahead
    assert late.stood and late.in_time == 0 and not ahead.in_time
    assert ahead.air and late.jumps[1].plans == (ahead,)  # a correction would have come later still
    assert ahead.ready_s > ahead.needed_s + 0.5
    assert ahead.began_s == pytest.approx(ahead.ready_s, abs=2e-3)
    assert late.waits_s == pytest.approx([ahead.ready_s - ahead.needed_s], abs=2e-3) and chain().waits_s == (0.0,)
    assert np.abs(late.errors_m).max() < 0.01
    held = late.jumps[0].simulation
    still = held.com_velocity[-200:]
    assert np.abs(still).max() < 0.05 and held.com[-1, 2] == pytest.approx(
        Gauge(waiting()).com(stance_configuration(waiting()))[2], abs=0.02)  # fmt: skip


@pytest.mark.slow
def test_a_chain_made_twice_is_the_same(tmp_path):
    a = chain(0.2, 3)
    b = run_chain(a.course, load_robot(), planner=planner(), rehearsal=rehearsal(), solve_s=0.2,
                  perturbation=Perturbation.draw(load_robot(), 3, SLIGHT))  # fmt: skip
    assert np.array_equal(a.q, b.q) and np.array_equal(a.tau, b.tau)
    assert a.stood and np.abs(a.errors_m).max() < 0.03


@pytest.mark.slow
def test_a_plan_that_does_not_come_ends_the_chain(monkeypatch):
    def fail(previous, task, start):
        raise SolverError("no plan today")

    monkeypatch.setattr(planner(), "replan", fail)
    result = run_chain(Course.of([0.6], 0.3), load_robot(), planner=planner(), rehearsal=rehearsal(), solve_s=0.0)
    assert not result.stood and result.reason == "no plan for jump 1: no plan today"


@pytest.mark.slow
def test_folder_is_whole_and_replaced_as_a_whole(tmp_path, odd_folder):
    result, out = chain(), odd_folder / "chain"
    audits = write_chain(out, result, {"chain.html": "<p>"})
    assert len(audits) == 2 and all(c.passed for a in audits for c in a.checks)
    write_chain(out, result)
    assert sorted(p.name for p in out.iterdir()) == ["chain.html", "chain.json", "chain.npz", "jumps"]
    tape, robot, summary = store.read_plan(out / "jumps" / "2")
    assert (
        robot.hash == waiting().hash and summary["target"]["distance_m"] == result.jumps[1].ahead.plan.task.distance_m
    )
    data = json.loads((out / "chain.json").read_text())
    assert data["stood"] is True and len(data["jumps"]) == 2 and data["jumps"][1]["in_time"] is True
    with np.load(out / "chain.npz") as log:
        assert np.array_equal(log["q"], result.q) and set(log["jump"]) == {0, 1}
    assert len(tape.t) == len(result.jumps[1].ahead.plan.tape.t)


@pytest.mark.slow
def test_report_of_many_counts_what_the_chains_say():
    trial, late = ChainTrial.of(3, chain()), ChainTrial.of(4, chain(2.0))
    report = ChainReport(chain().course, (trial, late, ChainTrial(5, False, "fell")))
    assert (report.stood, report.replans, report.in_time) == (2, 3, 2)
    assert len(report.errors_m) == 4 and list(report.waits_s <= 0) == [True, False]
    low, high = report.interval
    assert 0.2 < low < 2 / 3 < high < 0.95
    data = json.loads(store.to_json(report.to_json()))
    assert data["begun_without_waiting"] == 1 and data["trials"][2]["reason"] == "fell"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chain_strobe", "chain_path", "chain_timeline", "chain_errors"])
@pytest.mark.parametrize("solve_s", [0.2, 2.0])
def test_figures_are_legible_in_print(name, solve_s):
    result, more = chain(solve_s), ()
    if name == "chain_errors":
        more = ((ChainTrial.of(0, result),),)
    fig = getattr(pictures, name)(result, *more)
    fig.canvas.draw()
    texts = [t for t in fig.findobj(Text) if t.get_text().strip() and t.get_visible()]
    assert fig.get_size_inches()[0] == PAGE_IN and min(t.get_fontsize() for t in texts) >= MIN_FONT_PT
    assert not [t for ax in fig.axes for t in (ax.get_xlabel(), ax.get_ylabel()) if t and t != "jump" and "[" not in t]


# ------------------------------------------------------------------------------------------ the command line

HELP = "'jumplab chain --help' shows what is possible"


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        ("--out x", 2, f"the following arguments are required: --distances-m; {HELP}"),
        ("--distances-m --out x", 2, f"argument --distances-m: expected at least one argument; {HELP}"),
        ("--distances-m 0.6 far --out x", 2, "--distances-m must be a number, got 'far'"),
        ("--distances-m 0.6 --height-m tall --out x", 2, "--height-m must be a number, got 'tall'"),
        ("--distances-m 0.6 0.6 --platforms-m 0.1 --out x", 2, "1 platforms for 2 distances: give one per jump"),
        ("--distances-m 0.6 --seed -1 --out x", 2, "--seed must be a whole number from 0 to 2147483647, got '-1'"),
        ("--distances-m 0.6 --runs 1.5 --out x", 2, "--runs must be a whole number from 1 to 10000, got '1.5'"),
        ("--distances-m 0.6 --solve-s -1 --out x", 2, "solve_s = -1.0 s is outside 0 ... 60 s"),
        ("--distances-m 0.6 0.2 --platforms-m 0 0.1 --out x", 2,
         "jump 2 of 2: the surface 0.1 m high would begin under the sole that stands 0.2 m before it; place them "
         "0.34 m apart or more, toe to toe"),
        ("--distances-m 0.6 2.9 --out x", 3, "jump 2 of 2: distance = 2.9 m"),
    ],
)  # fmt: skip
def test_refusals_of_the_command(capsys, tmp_path, monkeypatch, arguments, code, sentence):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["chain", *arguments.split()]) == code
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"jumplab: {sentence}") and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_command_tells_jump_by_jump(capsys, tmp_path):
    out = tmp_path / "chain"
    code = cli.main(["chain", "--distances-m", "0.5", "--solve-s", "0.2", "--seed", "4", "--out", str(out)])
    told, err = capsys.readouterr()
    assert code == 0, err
    assert re.search(r"^1 +0\.500 m +0\.500 m +0\.\d{3} m +-?0\.0\d\d m +0\.4\d\d s +0\.200 s", told, re.M), told
    assert "chain: stands after every jump" in told and "checks of 1 plans passed" in told
    assert "A chain of jumps" in (out / "chain.html").read_text(encoding="utf-8")
