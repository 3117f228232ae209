"""Certificates: what counts as agreement, what is said where there is none, and that nothing is written by halves."""

import json
import re
import sys
from types import SimpleNamespace

import pytest
from fixtures_core import on_file, refused
from paper import certify as certificates
from paper.certify import QUANTITIES, certificate_page, certify
from test_store import names

from jumplab.cli import main as cli
from jumplab.errors import InputError, RobotError
from jumplab.io import folder as store
from jumplab.sim import ENGINES, INSTALLED, Metrics, Perturbation
from jumplab.studies import trials as series

pytestmark = pytest.mark.skipif(set(INSTALLED) != set(ENGINES), reason="a certificate needs every engine")
LAID = {"plan.npz", "robot.toml", "robot.urdf", "summary.json"}
WRITTEN = {"certificate.json", "certificate.html", "trials.jsonl"}


def held(folder) -> set[str]:
    return set(names(folder))


def measured(**changed) -> Metrics:
    """A landing as it might be measured."""
    none = dict(max_torque_ratio_by_joint={}, max_speed_ratio_by_joint={}, saturated_s={}, overspeed_s={})
    loads = dict.fromkeys(("max_torque_ratio", "max_speed_ratio"), 0.5)
    loads |= {f"{name}_before_touchdown": 0.5 for name in loads}
    known = dict(standing_s=3.05, landed=True, reason="stood for 3.05 s on its feet alone", self_collision_s=0.0)
    known |= dict(stray_contacts=(), launch_impulse=(30.0, 500.0), qp_solves=1500, qp_failures=0)
    known |= dict(touchdown_s=1.5, foot_distance_touchdown_m=0.6, foot_distance_m=0.6, com_rise_m=0.3)
    known |= dict(touchdown_trunk_pitch_rad=0.3, touchdown_trunk_rate=0.1, landing_force_n=2000.0)
    return Metrics(**(none | loads | known | dict(landing_impulse=(-20.0, 120.0)) | changed))


@pytest.fixture
def physics(monkeypatch):
    """Stands in for the simulation: what each engine measures, which may be changed; calls are listed."""
    world = SimpleNamespace(say=lambda engine, mode, perturbed: {}, softly=lambda engine: {}, calls=[])

    def simulate(tape, robot, *, engine, mode, perturbation=None, contact="hard", **options):
        drawn = None if perturbation == Perturbation() else perturbation
        world.calls.append((engine, mode, drawn and drawn.seed))
        m = measured(**(world.say(engine, mode, drawn) if contact == "hard" else world.softly(engine)))
        return SimpleNamespace(landed=m.landed, reason=m.reason, metrics=m, checks_passed=True)

    monkeypatch.setattr(series, "simulate_jump", simulate)
    monkeypatch.setattr(series, "signs", lambda result: ())  # there is no log to read
    return world


def test_engines_that_measure_the_same_certify_a_plan(folder, physics, capsys):
    assert cli.main(["certify", str(folder), "--n", "3", "--jobs", "1"]) == 0
    said = capsys.readouterr().out
    agreed = "certified: all 51 checks of the audit passed, and the engines agree that it lands (position and pd mode)"
    assert agreed in said and "pd mode: the engines agree\n" in said
    assert held(folder) == LAID | WRITTEN
    found = store.read_json(folder / "certificate.json")
    assert found["passed"] and found["failures"] == [] and found["audit"]["passed"]
    assert set(found["modes"]) == {"position", "pd"} and found["limits"]["place_m"] == 0.01
    pd = found["modes"]["pd"]["perturbed"]
    assert pd["count"] == pd["same_verdict"] == 3 and pd["landed"] == {"bullet": 3, "mujoco": 3}
    seeds = [
        {s for e, m, s in physics.calls if (e, m) == (engine, mode)} for engine in ENGINES for mode in found["modes"]
    ]
    assert all(s == seeds[0] and len(s) == 4 for s in seeds)  # the same robots everywhere, and the planned one
    again = certify(folder, 3, jobs=1)
    assert again.resumed == len(physics.calls) == 18 and again.passed  # nothing was simulated twice
    text = (folder / "certificate.html").read_text()
    assert not re.search(r"<script|https?:|src=|@import", text) and 'name="viewport"' in text


