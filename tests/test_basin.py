"""The landing basin: all combinations of a grid, in an order that any first part samples fairly, resumable."""

import numpy as np
import pytest
from fixtures_core import on_file
from paper import basin
from paper.basin import BasinGrid, landing_basin

from jumplab.errors import InputError
from jumplab.io import folder as store
from jumplab.studies.trials import Trial, TrialSettings

SMALL = BasinGrid((1.0,), (0.0, 30.0), (0.0,), (0.6,))


def fake(plan, settings, key, state):
    """Stands in for a simulation: too much pitch falls."""
    landed = abs(state.pitch_deg) < 7
    return Trial(key, {}, vars(state), landed, "stood" if landed else "trunk touched the ground 0.5 s", None)


@pytest.fixture
def fakes(monkeypatch):
    monkeypatch.setattr(basin, "drop", fake)
    monkeypatch.setattr(basin.BasinReport, "values", lambda self, name: np.zeros(0))


def test_the_grid_has_all_combinations_once():
    states = BasinGrid().states
    assert len(set(states)) == 225 == len(states) and states == BasinGrid().states
    assert {(s.speed_factor, s.pitch_deg) for s in states[:100]} == {
        (x, p) for x in (0.8, 0.9, 1.0, 1.1, 1.2) for p in (-10, -5, 0, 5, 10)
    }  # any first part of it has something of everything


def test_counts_and_resumes(folder, fakes):
    for n, words in ((0, "too small; it must be at least 1"), (226, "too large; the basin has 225 states")):
        with pytest.raises(InputError, match=f"^n = {n} is {words}$"):
            landing_basin(folder, n)
    first = landing_basin(folder, 50, jobs=1)
    assert first.resumed == 0 and first.count == 50
    whole = landing_basin(folder, jobs=1)
    assert (whole.count, whole.landed, whole.resumed) == (225, 135, 50) and whole.trials[:50] == first.trials
    said = store.read_json(folder / "basin.json")
    assert "robot" in said["conditions"] and not any(name.startswith("drawn") for name in said["conditions"])
    assert said["counts"] == {"trials": 225, "landed": 135, "failed": 90} and said["states"] == 225
    assert {abs(row["pitch_deg"]) for row in said["failed"]} == {10.0} and len(said["failed"]) == 90
    assert said["reasons"] == {"trunk touched the ground ... s": 90}
    assert landing_basin(folder, settings=TrialSettings(reaim=False), jobs=1).resumed == 0
    assert landing_basin(folder, 5, grid=BasinGrid(speed_factor=(1.0,)), jobs=1).resumed > 0  # the same states
    on_file(folder)
    assert not {"basin.json", "trials.jsonl"} & {f.name for f in folder.iterdir()}  # a new plan, a new basin


def test_a_state_is_simulated_as_it_says(folder):
    """The planned apex lands, one that is turned by 30 degrees without re-aim falls; both are kept beside trials."""
    report = landing_basin(folder, settings=TrialSettings(reaim=False), grid=SMALL, jobs=1)
    landed = {t.features["pitch_deg"]: t.landed for t in report.trials}
    assert landed == {0.0: True, 30.0: False}
    for trial in report.trials:
        assert trial.features["friction"] == 0.6 == trial.perturbation["friction"] and not trial.perturbation["mass"]
        turn = trial.metrics.touchdown_trunk_pitch_rad
        assert (abs(turn) > 0.4) == (trial.features["pitch_deg"] == 30)
    assert landing_basin(folder, settings=TrialSettings(reaim=False), grid=SMALL, jobs=1).trials == report.trials
