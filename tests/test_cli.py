"""The command line: every refusal is one sentence on stderr, with its exit code, and leaves nothing behind."""

import importlib
import json
import random
import string
import subprocess
import sys
import types
from pathlib import Path

import pytest
from test_store import Result, make_summary, make_tape, names

from jumplab.cli import main as cli
from jumplab.errors import InfeasibleError, SolverError
from jumplab.io import folder as store
from jumplab.robot.files import SHIPPED
from jumplab.stages.plan import JumpPlan

ROOT = Path(__file__).resolve().parent.parent
STAGES = [{"stage": "SRMP launch", "iterations": 31, "build_s": 0.25, "solve_s": 0.125}]
FINDING = {"name": "mass", "value": 42.0, "limit": 42.5, "unit": "kg", "passed": True, "catches": "another robot"}
METRICS = {"foot_distance_m": 1.002, "com_rise_m": 0.497, "standing_s": 3.4, "landed": True, "reason": "stood",
           "checks": [FINDING]}  # fmt: skip
FALL = {"foot_distance_m": None, "com_rise_m": None, "standing_s": 0.0, "landed": False, "reason": "fell",
        "checks": [FINDING, FINDING | {"value": 43.0, "passed": False}]}  # fmt: skip
HELP = "'jumplab --help' shows what is possible"
HELP_PLAN = "'jumplab plan --help' shows what is possible"


def run(capsys, *argv):
    """Exit code, stdout and stderr of one command."""
    code = cli.main([str(a) for a in argv])
    return code, *capsys.readouterr()


def one_sentence(code, out, err, expected_code=2):
    assert code == expected_code, err
    assert out == ""
    assert err.startswith("jumplab: ") and err.count("\n") == 1 and err.endswith("\n")
    assert "Traceback" not in err
    return err.removeprefix("jumplab: ").rstrip("\n")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


NAMES = ", ".join(work.__name__ for work in cli.COMMANDS).replace(", completion", " or completion")
REFUSALS = [
    ("", f"choose a command: {NAMES}; " + HELP),
    ("plan", "the following arguments are required: --out; " + HELP_PLAN),
    ("plan --out x --fast", "unrecognized arguments: --fast; " + HELP),
    ("plan --out x --dist 1", "unrecognized arguments: --dist 1; " + HELP),
    ("plan --out x --distance-m", "argument --distance-m: expected one argument; " + HELP_PLAN),
    ("plan --out x --distance-m=--", "--distance-m=--: '--' is not a value; " + HELP),
    ("plan --out x --distance-m far", "--distance-m must be a number, got 'far'"),
    ("plan --out x --distance-m nan", "distance must be finite, got nan"),
    ("plan --out x --distance-m -inf", "distance must be finite, got -inf"),
    ("plan --out x --distance-m -1e1", "distance = -10 m is outside -3 ... 3 m"),
    ("plan --out x --height-m -0.5", "height = -0.5 m is outside 0.02 ... 1.5 m"),
    ("plan --out x --platform-m 5", "platform = 5 m is outside -1 ... 1 m"),
    ("plan --out x --rotation-deg 1e400", "rotation must be finite, got inf"),
    ("plan --out x --rotation-deg 350",
     "rotation = 350 deg: the robot lands on its feet only after a multiple of 360 deg; nearest is 360 deg"),
    ("plan --out x --method magic",
     "argument --method: invalid choice: 'magic' (choose from 'usual', 'three-step', 'direct'); " + HELP_PLAN),
    ("plan --out x --robot asimo",
     f"robot 'asimo': neither a shipped robot ({', '.join(SHIPPED)}) nor a readable TOML file"),
    ("plan --out=", "--out must name a folder, got ''"),
    ("plan --out /dev/null/x", "the folder '/dev/null/x' cannot be written (Not a directory); choose another one"),
    ("simulate", "the following arguments are required: DIR; 'jumplab simulate --help' shows what is possible"),
    ("simulate nowhere", "there is no folder 'nowhere'; make a plan with 'jumplab plan --out' first"),
    ("simulate .", "'.' holds no finished plan (summary.json is missing); make one with 'jumplab plan'"),
    ("trials .", "'.' holds no finished plan (summary.json is missing); make one with 'jumplab plan'"),
    ("trials . --n 0", "--n must be a whole number from 1 to 100000, got '0'"),
    ("trials . --n 2.5", "--n must be a whole number from 1 to 100000, got '2.5'"),
    ("trials . --seed -1", "--seed must be a whole number from 0 to 2147483647, got '-1'"),
    ("trials . --jobs 0", "--jobs must be a whole number from 1 to 4096, got '0'"),
    ("trials . --reaim yes", "unrecognized arguments: yes; " + HELP),
    ("run --parameter fast", "--parameter must be NAME=VALUE, got 'fast'"),
    ("run -p height_m=1", "--parameter height_m is given twice, or has an option of its own; set it once"),
    ("run -p out=1", "the runner sets the notebook parameter 'out' itself; pass the folder as its argument out"),
    ("run --out /dev/null/x", "the folder '/dev/null/x' cannot be written (Not a directory); choose another one"),
]  # fmt: skip


