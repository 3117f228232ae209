"""Pages of a jump: nothing outside them is needed, they move as Pinocchio says, and a real browser shows them."""

import base64
import json
import os
import re
import shutil
import subprocess
import tempfile
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.colors as mcolors
import matplotlib.image
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump, on_file, refused
from fixtures_robots import needs_published
from scipy.spatial import cKDTree
from test_cli import one_sentence, run
from test_store import names

from jumplab.io import folder as store
from jumplab.io.motion import Motion
from jumplab.robot import Robot
from jumplab.robot.files import files_of
from jumplab.robot_import.checkup import examine
from jumplab.robot_import.urdf import locate
from jumplab.show import shapes
from jumplab.show import viewer as viewer
from jumplab.show.style import PHASE_COLORS
from jumplab.sim import Scene

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--window-size=1280,720 --virtual-time-budget=4000 --enable-logging=stderr"
).split()
STAGE = slice(64, 555)  # rows of a picture between the header and the curves
browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: apt-get install chromium")


@pytest.fixture(scope="module")
def page(simulation):
    """The page of the default jump, planned and simulated."""
    p = jump(1.0, 0.5)
    return viewer.page(p.robot, plan=p.tape, simulation=simulation, task=p.task)


def facts_of(page):
    return json.loads(re.search(r"^const facts = (.*);$", page.html, re.M)[1])


