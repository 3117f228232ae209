"""What a notebook's first cells refuse, and what they let pass."""

import pytest

from jumplab.cli import notebooks
from jumplab.errors import InputError


@pytest.mark.parametrize(
    ("injected", "sentence"),
    [
        ("distnace_m = 2.0", "unknown notebook parameter 'distnace_m'; this notebook knows distance_m"),
        ("distance_m = 'far'", "parameter distance_m must be of type float, got 'far'"),
        ("distance_m = float('inf')", "parameter distance_m must be finite, got inf"),
        ("height_m = -1", "height = -1 m is outside 0.02 ... 1.5 m"),
        ("n = 1.5", "parameter n must be of type int, got 1.5"),
        ("n = True", "parameter n must be of type int, got True"),
        ("out = ''", "parameter out must be a name or a path, got ''"),
        ("robot = None", "parameter robot must be of type str, got None"),
    ],
)
def test_check_parameters_refuses(injected, sentence):
    cell = f"# Parameters\n{injected}\n"
    namespace = {"In": ["", "distance_m = 1.0\nn = 1", cell], "distance_m": 1.0, "n": 1}
    exec(cell, namespace)
    with pytest.raises(InputError) as e:
        notebooks.check_parameters(namespace, n=int)
    assert str(e.value).startswith(sentence)


def test_an_engine_is_looked_for_before_anything_runs(tmp_path):
    from jumplab.sim import INSTALLED

    namespace = {"engine": "ode", "In": ["# Parameters\nengine = 'ode'"]}
    words = f"^engine 'ode': must be one of {', '.join(INSTALLED)}$"
    with pytest.raises(InputError, match=words):
        notebooks.check_parameters(namespace, engine=str)
    with pytest.raises(InputError, match=r"^unknown notebook parameter 'engine'"):  # a notebook that simulates nothing
        notebooks.check_parameters(namespace)
    with pytest.raises(InputError, match=words):
        notebooks.run_notebooks({"engine": "ode"}, notebooks=notebooks.find_notebooks(["00"]), out=tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_check_parameters_accepts_what_is_meant():
    notebooks.check_parameters({"distance_m": 1, "height_m": 0.3, "robot": "bhr", "later": 3, "In": ["later = 3"]})
    notebooks.check_parameters({"fast": True, "In": ["# Parameters\nfast = True"]}, fast=bool)
