"""Monte Carlo: a trial is decided by its key alone, and neither kill nor order changes a series."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fixtures_core import import_graph, on_file, refused
from paper import margins
from paper.margins import margin_chart
from paper.runs import features
from test_store import make_tape, names

from jumplab.errors import InputError, SolverError
from jumplab.io import folder as store
from jumplab.sim import Finding, Perturbation, Ranges, Scene, SensorNoise, Sign, SimulationResult, signs
from jumplab.studies import study as studies
from jumplab.studies import trials as monte_carlo
from jumplab.studies.trials import PlanOnFile, Trial, TrialKey, TrialSettings, run_trials, wilson

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """One trial for real: its folder, its report, and the simulation that it was."""
    folder, runs = on_file(tmp_path_factory.mktemp("real") / "plan"), []
    simulate = monte_carlo.simulate_jump
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(monte_carlo, "simulate_jump", lambda *a, **k: runs.append(simulate(*a, **k)) or runs[-1])
        report = run_trials(folder, 1, 3, TrialSettings("pd"), jobs=1)
    return folder, report, runs[0]


def play(plan, settings, key):
    """Stands in for a trial: lands by a coin that the key tosses."""
    toss = np.random.default_rng(key.robot_seed).uniform()
    robot = plan.robot
    drawn = Perturbation.draw(robot, key.robot_seed)
    reason = "stood" if toss < 0.7 else f"left_arm touched the ground {toss:.2f} s after touchdown"
    return Trial(key, {}, features(drawn, robot), toss < 0.7, reason, None)


@pytest.fixture
def coins(monkeypatch):
    monkeypatch.setattr(monte_carlo, "run_trial", play)
    monkeypatch.setattr(monte_carlo.TrialReport, "values", lambda self, name: np.zeros(0))


def content(folder):
    return (folder / "trials.json").read_bytes()


# ------------------------------------------------------------------------------------------ one trial


def test_a_trial_is_the_simulation_it_says(real):
    folder, report, run = real
    plan, settings, (trial,) = PlanOnFile.read(folder), report.settings, report.trials
    key, robot = TrialKey(3, 0, settings.hash, plan.hash), plan.robot
    drawn = Perturbation.draw(robot, key.robot_seed, Ranges(), SensorNoise.typical())
    assert trial.key == key
    assert trial.perturbation == json.loads(json.dumps(drawn.to_json())) and trial.metrics == run.metrics
    assert trial.metrics.landed == trial.landed and trial.metrics.com_rise_m == pytest.approx(0.3, abs=0.05)
    kept = json.dumps(trial.to_json())
    assert json.dumps(Trial.from_json(json.loads(kept)).to_json()) == kept
    f = features(drawn, robot)
    assert (f["friction"], f["delay_s"]) == (drawn.friction, drawn.delay_s)
    assert drawn.robot(robot).total_mass == pytest.approx(robot.total_mass * (1 + f["mass"]))


def test_features_of_a_shift_of_every_link(bhr):
    """All links' centres of mass moved alike, nothing turned but the legs: the whole robot's moves as its trunk's."""
    links = Perturbation.draw(bhr, 0).com
    shifted = features(Perturbation(com=dict.fromkeys(links, (0.0, 0.01, 0.0))), bhr)
    assert shifted["com_y_m"] == pytest.approx(0.01, rel=1e-3) and shifted["mass"] == 0
    weak = Perturbation(motor_gain=dict.fromkeys(bhr.joint_names, 0.97))
    assert features(weak, bhr)["leg_motors"] == pytest.approx(-0.03)


def test_a_lost_robot_is_a_failure(folder, monkeypatch):
    def explode(*args, **options):
        raise SolverError("PyBullet lost the robot")

    monkeypatch.setattr(monte_carlo, "simulate_jump", explode)
    report = run_trials(folder, 2, jobs=1)
    assert (report.landed, report.reasons) == (0, {"PyBullet lost the robot": 2})
    assert store.read_json(folder / "trials.json")["landed_metrics"]["com_rise_m"] is None


