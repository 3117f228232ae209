"""``jumplab robot`` from the outside."""

import sys
from types import ModuleType

import pytest
from fixtures_robots import GOOD, config, held_arms, mirrored, write
from matplotlib.figure import Figure

from jumplab.cli.main import main
from jumplab.robot import Robot
from jumplab.show.bodies import robot_sheet


def quoted(capsys, *argv) -> tuple[int, str, str]:
    code = main(["robot", *map(str, argv)])
    out, err = capsys.readouterr()
    return code, out, err


def test_check_finds_draws_and_writes_what_can_be_loaded(capsys, tmp_path, monkeypatch):
    (tmp_path / "my.urdf").write_text(mirrored()[0])
    code, out, err = quoted(capsys, "check", tmp_path / "my.urdf", "--out", tmp_path / "out")
    assert (code, err) == (0, "")
    assert "42.000 kg (42.000 kg in the XML), 14 of 14 joints move" in out
    assert "left_knee" in out and "+y -y" in out and "sole: from its box" in out
    assert (tmp_path / "out" / "bhr.png").stat().st_size > 10_000
    robot = Robot.load(str(tmp_path / "out" / "bhr.toml"))
    assert robot.joints["knee"] == ("left_knee", "right_knee")
    monkeypatch.setattr("jumplab.show.bodies.robot_sheet", lambda robot: Figure())  # drawn before
    again = ("check", tmp_path / "my.urdf", "--out", tmp_path / "out")
    assert quoted(capsys, *again)[0] == 0  # unedited, it is written anew
    toml = tmp_path / "out" / "bhr.toml"
    toml.write_text(toml.read_text().replace("knee_rad = 0.5", "knee_rad = 0.6"))
    code, _, err = quoted(capsys, *again)
    said = "has been edited, or another version wrote it; choose another --out, or overwrite it with --force"
    assert (code, err) == (2, f"jumplab: {toml}: {said}\n")
    assert quoted(capsys, *again, "--force")[0] == 0 and "knee_rad = 0.5" in toml.read_text()


def test_check_takes_a_persons_word(capsys, tmp_path):
    path = write(tmp_path, mirrored)
    code, out, _ = quoted(capsys, "check", path.replace(".toml", ".urdf"), "--config", path)
    assert code == 0 and "robot mirrored" in out


@pytest.fixture
def library(monkeypatch, tmp_path):
    """A package robot_descriptions of three robots; the third cannot be fetched."""
    (tmp_path / "my.urdf").write_text(mirrored()[0])
    known = ("mine_description", "theirs_description", "lost_description")
    package, table = ModuleType("robot_descriptions"), ModuleType("robot_descriptions._descriptions")
    package.__path__, table.DESCRIPTIONS = [str(tmp_path)], dict.fromkeys(known)
    (tmp_path / "mine_description.py").write_text(f"URDF_PATH = {str(tmp_path / 'my.urdf')!r}")
    (tmp_path / "theirs_description.py").write_text("XACRO_PATH = 'x.xacro'")
    (tmp_path / "lost_description.py").write_text("raise OSError('git:\\nno route to host')")
    for module in (package, table):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    for name in known:
        monkeypatch.delitem(sys.modules, f"robot_descriptions.{name}", raising=False)


def test_a_robot_of_the_common_library(capsys, tmp_path, library):
    code, out, err = quoted(capsys, "check", "--robot-description", "mine_description")
    assert (code, err) == (0, "") and out.startswith(f"robot description: {tmp_path / 'my.urdf'}\n")


@pytest.mark.parametrize("name, sentence", [
    ("theirs_description", "is a xacro template only; expand it, and check the URDF"),
    ("lost_description", "robot_descriptions cannot fetch it (no route to host)"),
    ("mine_descripton", "robot_descriptions has no robot of that name; did you mean mine_description, "
                        "theirs_description, lost_description?"),
    ("x", "robot_descriptions has no robot of that name"),
])  # fmt: skip
def test_descriptions_that_are_not_there(capsys, library, name, sentence):
    code, _, err = quoted(capsys, "check", "--robot-description", name)
    assert (code, err.strip()) == (2, f"jumplab: robot description {name!r}: {sentence}")