@pytest.mark.parametrize(("command", "sentence"), REFUSALS, ids=[c for c, _ in REFUSALS])
def test_refusal(capsys, here, command, sentence):
    assert one_sentence(*run(capsys, *command.split())) == sentence
    assert names(here) == []


def test_seeded_random_bad_inputs(capsys, here):
    """Never a traceback, never accepted, never a file, never slow. API and notebooks: test_fuzz.py."""
    rng = random.Random(12)
    bad = [*"nan -nan inf -inf 1e999 one 1,0 0x10 -- - 1m ½ 10 -7.5 1e17".split(), "", " "]
    options = ["--distance-m", "--height-m", "--platform-m"]
    for _ in range(100):
        junk = "".join(rng.choices(string.printable, k=rng.randint(1, 12)))
        argv = {
            0: ["plan", "--out", "x", rng.choice(options), rng.choice(bad)],
            1: ["plan", "--out", "x", f"{rng.choice(options)}={rng.choice(bad)}"],
            2: ["plan", "--out", "x", "--rotation-deg", rng.choice([*bad, "90", "-361", "720.5"])],
            3: ["plan", "--out", "x", "--robot", f"{junk}?"],
            4: ["plan", "--out", f"/dev/null/{junk}"],
            5: [rng.choice(["simulate", "audit", "trials"]), f"no {junk}"],
            6: ["run", "--distance-m", rng.choice(bad)],
            7: ["run", "-p", f"no_such{rng.randint(0, 99)}={junk}"],
            8: [rng.choice(["plan", "run", "simulate", "audit", "trials"]), f"--{junk}", "x"],
            9: [f"{junk}!"],
        }[rng.randrange(10)]
        one_sentence(*run(capsys, *argv))
        assert names(here) == [], argv


# ------------------------------------------------------------------------------------------ commands that go through


@pytest.fixture
def planner(bhr, monkeypatch):
    """A planner and an audit that answer at once; tests may change what they say."""
    said = types.SimpleNamespace(error=None, checks=[types.SimpleNamespace(name="slip", passed=True)], task=None)

    def plan_jump(planner, task, method, patience_s, starts):
        robot = planner.robot
        said.task, said.method, said.patience_s, said.starts = task, method, patience_s, starts
        if said.error:
            raise said.error
        plan = JumpPlan(task, robot, method, make_tape(robot), make_summary() | {"stages": STAGES})
        vars(plan)["audit"] = types.SimpleNamespace(sound=True, line=lambda: "all 1 checks passed")
        return plan

    def write_audit(folder):
        Path(folder, "passport.json").write_text("{}")
        words = f"all {len(said.checks)} checks passed"
        told = {"table": lambda: "the table", "to_json": lambda: "{}", "line": lambda: words}
        return types.SimpleNamespace(checks=said.checks, **told)

    monkeypatch.setattr("jumplab.studies.advice.plan_or_advise", plan_jump)
    monkeypatch.setattr("jumplab.auditing.write_audit", write_audit)
    return said


def test_plan_and_audit(capsys, odd_folder, planner):
    out = odd_folder / "plan"
    arguments = ("--distance-m", "-0.2", "--height-m", "3e-1", "--rotation-deg", "-360", "--method", "direct")
    code, said, err = run(capsys, "plan", "--out", out, *arguments, "--gravity", "3.7")
    assert (code, err) == (0, "")
    assert planner.task.gravity == 3.7
    assert planner.task.distance_m == -0.2 and planner.task.height_m == 0.3 and planner.method == "direct"
    assert planner.task.rotation_rad == pytest.approx(-2 * 3.141592653589793)
    assert said.splitlines()[:4] == [
        "stage        iterations  build_s  solve_s",
        "-----------  ----------  -------  -------",
        "SRMP launch          31     0.25     0.12",
        "planned: distance 1.000 m, rise 0.500 m",
    ]
    assert names(out) == ["passport.json", "plan.npz", "robot.toml", "robot.urdf", "summary.json"]
    code, said, err = run(capsys, "audit", out)
    assert (code, said, err) == (0, "the table\naudit: all 1 checks passed\n", "")


def test_plan_that_fails_its_audit(capsys, here, planner):
    planner.checks.append(types.SimpleNamespace(name="friction", passed=False))
    code, _, err = run(capsys, "plan", "--out", "p")
    assert code == 3
    assert err == ("jumplab: the plan fails 1 of 2 checks of its audit (friction); see passport.json in 'p'\n")


@pytest.mark.parametrize(
    ("error", "code", "sentence"),
    [
        (InfeasibleError("too high\n for this robot"), 3, "too high for this robot"),
        (SolverError("stage 1 stopped", stage="SRMP launch"), 3, "stage 1 stopped"),
        (ZeroDivisionError("x\ny"), 4,
         "internal failure, ZeroDivisionError: x; run it again with --debug for the traceback"),
        (KeyboardInterrupt(), 130, "interrupted; what was there before is unchanged"),
    ],
)  # fmt: skip
def test_failed_plan(capsys, here, planner, error, code, sentence):
    planner.error = error
    assert one_sentence(*run(capsys, "plan", "--out", "p"), expected_code=code) == sentence
    assert names(here) == []