def test_a_run_that_fails_a_check_is_a_failure(folder, real, monkeypatch):
    """However well it stands; the log says which check it failed."""
    doubtful = replace(real[2], checks=(Finding("extra force", 20.0, 15.0, "N", "a carried base"),))
    monkeypatch.setattr(monte_carlo, "simulate_jump", lambda *args, **options: doubtful)
    trial = run_trials(folder, 1, jobs=1).trials[0]
    assert trial.metrics.landed and not trial.landed
    doubt = "extra force: 20 N (at most 15; a carried base)"
    assert trial.reason == f"failed checks of the run: {doubt}; the run's own verdict: {trial.metrics.reason}"


def test_keys_differ_in_everything_that_matters(folder, monkeypatch):
    plan = PlanOnFile.read(folder)
    base = TrialSettings()
    others = [TrialSettings("pd"), TrialSettings(reaim=False), TrialSettings(noise=SensorNoise()),
              TrialSettings(ranges=replace(base.ranges, mass=0.06))]  # fmt: skip
    assert len({s.hash for s in (base, *others)}) == 5 and TrialSettings().hash == base.hash
    known = base.hash
    monkeypatch.setattr("jumplab.studies.study.code", lambda: "another controller")
    assert base.hash != known
    others = {}, {"platform_edge_m": 0.3}, {"target": {"platform_m": 0.1}}
    assert len({replace(plan, summary=plan.summary | other).hash for other in others}) == 3
    seeds = {TrialKey(s, k, "", "").robot_seed for s in range(20) for k in range(50)}
    assert len(seeds) == 1000


def test_the_code_that_decides_a_trial_is_all_read(tmp_path):
    """Whatever a trial imports, at any depth; a changed line there is another code, one that only shows is none."""
    graph = import_graph()
    used = graph.find_upstream_modules("jumplab.studies.trials")
    assert not any(name.startswith(("jumplab.show", "jumplab.cli", "jumplab.api")) for name in used)
    root = tmp_path / "jumplab"
    for file in ("sim/loop.py", "studies/trials.py", "cli/main.py"):
        (root / file).parent.mkdir(parents=True)
        (root / file).write_text("before\n")
    known = studies.code(root)
    for file, decides in (("sim/loop.py", True), ("studies/trials.py", True), ("cli/main.py", False)):
        (root / file).write_text("after\n")
        studies.code.cache_clear()
        assert (studies.code(root) != known) == decides, file
        known = studies.code(root)


def test_conditions_follow_the_settings():
    said = TrialSettings("pd", False, SensorNoise(), Ranges(mass=0.2), "mujoco").conditions
    assert said["playback"].startswith("pd mode (planned torques") and "in MuJoCo, hard contact" in said["playback"]
    assert said["re-aim"] == "no"
    assert "masses ±20 %" in said["drawn uniformly, each link and joint by itself"]
    assert said["measured (one standard deviation)"] == "the true state and foot forces"


# ------------------------------------------------------------------------------------------ a series


def test_report_counts(folder, coins):
    report = run_trials(folder, 40, seed=2, jobs=1)
    said = store.read_json(folder / "trials.json")
    landed = sum(t.landed for t in report.trials)
    assert said["counts"] == {"trials": 40, "landed": landed, "failed": 40 - landed} and 20 < landed < 36
    assert said["success_rate"] == landed / 40 and said["success_interval"] == list(wilson(landed, 40))
    assert said["reasons"] == {"arm touched the ground ... s after touchdown": 40 - landed}
    assert set(said["failed"]) == {str(t.key.index) for t in report.trials if not t.landed}
    assert said["settings"]["mode"] == "position" and said["settings"]["reaim"] and said["seed"] == 2
    assert said["settings"]["noise"] == vars(SensorNoise.typical())  # sensors err unless told otherwise
    assert said["conditions"] == {
        "playback": "position mode (target angles and rates; a drive measures its own joint) in PyBullet, hard contact",
        "launch": "open loop on two feet; on one, CoM, L, trunk and the other foot are led back to the plan",
        "re-aim": "the legs turn in the air against errors of trunk, speed and momentum, about all axes",
        "recovery step": "none",
        "drawn uniformly, each link and joint by itself": str(Ranges()),
        "measured (one standard deviation)": str(SensorNoise.typical()),
        "known exactly": monte_carlo.KNOWN,
    }
    assert [t.key.index for t in report.trials] == list(range(40))
    lines = (folder / "trials.jsonl").read_text().splitlines()
    assert {Trial.from_json(json.loads(line)["row"]).key for line in lines} == {t.key for t in report.trials}