def test_without_that_library(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    code, _, err = quoted(capsys, "check", "--robot-description", "g1_description")
    assert (code, err.strip()) == (2, "jumplab: robot description 'g1_description': the package robot_descriptions is "
                                      "not installed; pip install 'jumplab[descriptions]'")  # fmt: skip


@pytest.mark.parametrize("argv, sentence", [
    ((), "jumplab: jumplab robot: choose an action: check or list; 'jumplab robot --help' shows what is possible"),
    (("check", "bhr"),
     "jumplab: 'bhr' is the default robot, and its description needs no check; give another robot"),
    (("check", "x.urdf", "--repair", "all"), "jumplab: --repair accepts inertia, massless, got 'all'"),
    (("check",), "jumplab: jumplab robot check: give either a URDF or --robot-description"),
    (("check", "x.urdf", "--robot-description", "g1_description"),
     "jumplab: jumplab robot check: give either a URDF or --robot-description"),
    (("check", "/no/such.urdf"), "jumplab: /no/such.urdf: there is no such file; give the path of a URDF"),
    (("check", "x.urdf", "--config", "/no/such.toml"),
     "jumplab: --config /no/such.toml: cannot be read as text (FileNotFoundError)"),
])  # fmt: skip
def test_bad_input_in_one_sentence(capsys, argv, sentence):
    code, _, err = quoted(capsys, *argv)
    assert (code, err.strip()) == (2, sentence)


def test_all_faults_are_shown(capsys, tmp_path):
    (tmp_path / "my.urdf").write_text(GOOD.replace('mass value="5"', 'mass value="-5"'))
    code, out, err = quoted(capsys, "check", tmp_path / "my.urdf")
    assert code == 2 and "left_thigh" in err and "(1 further fault is printed above)" in err and "right_thigh" in out


def test_roles_are_told_in_spite_of_faults_and_limits_all_at_once(capsys, tmp_path):
    """An inertia far from a solid's is refused with the flag that mends it; placeholders of torque after each other."""
    wrong = GOOD.replace('<inertia ixx="', '<inertia ixx="-', 1)
    (tmp_path / "my.urdf").write_text(wrong)
    code, out, err = quoted(capsys, "check", tmp_path / "my.urdf", "--out", tmp_path / "out")
    assert code == 2 and "--repair inertia" in err and "knee: left_knee, right_knee" in out
    assert not (tmp_path / "out").exists()
    (tmp_path / "my.urdf").write_text(GOOD.replace('effort="210"', 'effort="1e9"'))
    code, out, err = quoted(capsys, "check", tmp_path / "my.urdf", "--out", tmp_path / "out")
    assert code == 2 and "effort = 1e+09 N m is above 2000" in err and "(1 further fault is printed above)" in err
    assert (tmp_path / "out" / "bhr.toml").is_file()  # there the limits are told


def test_a_configuration_without_source_is_refused(capsys, tmp_path):
    (tmp_path / "my.urdf").write_text(GOOD)
    (tmp_path / "my.toml").write_text(config("my").replace("[source]", "[other]"))
    code, _, err = quoted(capsys, "check", tmp_path / "my.urdf", "--config", tmp_path / "my.toml")
    assert code == 2 and "the table [source] is missing" in err


def test_sheet_of_a_robot_with_and_without_arms(bhr, tmp_path):
    for robot in (bhr, Robot.load(write(tmp_path, held_arms))):
        texts = [t.get_text() for ax in robot_sheet(robot).axes for t in ax.texts]
        assert ("arms held" in texts) == (not robot.joints["shoulder_pitch"])
