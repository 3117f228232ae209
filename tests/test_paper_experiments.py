"""Pictures of the experiments: what lies where in a scene, what sensors say, and what the maps count."""

from dataclasses import asdict, replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_hex
from paper import experiments as pictures
from paper import worlds
from paper.basin import BasinGrid, BasinReport
from paper.measurement import measure
from test_show_simulations import smallest_font

from jumplab.show.style import GROUND, LANDING, MIN_FONT_PT, PAGE_IN, VERMILION, tint
from jumplab.sim import ENGINES, Engine, Scene, SensorNoise, simulate_jump
from jumplab.studies.trials import Trial, TrialKey, TrialSettings, wilson

DITCH = Scene.level("ditch", {0.3: -1.0, 0.75: 0.0})
SHORT_S = 0.3  # of standing: enough for a picture


@pytest.fixture(scope="module")
def result(good, bhr):
    return simulate_jump(good, bhr, scene=DITCH, stand_s=SHORT_S)


@pytest.fixture(autouse=True)
def no_simulation(result, monkeypatch):
    """No picture may simulate."""
    monkeypatch.setattr(Engine, "__init__", None)


def grounds(fig):
    ground = tint(GROUND, 0.35)
    corners = [p.get_xy() for p in fig.axes[0].patches if to_hex(p.get_facecolor()) == to_hex(ground)]
    return [(*x[:, 0][[0, 2]], x[:, 1].max()) for x in corners]


# ------------------------------------------------------------------------------------------ scenes


def test_a_ditch_is_a_gap_between_two_grounds(result, bhr):
    fig = pictures.scene_strobe(result, bhr, DITCH)
    (_, left_end, left_top), (right_start, _, right_top) = grounds(fig)  # the floor lies below the picture
    assert (left_end, left_top, right_start, right_top) == pytest.approx((0.3, 0.0, 0.75, 0.0))
    labels = [t.get_text() for t in fig.axes[0].texts]
    assert len(labels) == 5 and labels[0] == "0.00 s" and labels == sorted(labels)
    path = fig.axes[0].lines[0].get_xydata()
    assert path == pytest.approx(result.com[result.phase == "flight"][:, [0, 2]])
    assert smallest_font(fig) >= MIN_FONT_PT and fig.get_size_inches()[0] == PAGE_IN


def test_a_platform_has_its_height_and_edge(result, bhr):
    fig = pictures.scene_strobe(result, bhr, Scene.level("platform", {0.5: 0.4}))
    tops = {round(top, 6): start for start, _, top in grounds(fig)}
    assert tops[0.4] == pytest.approx(0.5) and 0.0 in tops


def test_a_jump_that_never_left_the_ground_is_shown_too(result, bhr):
    lazy = replace(result, phase=np.full(len(result.t), "launch"))
    assert len(pictures.scene_strobe(lazy, bhr, Scene.flat()).axes[0].texts) == 2


def test_rendered_frames_name_their_experiment(result, bhr):
    fig = pictures.experiment_frames([("A: ditch", result, DITCH), ("B: clean", result, Scene.flat())], bhr)
    assert len(fig.axes) == 12 and all(len(ax.images) == 1 and not ax.axison for ax in fig.axes)
    titles = [ax.get_title() for ax in fig.axes[:6]]
    assert titles[0] == "launch, 0.00 s"
    assert [t.split(",")[0] for t in titles] == ["launch"] * 3 + ["flight"] + ["landing"] * 2
    assert [t.get_text() for ax in fig.axes for t in ax.texts] == ["A: ditch", "B: clean"]
    assert smallest_font(fig) >= MIN_FONT_PT
    clean, gap = (np.asarray(fig.axes[k].images[0].get_array()) for k in (9, 3))
    ground = [(p[-20:] < 0.99).any(axis=(0, 2)).mean() for p in (clean, gap)]
    gap_share = 0.45 / pictures.WIDE_FRAME_M
    assert ground == pytest.approx([1.0, 1.0 - gap_share], abs=0.05)


# ------------------------------------------------------------------------------------------ sensors