@pytest.mark.parametrize("stop", [KeyboardInterrupt, MemoryError])
def test_a_stopped_series_goes_on_to_the_same_end(folder, coins, monkeypatch, stop):
    whole = run_trials(folder, 12, jobs=1)
    wanted = content(folder)
    (folder / "trials.json").unlink()
    (folder / "trials.jsonl").unlink()
    calls = []

    def stopping(*args):
        if len(calls) == 5:
            raise stop
        calls.append(args)
        return play(*args)

    monkeypatch.setattr(monte_carlo, "run_trial", stopping)
    with pytest.raises(stop):
        run_trials(folder, 12, jobs=1)
    assert "trials.json" not in names(folder)
    with open(folder / "trials.jsonl", "ab") as file:  # killed in the middle of a line
        file.write(json.dumps({"key": whole.trials[7].key.name, "row": {}}).encode()[:30])
    monkeypatch.setattr(monte_carlo, "run_trial", play)
    again = run_trials(folder, 12, jobs=1)
    assert again.resumed == 5 and again.trials == whole.trials and content(folder) == wanted
    third = run_trials(folder, 12, jobs=1)
    assert third.resumed == 12 and content(folder) == wanted
    longer = run_trials(folder, 14, jobs=1)
    assert longer.resumed == 12 and longer.trials[:12] == whole.trials
    assert run_trials(folder, 3, jobs=1).trials == whole.trials[:3]


def test_a_bar_only_where_it_is_wanted(folder, coins, capsys):
    report = run_trials(folder, 3, jobs=1)
    assert capsys.readouterr().err == ""  # not a terminal
    run_trials(folder, 4, jobs=1, progress=True)
    said = capsys.readouterr().err
    assert "4/4" in said and "3/4" in said  # the first three are there already
    assert report.count == 3


def test_other_settings_seeds_and_plans_do_not_mix(folder, bhr, coins):
    first = run_trials(folder, 4, jobs=1)
    for options in ({"seed": 1}, {"settings": TrialSettings("pd")}, {"settings": TrialSettings(reaim=False)}):
        assert run_trials(folder, 4, jobs=1, **options).resumed == 0
    assert run_trials(folder, 4, jobs=1).resumed == 4  # all four series share the file
    kept = (folder / "trials.jsonl").read_bytes()
    store.write_plan(folder, make_tape(bhr), bhr, store.read_plan(folder)[2])
    assert not {"trials.json", "trials.jsonl"} & set(names(folder))
    (folder / "trials.jsonl").write_bytes(kept)  # even if somebody puts it back
    other = run_trials(folder, 4, jobs=1)
    assert other.resumed == 0 and other.plan != first.plan


def test_two_runs_at_once_are_refused(folder, coins):
    with (
        PlanOnFile.read(folder).study(),
        pytest.raises(InputError, match=r"trials\.jsonl: another 'jumplab trials' is writing it"),
    ):
        run_trials(folder, 3, jobs=1)


def test_a_plan_that_is_replaced_meanwhile_keeps_its_own_folder(folder, bhr, coins, monkeypatch):
    def replacing(*args):
        store.write_plan(folder, make_tape(bhr), bhr, store.read_plan(folder)[2])
        return play(*args)

    monkeypatch.setattr(monte_carlo, "run_trial", replacing)
    assert "has been planned again in the meantime" in refused(run_trials, folder, 1, jobs=1)
    assert not {"trials.json", "trials.jsonl"} & set(names(folder))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((0,), "n = 0 is too small; it must be at least 1"),
        ((2.0,), "n must be a whole number, got 2.0"),
        ((True,), "n must be a whole number, got True"),
        ((2, -1), "seed = -1 is too small; it must be at least 0"),
    ],
)
def test_bad_numbers(folder, arguments, sentence):
    before = names(folder)
    assert refused(run_trials, folder, *arguments) == sentence and names(folder) == before


# ------------------------------------------------------------------------------------------ causes, falls, margins