def test_debug_shows_the_traceback(capsys, here, planner):
    planner.error = ZeroDivisionError("x")
    for argv in (["--debug", "plan", "--out", "p"], ["plan", "--out", "p", "--debug"]):
        code, _, err = run(capsys, *argv)
        assert code == 4
        assert "Traceback (most recent call last)" in err
        assert err.endswith("\njumplab: internal failure, ZeroDivisionError: x\n")


SIMULATED = [
    (METRICS, "simulated: distance 1.002 m, rise 0.497 m\nlanding: stands, 3.40 s on its feet after touchdown (stood)\n"
              "checks: all 1 of the run passed\n"),
    (FALL, "simulated: distance none, rise none\nlanding: FAILED, 0.00 s on its feet after touchdown (fell)\n"
           "CHECK FAILED: mass 43 kg, at most 42.5: another robot\n"),
]  # fmt: skip


@pytest.mark.parametrize(("metrics", "lines"), SIMULATED)
def test_simulate(capsys, bhr, tmp_path, monkeypatch, metrics, lines):
    class Simulated(Result):
        def to_json(self):
            return metrics

    simulation = importlib.import_module("jumplab.sim")
    asked = {}

    def simulate(tape, robot, *, mode, scene, **kw):
        asked.update(mode=mode, scene=scene)
        return Simulated()

    monkeypatch.setattr(simulation, "simulate_jump", simulate)
    target = {"distance_m": 1.0, "height_m": 0.5, "platform_m": 0.3}
    store.write_plan(tmp_path, make_tape(bhr), bhr, make_summary() | {"target": target, "platform_edge_m": 0.71})
    code, said, err = run(capsys, "simulate", tmp_path, "--mode", "pd")
    assert (code, said, err) == (0, lines, "")
    assert asked["mode"] == "pd"
    assert [asked["scene"].top_at(x) for x in (0.0, 0.82, 0.84, 1.0)] == [0.0, 0.0, 0.3, 0.3]
    assert json.loads((tmp_path / "simulation.json").read_text())["planned_rise_m"] == 0.5


def test_help_is_quick_and_complete():
    """Asked of a new process: help must not import the numerical libraries."""
    code = (
        "import sys; from jumplab.cli import check_parameters; from jumplab.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit as e: assert not e.code\n"
        "print(sorted({'numpy', 'casadi', 'pinocchio', 'pybullet', 'papermill'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert all(word in done.stdout for word in ("run", "plan", "simulate", "trials", "audit", "--debug"))
    assert done.stdout.splitlines()[-1] == "[]" and done.stderr == ""


def test_version_and_a_reader_that_goes_away():
    done = subprocess.run([sys.executable, "-m", "jumplab", "--version"], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0 and done.stdout.startswith("jumplab ")
    command = f"'{sys.executable}' -m jumplab --version | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=ROOT)
    assert done.stderr == ""


# ------------------------------------------------------------------------------------------ the real thing


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """The paper's jump, by the command line."""
    folder = tmp_path_factory.mktemp("real") / "plan"
    command = [sys.executable, "-m", "jumplab", "plan", "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and "audit: all" in done.stdout
    return folder


def test_real_plan_is_self_contained(planned):
    assert names(planned) == ["passport.json", "plan.npz", "robot.toml", "robot.urdf", "summary.json"]
    summary = store.read_plan(planned)[2]
    assert summary["planned_distance_m"] == pytest.approx(1.0, abs=0.02)
    assert summary["planned_rise_m"] == pytest.approx(0.5, abs=0.02)
    assert all({"stage", "iterations", "build_s", "solve_s"} <= set(row) for row in summary["stages"])


@pytest.mark.slow
def test_a_real_refusal_and_its_exit_code(capsys, here):
    said = one_sentence(*run(capsys, "plan", "--out", "p", "--height-m", "1.4", "--patience", "4"), 3)
    assert said.startswith("whole body: no plan (")
    assert names(here) == []


def test_without_pybullet_mujoco_plays_the_plan(planned):
    """A new process that finds no PyBullet: MuJoCo is the default, and who asks for PyBullet is told how to get it."""
    code = "import sys; sys.modules['pybullet'] = None\nfrom jumplab.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "simulate", str(planned)]
    before = names(planned)
    refused = subprocess.run([*command, "--engine", "bullet"], capture_output=True, text=True, cwd=ROOT)
    assert (refused.returncode, refused.stdout, names(planned)) == (2, "", before)
    sentence = "jumplab: engine 'bullet': the package pybullet is not installed; take 'mujoco', or pip install "
    assert refused.stderr.startswith(sentence) and len(refused.stderr.splitlines()) == 1
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "") and "landing: stands" in done.stdout
    assert store.read_json(planned / "simulation.json")["settings"]["engine"]["name"] == "mujoco"
