"""Published robots from the optional package example-robot-data: shipped configurations and true refusals."""

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures_core import refused
from fixtures_robots import reduction_error

import jumplab as jl
from jumplab.auditing import audit
from jumplab.cli.main import main
from jumplab.errors import RobotError, SolverError
from jumplab.io.motion import Motion
from jumplab.io.whole import Whole
from jumplab.robot import Robot
from jumplab.robot.files import SHIPPED, read_toml
from jumplab.robot_import.checkup import check
from jumplab.robot_import.roles import draft
from jumplab.robot_import.urdf import PACKAGE, have_published, locate
from jumplab.sim import INSTALLED, Scene, simulate_jump
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import Contacts
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.coordinates import even
from jumplab.stages.whole_body.mode import Mode
from jumplab.stages.whole_body.settings import Limits, Weights
from jumplab.stages.whole_body.terms import smoothness, touchdown_rows
from jumplab.task import JumpTask

DOWNLOADED = [name for name, path in SHIPPED.items() if "robot_descriptions:" in path.read_text()]
SPATIAL = ("g1_arms", "g1", "g1_29")
PUBLISHED = [name for name in SHIPPED if name not in ("bhr", *SPATIAL, *DOWNLOADED)]


here = pytest.mark.skipif(not have_published(), reason=f"the optional package {PACKAGE} is not installed")


def urdf(name: str):
    return locate(f"{PACKAGE}:{name}", SHIPPED["bhr"].parent)


@pytest.mark.skipif(have_published(), reason="the published robots are there")
def test_without_the_package_the_way_to_it_is_told():
    assert refused(Robot.load, "g1", by=RobotError).endswith("pip install 'jumplab[robots]'")


KG = {"g1_legs": 33.341, "talos": 93.336, "romeo": 40.529, "alexander": 49.081}


def is_as_configured(name: str, robot: Robot, repair: tuple[str, ...]) -> None:
    """Five links are the full robot, and what is found in the URDF is what the configuration says."""
    config = read_toml(SHIPPED[name].read_text(), name)
    found = draft(locate(config["urdf"], SHIPPED[name].parent), repair).roles
    assert found.joints == robot.joints
    assert (found.trunk, found.forward, found.up) == tuple(config["source"][k] for k in ("trunk", "forward", "up"))
    assert not robot.planar or reduction_error(robot).max() < 1e-9


@here
@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_robot_is_what_its_configuration_says(name):
    robot = Robot.load(name)
    assert robot.planar and robot.total_mass == pytest.approx(KG[name], abs=1e-3)
    is_as_configured(name, robot, ("inertia",))


@here
def test_motors_of_the_g1_are_the_makers():
    knee, hip = (Robot.load("g1").actuators[f"left_{name}_joint"] for name in ("knee", "hip_yaw"))
    told = ("effort", "speed", "corner_speed", "no_load_speed", "armature", "friction", "damping")
    assert [knee[key] for key in told] == pytest.approx([111.0, 20.0, 14.5, 22.7, 0.025101925, 2.4, 0.24])
    assert [hip[key] for key in told[2:4]] == pytest.approx([22.63, 35.52])


@here
@pytest.mark.slow
@pytest.mark.parametrize("name, target", [("g1_legs", (0.4, 0.2)), ("g1", (0.3, 0.15)), ("talos", (0.2, 0.05))])
def test_planned_clean_and_landed(name, target):
    robot = Robot.load(name)
    plan = Planner(robot).plan(JumpTask(*target))
    report = audit(plan.tape, plan.robot, plan.task)
    assert [c.name for c in report.checks if not c.passed] == []
    # drives that do not know the base let a G1 that stands on its toes fall back by 1.2 cm of travel
    for mode, place_m in (("whole-body", 0.01), ("position", 0.02)):
        scene = Scene.of_plan(plan.summary, plan.robot)
        result = simulate_jump(plan.tape, plan.robot, scene=scene, mode=mode).to_json()
        assert result["landed"], result["reason"]
        assert result["foot_distance_m"] == pytest.approx(target[0], abs=place_m)
        assert result["com_rise_m"] == pytest.approx(target[1], abs=0.01)