def test_failures_are_counted_by_their_first_sign(folder, monkeypatch):
    def failing(plan, settings, key):
        found = (Sign("slip", 0.1), Sign("tip", 0.2)) if key.index < 3 else ()
        return replace(play(plan, settings, key), landed=key.index == 4, signs=found)

    monkeypatch.setattr(monte_carlo, "run_trial", failing)
    monkeypatch.setattr(monte_carlo.TrialReport, "values", lambda self, name: np.zeros(0))
    report = run_trials(folder, 5, jobs=1)
    assert report.causes == {"slip": 3, "other": 1} == store.read_json(folder / "trials.json")["causes"]
    assert run_trials(folder, 5, jobs=1).trials == report.trials and "began with: slip" in report._repr_html_()


def test_falls_are_kept_whole(folder, monkeypatch):
    """The very run of the trial, in a folder that everything else can read, on the ground that it had."""
    settings, runs, simulate = TrialSettings(ranges=Ranges.none(shove_launch_n_s=(25, 25), ground_m=0.02)), [], None

    def once(*given, **options):
        """The same question is the same simulation."""
        runs.append((options, runs[0][1] if runs else simulate(*given, **options)))
        return runs[-1][1]

    simulate = monte_carlo.simulate_jump
    monkeypatch.setattr(monte_carlo, "simulate_jump", once)
    report = run_trials(folder, 1, 2, settings, jobs=1, keep_falls=1)
    (trial,) = report.trials
    first, second = (options for options, _ in runs)
    assert second == {name: value for name, value in first.items() if value is not None}
    assert not trial.landed and trial.signs and trial.reason == trial.metrics.reason
    own = folder / "falls" / "0"
    _, robot, summary = store.read_plan(own)
    run = SimulationResult.load(own, robot)
    assert run.metrics == trial.metrics and signs(replace(run, robot=robot)) == trial.signs
    ground = Scene.of_run(store.read_json(own / "simulation.json"), summary, robot)
    assert len(ground.blocks) == 2 and abs(ground.blocks[1].top) == abs(trial.perturbation["ground_m"]) > 0


def bears(limits):
    """Stands in for a trial: lands up to a payload, farther with re-aim."""

    def trial(plan, settings, key):
        trials.append(key)
        load, most = settings.ranges.payload_kg[0], limits[settings.reaim]
        return replace(play(plan, settings, key), landed=load <= most or (load < 4 and key.index == 7))

    trials: list[TrialKey] = []
    return trial, trials


@pytest.mark.parametrize(("most", "shares"), [((2.6, 9.0), (0.5, 1.0)), ((-1.0, 0.3), (0.0, 0.0))])
def test_margins_are_bisected_and_resumed(folder, monkeypatch, most, shares):
    trial, tried = bears(most)
    monkeypatch.setattr(monte_carlo, "run_trial", trial)
    report = margins.margins(folder, ("payload_kg", "payload_kg+friction"), 20, steps=4, jobs=1)
    found = {(m.names, m.reaim): m for m in report.margins}
    assert [found["payload_kg", on].share for on in (False, True)] == list(shares)
    plain = found["payload_kg", False]
    assert plain.sizes == {"payload_kg": 5 * shares[0]} and plain.interval == wilson(plain.landed, plain.tried)
    assert [share for share, *_ in plain.probes[:2]] == [1.0, 0.0]
    assert plain.probes[0][2] == 2  # two of twenty that fall are too many
    assert found["payload_kg+friction", True].sizes["friction"] == pytest.approx(0.8 - 0.5 * shares[1])
    again, count = margins.margins(folder, ("payload_kg", "payload_kg+friction"), 20, steps=4, jobs=1), len(tried)
    assert again.margins == report.margins and len(tried) == count
    kept = margins.MarginReport.from_json(store.read_json(folder / "margins.json"))
    assert kept.margins == report.margins and "margins in bullet" in kept._repr_html_()
    assert 0.94 < 19 / 20 and margins.enough(19, 20) and not margins.enough(18, 20) and not margins.enough(3, 4)