def test_exact_sensors_tell_the_truth(result, bhr, good):
    """Without noise and with the right model: L and rho to rounding, the CoM to what a step of 1 ms leaves open."""
    exact = measure(result, bhr, SensorNoise())
    n = len(exact.t)
    assert set(exact.phase) == {"launch", "flight"} and n == int((result.phase != "landing").sum())
    assert exact.rho == pytest.approx(result.rho[:n], abs=1e-9)
    assert exact.L == pytest.approx(result.L[:n], abs=5e-8)  # the spin that is estimated is off by 2e-9 rad/s
    # half a step of 1 ms at the CoM's speed changes in launch, up to 40 m/s^2 for tenths of a second
    assert np.abs(exact.com - result.com[:n][:, [0, 2]]).max() < 4e-4
    fig = pictures.measured_jump(exact, good, bhr)
    assert len(fig.axes) == 4 and smallest_font(fig) >= MIN_FONT_PT
    shown = np.concatenate([line.get_ydata() for line in fig.axes[3].lines[:2]])
    assert shown == pytest.approx(exact.rho)


def test_noise_is_seeded_and_of_its_size(result, bhr):
    one, same, other = (measure(result, bhr, seed=s) for s in (1, 1, 2))
    assert np.array_equal(one.L, same.L) and not np.array_equal(one.L, other.L)
    error = one.L - result.L[: len(one.t)]
    assert abs(error.mean()) < 0.02 and 0.1 < error.std() < 0.15
    place = np.abs(one.com - result.com[: len(one.t)][:, [0, 2]])
    assert 1e-4 < place[one.phase == "launch"].max() < 0.01  # the feet tell it
    assert place[one.phase == "launch"].max() < place.max() < 0.05  # and in the air only the inertial unit


# ------------------------------------------------------------------------------------------ many robots


def made_up(count, falls_below):
    """Robots that fall if and only if their friction is low."""
    rng, out = np.random.default_rng(4), []
    for k in range(count):
        draw = dict(zip((name for name, *_ in pictures.FEATURES), rng.uniform(0.5, 1.0, 6), strict=True))
        out.append(Trial(TrialKey(0, k, "", ""), {}, draw, draw["friction"] > falls_below, "", None))
    return out


@pytest.mark.parametrize(("count", "bins"), [(1, 1), (8, 1), (40, 4), (300, 5)])
def test_map_counts_every_robot_once(count, bins):
    trials = made_up(count, 0.6)
    fig = pictures.trial_map(trials)
    landed = sum(t.landed for t in trials)
    for ax in fig.axes:
        points = {line.get_color(): len(line.get_xdata()) for line in ax.lines if line.get_linestyle() == "None"}
        assert points == {LANDING: landed, VERMILION: count - landed}
        assert len(ax.collections) == bins
    assert smallest_font(fig) >= MIN_FONT_PT


def test_map_shows_what_decides():
    trials = made_up(100, 0.75)
    friction, delay = pictures.trial_map(trials).axes[:2]
    rates = [[line.get_ydata()[0] for line in ax.lines if line.get_linestyle() == "-"] for ax in (friction, delay)]
    assert rates[0][0] == 0 and rates[0][-1] == 1 and 0.2 < min(rates[1]) and max(rates[1]) < 0.9
    low, high = wilson(0, 20)
    box = friction.collections[0].get_paths()[0].vertices[:, 1]
    assert (box.min(), box.max()) == pytest.approx((low, high))


def test_map_of_robots_that_all_land_shows_how_far_they_went():
    """With the line of least squares: travel grows by 2 cm per ms of delay here, and not with the friction."""
    trials = made_up(100, 0.0)
    metrics = [SimpleNamespace(foot_distance_m=1.0 + 20.0 * t.features["delay_s"]) for t in trials]
    trials = [replace(t, metrics=m) for t, m in zip(trials, metrics, strict=True)]
    friction, delay = pictures.trial_map(trials).axes[:2]
    points, line = delay.lines
    assert len(points.get_xdata()) == 100 and np.ptp(line.get_ydata()) / np.ptp(line.get_xdata()) == pytest.approx(0.02)
    assert delay.get_title("left") == "(b) r = 1.00" and abs(float(friction.get_title("left")[8:])) < 0.4


def test_map_of_nothing():
    assert len(pictures.trial_map([]).axes) == 6


# ------------------------------------------------------------------------------------------ wrong states


def basin_of(grid):
    """A basin in which states fall that are turned forward on a slippery floor."""
    fate = [(s, s.pitch_deg <= 0 or s.friction > 0.6) for s in grid.states]
    trials = [Trial(TrialKey(0, k, "", ""), {}, asdict(s), ok, "", None) for k, (s, ok) in enumerate(fate)]
    return BasinReport(tuple(trials), 0, TrialSettings(), "", {}, 0, grid)


