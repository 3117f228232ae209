"""Chained jumps in the simulation: chains that stand, wait, and fail, their folder, figures and command."""

import json
import re

import numpy as np
import pytest
from fixtures_chains import chain, planner, rehearsal, waiting
from matplotlib.text import Text
from paper import experiments

from jumplab.cli import main as cli
from jumplab.control.kinematics import Gauge
from jumplab.errors import SolverError
from jumplab.io import folder as store
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.show.style import MIN_FONT_PT, PAGE_IN
from jumplab.sim import SLIGHT, Perturbation
from jumplab.studies.chain import Course, run_chain, series, write_chain

# ------------------------------------------------------------------------------------------ in the simulation


@pytest.mark.slow
def test_a_chain_stands_and_hits_and_made_twice_is_the_same():
    result = chain()
    assert result.stood, result.reason
    again = run_chain(result.course, Robot.load(), planner=planner(), rehearsal=rehearsal(), solve_s=0.2)
    assert np.array_equal(again.q, result.q) and np.array_equal(again.tau, result.tau)
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
def test_a_perturbed_robot_keeps_its_heading_over_three_jumps():
    """Jump by jump it lands a little turned; that must not grow from one to the next."""
    course, robot = Course.of([0.6] * 3, 0.3), Robot.load()
    how = dict(planner=planner(), perturbation=Perturbation.draw(robot, 3, SLIGHT), solve_s=0.2)
    result = run_chain(course, robot, **how)
    assert result.stood, result.reason
    assert np.abs(result.errors_m).max() < 0.01
    ends = [j.simulation.q[-1] for j in result.jumps]
    assert max(abs(Gauge(robot).heading(q)) for q in ends) < np.radians(4)


@pytest.mark.slow
def test_nothing_is_reset_between_jumps():
    """The log goes on from jump to jump as the engine's own step has it, and every part passes the checks of a run."""
    result = chain()
    assert all(j.simulation.checks_passed for j in result.jumps)
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
def test_a_plan_that_does_not_come_ends_the_chain(monkeypatch):
    def fail(previous, task, start):
        raise SolverError("no plan today")

    monkeypatch.setattr(planner(), "replan", fail)
    result = run_chain(Course.of([0.6], 0.3), Robot.load(), planner=planner(), rehearsal=rehearsal(), solve_s=0.0)
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
    good, late, fell = series.row(3, chain()), series.row(4, chain(2.0)), {"seed": 5, "stood": False, "reason": "fell"}
    found = series.counts([good, late, fell | dict.fromkeys(series.PER_JUMP, ())])
    assert (found["stood"], found["replans"], found["in_time"], found["jumps"]) == (2, 3, 2, 2)
    assert found["largest_error_m"] == max(abs(e) for x in (good, late) for e in x["errors_m"])
    assert found["interval"] == pytest.approx((0.2077, 0.9385), abs=1e-4)  # Wilson's, of 2 in 3
    assert found["begun_without_waiting"] == 1 and json.loads(store.to_json(good)) == json.loads(json.dumps(good))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chain_strobe", "chain_path", "chain_timeline", "chain_errors"])
def test_figures_are_legible_in_print(name):
    result, more = chain(2.0), ()
    if name == "chain_errors":
        more = ((series.row(0, result),),)
    fig = getattr(experiments, name)(result, *more)
    fig.canvas.draw()
    texts = [t for t in fig.findobj(Text) if t.get_text().strip() and t.get_visible()]
    assert fig.get_size_inches()[0] == PAGE_IN and min(t.get_fontsize() for t in texts) >= MIN_FONT_PT
    assert not [t for ax in fig.axes for t in (ax.get_xlabel(), ax.get_ylabel()) if t and t != "jump" and "[" not in t]


# ------------------------------------------------------------------------------------------ the command line

HELP = "'jumplab chain --help' shows what is possible"


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        ("--out x", 2, f"the following arguments are required: --distance-m; {HELP}"),
        ("--distance-m 0.6,far --out x", 2, "--distance-m must be a number, got 'far'"),
        ("--distance-m 0.6,0.6 --platform-m 0.1 --out x", 2, "1 platforms for 2 distances: give one per jump"),
        ("--distance-m 0.6 --runs 1.5 --out x", 2, "--runs must be a whole number from 1 to 10000, got '1.5'"),
        ("--distance-m 0.6,0.6 --height-m 0.3,1.4 --out x", 3, "jump 2 of 2: whole body: no plan ("),
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
    code = cli.main(["chain", "--distance-m", "0.5", "--solve-s", "0.2", "--seed", "4", "--out", str(out)])
    told, err = capsys.readouterr()
    assert code == 0, err
    assert re.search(r"^ *1 +0\.500 +0\.500 +0\.\d{3} +-?0\.0\d\d +-?0\.0\d\d +0\.4\d\d +0\.200", told, re.M), told
    assert "chain: stands after every jump" in told and "checks of 1 plans passed" in told
    assert "A chain of jumps" in (out / "chain.html").read_text(encoding="utf-8")