def test_margins_of_other_ways_and_their_picture(folder, monkeypatch):
    seen = []

    def trial(plan, settings, key):
        seen.append((settings.step, settings.feedback))
        return replace(play(plan, settings, key), landed=True)

    def found(names, **how):
        seen.clear()
        report = margins.margins(folder, names, 2, settings=TrialSettings(**how), jobs=1)
        asked = how.get("step", False), how.get("feedback", False)
        assert set(seen) == {asked}
        kept = margins.MarginReport.from_json(store.read_json(folder / "margins.json"))
        assert (kept.step, kept.feedback) == (report.step, report.feedback) == asked
        told = report.line()
        assert ("recovery steps allowed" in told, "launch corrected" in told) == asked
        return report

    monkeypatch.setattr(monte_carlo, "run_trial", trial)
    with_step, usual = found(("payload_kg", "mass"), step=True), found(("payload_kg",))
    found(("mass",), mode="whole-body", feedback=True)
    figure = margin_chart({"usual": usual, "one step": with_step})
    assert [ax.get_title("left") for ax in figure.axes] == ["plain", "re-aimed"]
    for ax in figure.axes:
        assert [line.get_label() for line in ax.lines] == ["usual", "one step"]
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["payload_kg"]  # which both have
    assert not margin_chart(usual).legends and len(figure.legends) == 1
    with pytest.raises(InputError, match="up to 4 reports with disturbances in two of them, got 5 reports with 1 dist"):
        margin_chart({str(k): usual for k in range(5)})


def test_margins_of_what_is_not_there(folder):
    with pytest.raises(InputError, match=r"^no disturbance is called 'wind'; there are mass, com_m, "):
        margins.margins(folder, ("wind",), 2, jobs=1)
    said = refused(margins.MarginReport.from_json, {"margins": [{}]})
    assert said == "not the margins of a plan (KeyError); make them with 'jumplab margins'"
    whole = {name: margins.ranges_at(name, 1.0) for name in (*margins.SINGLE, *margins.PAIRS)}
    assert whole["friction"].friction == (0.3, 0.3) and whole["delay_s"].delay_s == (0.0, 0.008)
    assert all(margins.ranges_at(name, 0.0) == Ranges.none() for name in whole)


# ------------------------------------------------------------------------------------------ the real thing


LANDED = """
import sys, time
from jumplab.cli.main import main
from jumplab.studies import trials
def fall(plan, settings, key):
    time.sleep(0.2)
    return trials.Trial(key, {}, {}, False, f"{key.robot_seed}", None)
trials.run_trial = fall
sys.exit(main())
"""


def start(code, *argv):
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler)  # background jobs ignore Ctrl-C
    how = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, preexec_fn=heed)
    return subprocess.Popen([sys.executable, *code, *argv], env=os.environ | {"PYTHONPATH": str(ROOT)}, **how)


@pytest.mark.slow
def test_killed_in_parallel_and_resumed_equals_serial(folder, tmp_path):
    """Ctrl-C, then a kill, of two workers; what remains is what one process finds undisturbed."""
    other, n = tmp_path / "other", 12
    shutil.copytree(folder, other)
    assert start(["-c", LANDED], "trials", folder, "--n", str(n), "--jobs", "1").wait() == 0
    for number, lines in ((signal.SIGINT, 1), (signal.SIGKILL, 3)):
        process = start(["-c", LANDED], "trials", other, "--n", str(n), "--jobs", "2")
        log = other / "trials.jsonl"
        while process.poll() is None and not (log.exists() and log.read_bytes().count(b"\n") >= lines):
            time.sleep(0.02)
        process.send_signal(number)
        said = process.communicate(timeout=60)[1]
        if number == signal.SIGINT and process.returncode:
            assert process.returncode == 130
            assert said == "jumplab: interrupted; finished trials are kept, and the same command resumes from there\n"
    process = start(["-c", LANDED], "trials", other, "--n", str(n), "--jobs", "2")
    told = process.communicate()[0]
    assert 1 <= int(re.search(r"(\d+) trials from an earlier run", told)[1]) and content(other) == content(folder)
    with PlanOnFile.read(other).study() as study, PlanOnFile.read(folder).study() as serial:
        assert study.done == serial.done


@pytest.mark.slow
def test_a_trial_of_another_process_is_the_same(folder, real):
    process = start(["-m", "jumplab"], "trials", folder, "--n", "1", "--seed", "3", "--mode", "pd", "--jobs", "1")
    assert process.wait() == 0
    assert store.read_json(folder / "trials.json") == store.read_json(real[0] / "trials.json")
    with PlanOnFile.read(folder).study() as study:
        assert tuple(study.done.values()) == real[1].trials