@pytest.mark.parametrize(
    ("grid", "panels"),
    [(BasinGrid(), 9), (BasinGrid((0.8, 1.0), (-20.0, 0.0, 20.0), (0.0,), (0.5,)), 1)],
    ids=["whole", "one height and floor"],
)
def test_basin_shows_every_state_in_its_place(grid, panels):
    basin = basin_of(grid)
    fig = pictures.basin_map(basin.trials)
    assert len(fig.axes) == panels and smallest_font(fig) >= MIN_FONT_PT
    drawn = {LANDING: set(), VERMILION: set()}
    for ax in fig.axes:
        for line in ax.lines:
            if line.get_color() in drawn:
                drawn[line.get_color()] |= {
                    (ax.get_title("left"), *map(round, map(float, p))) for p in line.get_xydata()
                }
    assert [len(places) for places in drawn.values()] == [basin.landed, basin.count - basin.landed]
    assert all("friction 0.5:" in title and pitch > 0 for title, _, pitch in drawn[VERMILION])
    titles = [ax.get_title("left") for ax in fig.axes]
    assert titles[0] == ("0.1 m lower, friction 0.5: 15/25" if panels == 9 else "planned height, friction 0.5: 4/6")


def test_titles_of_a_whole_basin_keep_apart():
    fig = pictures.basin_map(basin_of(BasinGrid()).trials)
    fig.draw_without_rendering()
    boxes = [ax._left_title.get_window_extent() for ax in fig.axes[3:6]]
    assert boxes[0].x1 < boxes[1].x0 and boxes[1].x1 < boxes[2].x0 and boxes[2].x1 <= fig.bbox.x1


def test_harder_worlds_are_told_where_the_same_robots_jumped_both_ways():
    def row(number, aimed, landed, engine="bullet", **more):
        return {"world": "gale", "engine": engine, "re-aim": aimed, "number": number, "landed": landed} | more

    rows = [row(0, True, True), row(0, False, False, cause="slip"), row(1, False, True)]
    assert worlds.shares(rows) == []  # robot 1 did not jump re-aimed
    assert worlds.shares(rows[:1]) == []  # nor did any robot jump plain
    rows += [row(1, True, False, cause="tip"), row(0, True, True, "mujoco")]
    (line,) = worlds.shares(rows)
    low, high = wilson(1, 2)
    assert line == {"world": "gale", "engine": "bullet", "robots": 2, "plain": "1 of 2", "plain [%]": 50.0,
                    "re-aimed": 1, "re-aimed [%]": 50.0, "from [%]": 100 * low, "to [%]": 100 * high,
                    "falls of the re-aimed": "tip 1"}  # fmt: skip


def test_drawn_plans_are_the_same_ones_and_their_outcomes_are_told_by_world_and_way():
    cases = worlds.drawn()
    assert cases == worlds.drawn() != worlds.drawn(1) and sum(robot != "bhr" for robot, _ in cases.values()) >= 20
    rows = [{"world": "MuJoCo, usual", "way": "feedback", "stands": x < 3, "miss_m": x / 100, "apex_m": -0.01,
             "tilt_deg": 2.0} for x in range(4)]  # fmt: skip
    (line,) = worlds.outcomes([*rows, {"world": "MuJoCo, usual", "way": "open loop", "refusal": "no plan"}])
    assert (line["plans"], line["stand"], line["miss, half [cm]"]) == (4, 3, pytest.approx(1.0))
    assert line["from [%]"] == pytest.approx(100 * wilson(3, 4)[0]) and line["apex, 95 % [cm]"] == pytest.approx(1.0)
    stored = worlds.stored(worlds.DRAWN)
    assert {r["case"] for r in stored} <= cases.keys() and {r["world"] for r in stored} <= worlds.PLAYED.keys()


def test_rows_of_harder_worlds_are_of_known_worlds():
    rows = worlds.stored()
    assert {r["world"] for r in rows} == set(worlds.WORLDS) and worlds.shares(rows)
    for world, engine, aimed in product(worlds.WORLDS, ENGINES, (True, False)):
        numbers = [r["number"] for r in rows if (r["world"], r["engine"], r["re-aim"]) == (world, engine, aimed)]
        assert numbers == list(range(worlds.MANY.get(world, worlds.ROBOTS) if aimed else worlds.ROBOTS))
    flips = worlds.stored(worlds.FLIPS)
    assert [(r["engine"], r["number"]) for r in flips] == list(product(ENGINES, range(worlds.FLIP_ROBOTS)))
    assert all(r["landed"] != ("cause" in r) for r in rows)