def off(**changed):
    return lambda engine, mode, drawn: changed if (engine, mode, drawn) == ("mujoco", "pd", None) else {}


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"touchdown_s": 1.506}, "differ by 0.006 s in time of touchdown (limit 0.005 s)"),
        ({"foot_distance_touchdown_m": 0.589}, "differ by 0.011 m in toes at touchdown (limit 0.01 m)"),
        ({"foot_distance_m": 0.611}, "differ by 0.011 m in toes in the end (limit 0.01 m)"),
        ({"com_rise_m": 0.32}, "differ by 0.02 m in rise of the CoM (limit 0.01 m)"),
        ({"touchdown_trunk_pitch_rad": 0.32}, "differ by 0.02 rad in trunk pitch at touchdown (limit 0.0175 rad)"),
        ({"touchdown_trunk_rate": -0.2}, "differ by 0.3 rad/s in trunk pitch rate at touchdown (limit 0.2 rad/s)"),
        ({"landing_impulse": (-20.0, 150.0)}, "differ by 0.222 in vertical impulse of landing (limit 0.1)"),
        ({"landing_force_n": 3000.0}, "differ by 0.4 in largest force of landing (limit 0.15)"),
    ],
)
def test_each_limit_can_be_failed(folder, physics, changed, sentence):
    physics.say = off(**changed)
    found = certify(folder, 1, jobs=1)
    assert found.failures == [f"pd mode: the engines {sentence}"] and not found.passed
    assert sentence in certificate_page(found).html


def test_perturbed_robots_must_fare_alike(folder, physics, capsys, monkeypatch):
    """One of four falls in one engine alone: that is more than 3 %; and exit code and sentence say it."""
    unlucky = series.TrialKey(0, 2, "", "").robot_seed

    def say(engine, mode, drawn):
        fell = (engine, mode, drawn and drawn.seed) == ("bullet", "position", unlucky)
        return {"landed": False, "reason": "trunk touched the ground 0.30 s after touchdown"} if fell else {}

    physics.say = say
    assert cli.main(["certify", str(folder), "--n", "4", "--jobs", "1"]) == 3
    said = capsys.readouterr()
    verdict = "position mode: 3 of 4 perturbed robots have the same outcome in every engine, must be at least 97 %"
    assert said.err == f"jumplab: not certified: {verdict}; see certificate.html in {str(folder)!r}\n"
    assert store.read_json(folder / "certificate.json")["failures"] == [verdict]
    told = "robot 2: bullet: trunk touched the ground 0.30 s after touchdown; mujoco: stood for 3.05 s"
    assert told in (folder / "certificate.html").read_text()
    monkeypatch.setitem(certificates.LIMITS, "verdict_share", 0.75)
    lenient = certify(folder, 4, jobs=1)
    assert lenient.passed and lenient.resumed == 22
    many = lenient.modes[0].to_json()["perturbed"]["robots"]
    assert [row["same"] for row in many] == [True, True, False, True]


def test_the_median_of_perturbed_robots_is_held_to_the_limits(folder, physics):
    """One of three may be far off; with a second one the engines disagree."""
    far = [series.TrialKey(0, index, "", "").robot_seed for index in (0, 2)]

    def say(engine, mode, drawn):
        return {"foot_distance_m": 0.7} if engine == "mujoco" and drawn and drawn.seed in odd else {}

    physics.say, odd = say, far[:1]
    assert certify(folder, 3, jobs=1).passed
    odd = far
    (folder / "trials.jsonl").unlink()
    words = "{} mode: for perturbed robots the engines differ by 0.1 m in toes in the end (median, limit 0.01 m)"
    assert certify(folder, 3, jobs=1).failures == [words.format("position"), words.format("pd")]


def test_a_plan_that_fails_its_audit_is_not_certified(folder, physics, monkeypatch):
    bad = SimpleNamespace(name="torque", passed=False)
    audit = SimpleNamespace(passed=False, checks=(bad,), failed=(bad,))
    monkeypatch.setattr(certificates, "audit", lambda *args, **options: audit)
    found = certify(folder, 1, jobs=1)
    assert found.failures == ["the plan fails the audit's check torque"]
    assert "Not certified." in (folder / "certificate.html").read_text()


def test_it_is_a_certificate_of_the_modes_that_are_named(folder, physics, capsys):
    """A plan that only some servos land alike is certified for these, and not for the others."""
    physics.say = lambda engine, mode, drawn: {"touchdown_s": 1.506} if (engine, mode) == ("mujoco", "pd") else {}
    asked = "certify", str(folder), "--n", "1", "--jobs", "1", "--modes"
    assert cli.main([*asked, "whole-body"]) == 0
    assert "the engines agree that it lands (whole-body mode)" in capsys.readouterr().out
    assert {mode for _, mode, _ in physics.calls} == {"whole-body"}
    assert set(store.read_json(folder / "certificate.json")["modes"]) == {"whole-body"}
    assert cli.main([*asked, "whole-body", "pd"]) == 3
    said = capsys.readouterr()
    assert "whole-body mode: the engines agree\n" in said.out and "pd mode: the engines do not agree\n" in said.out
    found = store.read_json(folder / "certificate.json")
    assert {name: mode["agree"] for name, mode in found["modes"].items()} == {"whole-body": True, "pd": False}
    page = (folder / "certificate.html").read_text()
    assert page.count("The engines agree.") == page.count("The engines do not agree.") == 1
    for modes in ((), ("pd", "pd")):
        with pytest.raises(InputError, match=r"^modes = .*: give one or more, each of them once$"):
            certify(folder, 1, modes=modes)
    with pytest.raises(InputError, match=r"^mode 'servo': must be one of position, pd, whole-body"):
        certify(folder, 1, modes=("servo",))