# the file -------------------------------------------------------------------------------------------------------
class Outside(HTMLParser):
    """Collects everything by which a page could ask for something outside itself."""

    def __init__(self):
        super().__init__()
        self.found, self.tags = [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.found += [(tag, k, v) for k, v in attrs if k in ("src", "href", "srcset", "data", "action", "background")]


def test_page_needs_nothing_outside_itself(page):
    parser = Outside()
    parser.feed(page.html)
    assert parser.found == [] and not {"link", "iframe", "img", "base", "object", "embed"} & set(parser.tags)
    assert set(re.findall(r"https?://[^\s\"'`<>\\]+", page.html)) == {"http://www.w3.org/1999/xhtml"}  # a name space
    text = re.sub(r"[A-Za-z0-9+/=]{200,}", "", page.html).lower()  # without encoded poses, where any word may appear
    assert "@import" not in text and "cdn" not in text.replace("cdnumber", "")
    assert page.html.count("</script>") == 2 and len(page.html) < 3e6


def test_pages_are_alike(page, simulation):
    p = jump(1.0, 0.5)
    assert viewer.page(p.robot, plan=p.tape, simulation=simulation, task=p.task).html == page.html


def test_page_in_a_notebook_stands_in_a_frame_of_its_own(page):
    text = page._repr_html_()
    parser = Outside()
    parser.feed(text)
    assert parser.found == [] and parser.tags.count("iframe") == 1 and "script" not in parser.tags
    assert 'sandbox="allow-scripts"' in text and text.count("<") < 10  # the page itself is escaped


def test_poses_are_those_of_the_log(page, simulation, bhr):
    model, data, facts = bhr.model, bhr.model.createData(), facts_of(page)
    assert facts["fps"] == 50 and [c["name"] for c in facts["clips"]] == ["simulation", "plan"]
    for clip, record in zip(facts["clips"], (simulation, jump(1.0, 0.5).tape), strict=True):
        poses = np.frombuffer(base64.b64decode(clip["poses"]), "<f4").reshape(clip["frames"], clip["bodies"], 7)
        assert clip["frames"] == int(record.t[-1] * 50 + 1e-6) + 1
        for k in range(0, clip["frames"], 7):
            row = int(np.argmin(np.abs(record.t - k / 50)))
            pin.framesForwardKinematics(model, data, record.q[row])
            for j in range(1, model.njoints):
                frame = data.oMf[model.getFrameId(model.names[j])]
                assert poses[k, j - 1, :3] == pytest.approx(frame.translation, abs=1e-4)
                turn = pin.Quaternion(poses[k, j - 1, 3:].astype(float)).normalized().toRotationMatrix()
                assert turn == pytest.approx(frame.rotation, abs=1e-3)
    starts = {name: t for t, _, name in facts["clips"][0]["phases"]}
    assert list(starts) == ["launch", "flight", "landing"] and starts["launch"] == 0
    assert starts["flight"] == pytest.approx(simulation.metrics.liftoff_s, abs=0.021)
    assert starts["landing"] == pytest.approx(simulation.metrics.touchdown_s, abs=0.021)


def test_weight_is_that_under_the_gravity_of_the_jump(bhr):
    moon, tape = bhr.under_gravity(1.62), jump(0.5, 0.3).tape
    weights = [facts_of(viewer.page(robot, plan=tape))["weight"] for robot in (bhr, moon)]
    assert weights == pytest.approx([42.0 * 9.8, 42.0 * 1.62])


def packed(clip, name, *shape):
    return np.frombuffer(base64.b64decode(clip[name]), "<f4").reshape(clip["frames"], *shape).astype(float)


def test_forces_stand_on_the_soles_and_carry_the_jump(page, simulation, bhr):
    """Their points lie within the soles on the ground, and their sum over time is the impulse of the record."""
    model, data = bhr.model, bhr.model.createData()
    for clip, record in zip(facts_of(page)["clips"], (simulation, jump(1.0, 0.5).tape), strict=True):
        forces, logged = packed(clip, "forces", 2, 6), Motion.of(record).wrench[:, :, :3]
        touching = ~np.isnan(forces[:, :, 2])
        phase = Motion.of(record).every(50).phase
        assert touching[phase == "launch"].mean() > 0.97 and touching[phase == "flight"].mean() < 0.1
        assert np.abs(forces[:, :, 2][touching]).max() == 0.0  # level ground
        for k in np.flatnonzero(touching.all(axis=1))[::9]:
            pin.framesForwardKinematics(model, data, record.q[int(np.argmin(np.abs(record.t - k / 50)))])
            for foot, frame in enumerate(bhr.foot.frames):
                place = data.oMf[model.getFrameId(frame)]
                x, y, _ = place.actInv(np.array([*forces[k, foot, :2], place.act(bhr.foot.center)[2]]))
                assert bhr.foot.heel - 5e-3 < x < bhr.foot.toe + 5e-3 and abs(y) < bhr.foot.half_width + 5e-3
        impulse = np.nansum(forces[:, :, 3:], axis=(0, 1)) / 50
        whole = (logged.sum(axis=1)[1:] * np.diff(record.t)[:, None]).sum(axis=0)
        assert impulse == pytest.approx(whole, abs=0.02 * whole[2])


def test_figures_and_curves_are_those_of_the_simulation(page, simulation, bhr):
    clip, row = facts_of(page)["clips"][0], 30
    distance, rise, height, *_ = values = packed(clip, "values", 10 + 2 * len(bhr.joint_names)).T
    at = [int(np.argmin(np.abs(simulation.t - k / 50))) for k in range(clip["frames"])]
    assert height == pytest.approx(simulation.com[at, 2], abs=1e-5)
    assert rise.max() == pytest.approx(simulation.metrics.com_rise_m, abs=1e-3)
    assert distance[-1] == pytest.approx(simulation.metrics.foot_distance_m, abs=1e-4)
    for k, role in enumerate(("hip_pitch", "knee", "ankle_pitch")):
        name = bhr.joints[role][0]
        assert values[3 + k] == pytest.approx(np.degrees(simulation.angle[name][at]), abs=1e-3)
        both = [abs(simulation.torque[n][at[row]]) / bhr.actuators[n]["effort"] for n in bhr.joints[role]]
        assert values[6 + k, row] == pytest.approx(max(both), abs=1e-5)
    assert values[9, -1] == pytest.approx(1.0, abs=0.02)  # it stands
    for k, name in enumerate(bhr.joint_names):
        assert facts_of(page)["joints"][k] == name
        assert values[10 + 2 * k] == pytest.approx(np.degrees(simulation.angle[name][at]), abs=1e-3)
        share = abs(simulation.torque[name][at[row]]) / bhr.actuators[name]["effort"]
        assert values[11 + 2 * k, row] == pytest.approx(share, abs=1e-5)


def test_rounded_body_stands_on_the_soles_between_the_joints(bhr):
    """The default robot's feet end where its soles do, its legs reach from hip to ankle, a head is above its arms."""
    parts, said = shapes.parts_of(bhr)
    model, data = bhr.model, bhr.model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    world = [data.oMi[p.joint].act(pin.SE3.Identity()).homogeneous for p in parts]
    points = [p.points @ place[:3, :3].T + place[:3, 3] for p, place in zip(parts, world, strict=True)]
    feet = [model.frames[model.getFrameId(name)].parentJoint for name in bhr.foot.frames]
    sole = data.oMi[feet[0]].translation[2] + bhr.foot.sole_z
    assert said == [] and min(x[:, 2].min() for x in points) == pytest.approx(sole, abs=1e-9)
    hip, ankle = (data.oMi[model.getJointId(bhr.joints[r][0])].translation[2] for r in ("hip_pitch", "ankle_pitch"))
    legs = [x for x, p in zip(points, parts, strict=True) if p.kind == "limb" and p.joint in (model.supports[feet[0]])]
    assert min(x[:, 2].min() for x in legs) < ankle and max(x[:, 2].max() for x in legs) > hip
    assert max(x[:, 2].max() for x in points) == pytest.approx(0.295, abs=1e-6)  # the top of the head's box
    for part in parts:  # seen from outside: a closed surface whose volume is positive
        a, b, c = np.moveaxis(part.points[part.triangles] - part.points.mean(axis=0), 1, 0)
        assert np.einsum("ij,ij->i", a, np.cross(b, c)).min() > -1e-12


@needs_published
@pytest.mark.parametrize("name", ["g1_legs", "talos"])
def test_meshes_of_a_published_robot_lie_where_its_urdf_puts_them(name):
    """Pinocchio places the same meshes by the published URDF: all fill the same space, but for the coarseness."""
    robot = Robot.load(name)
    parts, said = shapes.parts_of(robot)
    assert said == ["published meshes, made coarser"]
    assert 10_000 < sum(len(p.triangles) for p in parts) <= shapes.TRIANGLES
    path = locate(*files_of(name)[:2])
    share = next(p for p in path.parents if p.name == "example-robot-data").parent
    model = pin.buildModelFromUrdf(str(path))
    geometry = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.VISUAL, package_dirs=str(share))
    q, data, places = pin.neutral(model), model.createData(), geometry.createData()
    for joint, angle in examine(name).lumped.held.items():
        if model.existJointName(joint):
            q[model.idx_qs[model.getJointId(joint)]] = angle
    pin.updateGeometryPlacements(model, data, geometry, places, q)
    corners = [pin.SE3(places.oMg[k]).act(np.array(v)) for k, g in enumerate(geometry.geometryObjects)
               if hasattr(g.geometry, "vertices") for v in g.geometry.vertices()]  # fmt: skip
    own, mine = robot.model, robot.model.createData()
    pin.forwardKinematics(own, mine, pin.neutral(own))
    drawn = np.concatenate([p.points @ mine.oMi[p.joint].rotation.T + mine.oMi[p.joint].translation for p in parts])
    source = np.array(corners)
    source += drawn.min(axis=0) - source.min(axis=0)  # the jumper's origin is another one
    away = [cKDTree(x).query(y)[0].max() for x, y in ((source, drawn), (drawn, source))]
    assert max(away) < 0.02, away  # no point is missing, none is elsewhere