@here
def test_the_whole_g1_moves_evenly():
    """Waist and arms: half of the unknowns, and a cost that keeps those without a role near the stance; arms alone
    have none.
    """
    body, arms = (Body(Robot.load(name)) for name in ("g1", "g1_arms"))
    assert [even(x).free_names[-5:] for x in (body, arms)] == [
        tuple(
            [
                "waist_pitch_joint",
                *(f"left_{x}_joint" for x in ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")),
            ]
        ),
        tuple(f"left_{x}_joint" for x in ("ankle_pitch", "ankle_roll", "shoulder_pitch", "shoulder_roll", "elbow")),
    ]
    names = [body.model.names[k] for k in body.upper]
    assert names[:3] == [body.model.names[k] for k in body.waist]
    assert (
        names[:3] == ["waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint"] and len(names) == 9 and not arms.upper
    )
    for x, kept in ((body, {"waist and arms", "waist at touchdown"}), (arms, set())):
        flight = Mode(x, Limits(), Weights(), "", even(x))
        terms = {term.name for term in (*smoothness(flight), *touchdown_rows(flight))}
        assert terms & {"waist and arms", "waist at touchdown"} == kept


@here
@pytest.mark.slow
def test_the_g1_runs_up_and_leaves_from_one_foot():
    robot = Robot.load("g1_arms")
    plan = Planner(robot).follow(Contacts.run_up(robot))
    report = plan.audit
    assert report.passed, report.table()
    assert plan.tape.extra["contacts"][plan.tape.takeoff_index - 1].tolist() == [0, 1]  # the right one, on its toes


@here
def test_too_much_is_refused_in_words():
    assert "take-off speed" in refused(Planner(Robot.load("talos")).plan, JumpTask(0.3, 1.2), by=SolverError)


ALLOWED = ("inertia", "massless")
REFUSED = [
    ("bolt_description/robots/bolt.urdf", (), r"no pair of mirrored legs with three revolute pitch joints"),
    ("simple_humanoid_description/urdf/simple_humanoid.urdf", ALLOWED,
     r"'LARM_LINK2': moment of inertia 1 kg m\^2 on 0\.6 kg is a radius of gyration of 1\.29 m"),
    ("human_description/robots/human.urdf", (), r"link 'left_upperleg_virtual': has no <inertial>"),
    ("cassie_description/robots/cassie.sdf", (), r"the root element is <sdf>, an SDF file, not a URDF$"),
    ("icub_description/robots/icub.urdf", ALLOWED,
     r"joint 'l_hip_pitch': velocity = 100 rad/s is above 60: deg/s or a placeholder; .* \[limits\.hip_pitch\]"),
]  # fmt: skip


@here
@pytest.mark.parametrize(("name", "repair", "words"), REFUSED, ids=[x[0].split("/")[-1] for x in REFUSED])
def test_no_jumper_and_why(name, repair, words):
    with pytest.raises(RobotError, match=words):
        check(urdf(name), draft(urdf(name), repair).text)


# robots that are downloaded one by one -----------------------------------------------------------------------------
def fetched(name: str) -> Robot:
    pytest.importorskip("robot_descriptions")
    try:
        return Robot.load(name)
    except RobotError as e:
        assert "cannot fetch it" in str(e)
        pytest.skip(str(e))


@pytest.fixture(params=DOWNLOADED)
def downloaded(request) -> tuple[str, Robot]:
    return request.param, fetched(request.param)


@pytest.mark.slow
def test_a_downloaded_robot_is_what_its_configuration_says(downloaded):
    is_as_configured(*downloaded, ())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["h1", "h1_2"])
@pytest.mark.parametrize("engine", INSTALLED)
def test_legs_whose_axes_coincide_are_led_by_their_angles(name, engine):
    """Without roll at the ankle, or with yaw and roll about one axis where the thigh is level."""
    robot = fetched(name)
    plan = Planner(robot).plan(JumpTask(0.3, 0.15))
    m = simulate_jump(plan.tape, robot, engine=engine).metrics
    assert m.foot_distance_m == pytest.approx(0.3, abs=0.005) and m.com_rise_m == pytest.approx(0.15, abs=0.003)


def test_another_file_of_a_downloaded_robots_repository(monkeypatch, tmp_path):
    known = SimpleNamespace(DESCRIPTIONS={"x_description": None})
    monkeypatch.setitem(sys.modules, "robot_descriptions._descriptions", known)
    module = SimpleNamespace(URDF_PATH=str(tmp_path / "x.urdf"), REPOSITORY_PATH=str(tmp_path))
    monkeypatch.setitem(sys.modules, "robot_descriptions.x_description", module)
    monkeypatch.setitem(sys.modules, "robot_descriptions", SimpleNamespace())
    assert locate("robot_descriptions:x_description", tmp_path / "a") == tmp_path / "x.urdf"
    assert locate("robot_descriptions:x_description:b/y.urdf", tmp_path / "a") == tmp_path / "b/y.urdf"
    with pytest.raises(RobotError, match=r"^robot description 'y': robot_descriptions has no robot of that name$"):
        locate("robot_descriptions:y", tmp_path)


def test_a_list_downloads_nothing(monkeypatch, capsys):
    monkeypatch.setattr("jumplab.robot_import.urdf.described", None)
    assert main(["robot", "list", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["robots"]}
    assert set(rows) == set(SHIPPED)
    assert all(rows[name]["note"].startswith("is downloaded when it is first loaded") for name in DOWNLOADED)


def test_stored_maps_are_of_robots_that_ship():
    from paper import shipped

    table = shipped.rows()
    assert set(table) == set(SHIPPED)
    for name, row in table.items():
        found = shipped.mapped(row)
        assert len(found.cells) == len(found.distances) * len(found.heights)
        assert all(c.share <= 1 for c in found.cells if c.solved)
        try:
            robot = Robot.load(name)
        except RobotError:
            continue
        assert row["hash"] == robot.hash, "python -m paper.shipped measures it again"


def test_the_book_has_the_stored_jumps():
    from paper import shipped

    page = (Path(__file__).parent.parent / "notebooks" / "book" / "robots.md").read_text(encoding="utf-8")
    for line in shipped.verdicts():
        name, *cells = map(str, line.values())
        assert re.search(rf"^\| `{name}`, [^|]+ \| {re.escape(' | '.join(cells))} \|$", page, re.M), line


@here
@pytest.mark.slow
def test_held_waists_stay_within_their_motors():
    """Of the published robot, by another way: inverse dynamics of all joints along the exported motion."""
    for name in ("g1_legs", "g1_arms"):
        plan = jl.plan(jl.JumpTask(0.4, 0.2), name)
        whole = Whole(plan.robot)
        k = whole.joints.index("waist_pitch_joint")
        needed = np.abs(whole.frames(Motion.of(plan.tape), 1000.0).tau[:, k]).max()
        motor = whole.model.upperEffortLimit[6:][whole.order][k]
        (check,) = (x for x in plan.audit.checks if x.name == "torque of locked joints")
        assert check.value == pytest.approx(100 * needed / motor, rel=0.01) and "waist_pitch_joint" in check.note
        assert 0.8 * motor < needed <= motor  # it binds