def test_interrupted_it_goes_on(folder, physics, capsys):
    """Finished simulations are kept, no certificate is there, and the rest is made later."""
    real = physics.say

    def stop(engine, mode, drawn):
        if len(physics.calls) > 5:
            raise KeyboardInterrupt
        return real(engine, mode, drawn)

    physics.say = stop
    assert cli.main(["certify", str(folder), "--n", "2", "--jobs", "1"]) == 130
    assert "finished trials are kept, and the same command resumes from there" in capsys.readouterr().err
    assert held(folder) == LAID | {"trials.jsonl"}
    physics.say, physics.calls = real, []
    assert certify(folder, 2, jobs=1).resumed == 5 and len(physics.calls) == 9


def test_what_makes_no_certificate_says_why(folder, physics, monkeypatch, capsys):
    assert refused(certify, folder, 0) == "n = 0 is too small; it must be at least 1"
    assert cli.main(["certify", str(folder), "--n", "0"]) == 2
    assert capsys.readouterr().err == "jumplab: --n must be a whole number from 1 to 100000, got '0'\n"

    def refuse(engine, mode, drawn):
        if engine == "mujoco":
            raise RobotError("robot bhr: MuJoCo cannot read the URDF: mass and inertia must be positive")
        return {}

    physics.say = refuse
    assert cli.main(["certify", str(folder), "--n", "1", "--jobs", "1"]) == 2
    words = "jumplab: robot bhr: MuJoCo cannot read the URDF: mass and inertia must be positive\n"
    assert capsys.readouterr().err == words and held(folder) == LAID | {"trials.jsonl"}
    (folder / "trials.jsonl").unlink()
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "jumplab.sim.mujoco", raising=False)
    assert refused(certify, folder, 1, jobs=1).startswith("engine 'mujoco': the package mujoco is not installed; ")
    assert held(folder) == LAID


def test_a_new_plan_takes_the_certificate_away(folder, physics):
    certify(folder, 1, jobs=1)
    assert held(on_file(folder)) == LAID


def test_the_page_shows_every_quantity(folder, physics):
    """In each engine, how far apart, at most, whether that is agreement, and what perturbed robots have."""
    physics.say = off(touchdown_s=1.5025, com_rise_m=0.4)
    page = certificate_page(certify(folder, 2, jobs=1)).html
    rows = page.split("<h2>pd mode</h2>")[1].split("<tr>")[1:]
    cells = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in rows]
    assert cells[0][1:] == ["unit", *ENGINES, "apart", "of the mean", "at most", "agree", "robots, median", "largest"]
    assert [row[0] for row in cells[1:]] == [q.name for q in QUANTITIES]
    assert cells[1] == ["time of touchdown", "s", "1.5", "1.5", "0.0025", "no", "0.005", "yes", "0", "0"]
    assert cells[4] == ["rise of the CoM", "m", "0.3", "0.4", "0.1", "no", "0.01", "no", "0", "0"]


def test_a_jump_that_does_not_get_so_far_is_no_agreement(folder, physics):
    physics.say = off(touchdown_s=None, landed=False, reason="fell")
    missing = "pd mode: time of touchdown was not measured in every engine"
    assert certify(folder, 1, jobs=1).failures == ["pd mode: mujoco does not land it: fell", missing]


def test_it_lands_on_the_contacts_of_both_engines(folder, physics):
    """Those that each has by default, and where it does not, no certificate is given."""
    physics.softly = lambda engine: {"landed": False, "reason": "fell"} if engine == "mujoco" else {}
    found = certify(folder, 1, jobs=1)
    assert found.failures == ["usual contact: mujoco does not land it: fell"] and not found.passed
    told = store.read_json(folder / "certificate.json")["usual_contact"]
    assert told["bullet"]["landed"] and told["mujoco"] == {"landed": False, "reason": "fell"}
    assert "in position mode: bullet: stood for 3.05 s on its feet alone; mujoco: fell." in (
        folder / "certificate.html").read_text()  # fmt: skip


@pytest.mark.slow
def test_a_plain_jump_is_certified(folder, monkeypatch):
    """All engines, for real, in one of the two modes."""
    monkeypatch.setattr(certificates, "MODES", ("position",))
    found = certify(folder, 1)
    assert found.passed, found.failures
    assert all(t.metrics.landed for mode in found.modes for pair in mode.pairs for t in pair.values())
    (impulses,) = [d for d in found.modes[0].differences if d["name"] == "vertical impulse of landing"]
    assert all(impulses[engine] > 42 * 9.8 * 0.1 for engine in ENGINES)
    assert json.loads((folder / "certificate.json").read_text())["passed"]