@needs_published
def test_without_the_files_a_published_robot_is_drawn_from_boxes_and_the_page_says_so(monkeypatch):
    robot = Robot.load("g1_legs")
    monkeypatch.setattr("jumplab.robot_import.urdf.have_published", lambda: False)
    parts, said = shapes.parts_of(robot)
    assert said == ["drawn from boxes: its meshes are not known on this machine"]
    assert {p.kind for p in parts} == {"trunk", "limb", "rest"} and sum(len(p.triangles) for p in parts) < 20_000


@pytest.mark.parametrize(
    ("scene", "tops"),
    [
        (Scene.flat(), {0.0}),
        (Scene.level("platform", {0.5: 0.3}), {0.0, 0.3}),
        (Scene.level("ditch", {0.3: -0.6, 0.8: 0.0}), {0.0, -0.6}),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_ground_of_the_scene(bhr, scene, tops):
    drawn = facts_of(viewer.page(bhr, plan=jump(1.0, 0.5).tape, scene=scene))["ground"]
    heights = [round(box["middle"][2] + box["size"][2] / 2, 6) for box in drawn]
    assert set(heights) == tops
    for box, height in zip(drawn, heights, strict=True):  # every slab lies where the scene has that height
        for x in box["middle"][0] + box["size"][0] * np.linspace(-0.48, 0.48, 49):
            assert height in [b.top for b in scene.blocks if b.x_from <= x <= b.x_to]


def test_robot_whose_shapes_are_lost_keeps_its_limbs(bhr):
    """A mesh file does not travel with the robot's text; thighs and shanks stand between the joints all the same."""
    mesh = '<mesh filename="package://elsewhere/thigh.stl"/>'
    robot = Robot(re.sub(r"<box [^>]*/>", mesh, bhr.urdf), bhr.config_text)
    parts = facts_of(viewer.page(robot, plan=jump(1.0, 0.5).tape))["parts"]
    legs = [bhr.joints[role] for role in ("hip_pitch", "knee")]
    limbs = {bhr.model.getJointId(name) - 1 for pair in legs for name in pair}
    assert {part["joint"] for part in parts if part["kind"] == "limb"} == limbs


def test_nothing_to_show(bhr):
    assert refused(viewer.page, bhr) == "a page needs a plan or a simulation to show"


# the command ----------------------------------------------------------------------------------------------------
@pytest.fixture
def plan(tmp_path):
    return on_file(tmp_path / "plan", jump(1.0, 0.5))


def test_command(capsys, plan, odd_folder, simulation):
    code, said, err = run(capsys, "view", plan, "--out", odd_folder / "new" / "x.html")
    assert (code, err) == (0, "") and "1.00 m forward, CoM rise 0.50 m: plan: " in said
    assert names(odd_folder / "new") == ["x.html"] and not (plan / "jump.html").exists()
    store.write_simulation(plan, simulation, store.read_plan(plan)[2])
    assert run(capsys, "view", plan)[0] == 0
    clips = facts_of(viewer.Page((plan / "jump.html").read_text(), ""))["clips"]
    assert [c["name"] for c in clips] == ["simulation", "plan"]
    store.write_simulation(plan, simulation, store.read_plan(plan)[2])  # a new simulation: the page is no longer true
    assert not (plan / "jump.html").exists()


@pytest.mark.parametrize(
    ("out", "sentence"),
    [
        ("x.pdf", "--out must name a file that ends in .html, got 'x.pdf'"),
        ("/dev/null/x.html", "'/dev/null' is a file; choose a folder"),
        ("d.html", "'d.html' is a folder; name a file"),
    ],
)
def test_refusals(capsys, plan, tmp_path, monkeypatch, out, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "d.html").mkdir()
    before = names(plan)
    said = one_sentence(*run(capsys, "view", plan, "--out", out))
    assert said == sentence or said == "the folder '/dev/null' cannot be written (Not a directory); choose another one"
    assert names(tmp_path) == ["d.html", "plan"] and names(plan) == before and names(tmp_path / "d.html") == []


def test_damaged_simulation_is_told(capsys, plan):
    (plan / "simulation.npz").write_bytes(b"half")
    said = one_sentence(*run(capsys, "view", plan))
    assert said.endswith("simulation.npz: not a readable simulation (BadZipFile); simulate the plan again")
    assert not (plan / "jump.html").exists()


# the browser ----------------------------------------------------------------------------------------------------
def picture(url, folder):
    """Screenshot (720, 1280, 3) as 0 ... 1; the browser's profile is new and goes with the folder."""
    shot = folder / "shot.png"
    with tempfile.TemporaryDirectory(dir=folder) as profile:
        command = [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", f"--screenshot={shot}", url]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=180, cwd=folder, env=os.environ | {"HOME": str(folder)}
        )
    assert shot.is_file(), done.stderr[-2000:]
    assert "Uncaught" not in done.stderr, [line for line in done.stderr.splitlines() if "Uncaught" in line]
    image = matplotlib.image.imread(shot)[:, :, :3]
    shot.unlink()
    return image


def count(image, phase):
    """Pixels of the phase's hue, light or dark, between header and curves."""
    hsv = mcolors.rgb_to_hsv(image[STAGE])
    hue = mcolors.rgb_to_hsv(mcolors.to_rgb(PHASE_COLORS[phase]))[0]
    return int(((np.abs(hsv[:, :, 0] - hue) < 0.03) & (hsv[:, :, 1] > 0.3) & (hsv[:, :, 2] > 0.3)).sum())


def rows_of(image, phase):
    """Mean height of those pixels [pixels from the top]."""
    hsv = mcolors.rgb_to_hsv(image[STAGE])
    hue = mcolors.rgb_to_hsv(mcolors.to_rgb(PHASE_COLORS[phase]))[0]
    return float(np.nonzero((np.abs(hsv[:, :, 0] - hue) < 0.03) & (hsv[:, :, 1] > 0.3))[0].mean())


@browser
@pytest.mark.slow
def test_browser_shows_launch_flight_and_landing(page, tmp_path):
    """The robot is painted in its phase's colour, and higher in flight than before and after."""
    url = Path(page.save(tmp_path / "jump.html")).as_uri()
    seen = {
        "launch": picture(f"{url}#t=0.4", tmp_path),
        "flight": picture(f"{url}#t=1.1", tmp_path),
        "landing": picture(f"{url}#t=3.5&view=corner&follow=1", tmp_path),
    }
    for phase, image in seen.items():
        others = [count(image, p) for p in PHASE_COLORS if p != phase]
        assert count(image, phase) > 6000 and max(others) < 1500, (phase, count(image, phase), others)
    assert rows_of(seen["flight"], "flight") < rows_of(seen["launch"], "launch") - 60
    assert np.abs(seen["launch"] - seen["flight"]).max(axis=2).mean() > 0.01


@browser
@pytest.mark.slow
def test_browser_shows_the_frame_of_a_notebook(page, tmp_path):
    """As the output of a cell the page plays by itself, in its sandbox."""
    (tmp_path / "cell.html").write_text(f"<!DOCTYPE html><meta charset='utf-8'>{page._repr_html_()}", encoding="utf-8")
    image = picture((tmp_path / "cell.html").as_uri(), tmp_path)
    assert sum(count(image, phase) for phase in PHASE_COLORS) > 3000


@browser
@pytest.mark.slow
def test_browser_shows_a_plan_alone(tmp_path, bhr):
    page = viewer.page(bhr, plan=Motion.of(jump(1.0, 0.5).tape))
    image = picture(f"{page.save(tmp_path / 'plan.html').as_uri()}#t=1.0", tmp_path)
    assert count(image, "flight") > 6000
