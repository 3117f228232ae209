"""Parameters that a notebook's first cells refuse, and those that they accept."""

import pytest
from fixtures_core import refused
from paper import running

from jumplab.cli import notebooks
from jumplab.errors import InputError

DECLARED = """distance_m: float = 1.0  # travel of the feet [m]
height_m: float = 0.5
robot: str = "bhr"
out: str = "x"
n: int = 1  # 1 ... 9, how many"""


@pytest.mark.parametrize(
    ("injected", "sentence"),
    [
        ("distnace_m = 2.0", "unknown notebook parameter 'distnace_m'; this notebook has distance_m"),
        ("distance_m = 'far'", "parameter distance_m must be a number, got 'far'"),
        ("distance_m = float('inf')", "parameter distance_m must be finite, got inf"),
        ("height_m = -1", "height = -1 m is outside 0.02 ... 1.5 m"),
        ("n = 1.5", "parameter n must be a whole number, got 1.5"),
        ("n = 10", "parameter n must be 1 ... 9, got 10"),
        ("out = ''", "parameter out must be a name or a path, got ''"),
    ],
)
def test_check_parameters_refuses(injected, sentence):
    assert refused(running.check_parameters, opened(injected)).startswith(sentence)


def opened(injected, declared=DECLARED):
    """Names of a notebook's cells after its parameters and papermill's own cell."""
    namespace = {"In": ["", declared, f"# Parameters\n{injected}\n"]}
    exec("\n".join(namespace["In"]), namespace)
    return namespace


def test_an_engine_is_looked_for_before_anything_runs(tmp_path):
    from jumplab.sim import INSTALLED

    words = f"^engine 'ode': must be one of {', '.join(INSTALLED)}$"
    with pytest.raises(InputError, match=words):
        running.check_parameters(opened("engine = 'ode'", f"{DECLARED}\nengine: str = 'bullet'"))
    with pytest.raises(InputError, match=r"^unknown notebook parameter 'engine'"):  # a notebook that simulates nothing
        running.check_parameters(opened("engine = 'ode'"))
    with pytest.raises(InputError, match=words):
        running.run_notebooks({"engine": "ode"}, notebooks=notebooks.find_notebooks(["00"]), out=tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_check_parameters_accepts_what_is_meant():
    running.check_parameters({"distance_m": 1, "height_m": 0.3, "robot": "bhr", "later": 3, "In": ["later = 3"]})
    namespace = {"In": ["", DECLARED.replace("n: int = 1", "n: int = 0")]}  # edited by hand, without papermill
    exec(namespace["In"][1], namespace)
    assert refused(running.check_parameters, namespace) == "parameter n must be 1 ... 9, got 0"
    running.check_parameters(opened("fast = True\nrobot = 'a = b'\nn = 3", f"{DECLARED}\nfast: bool = False"))
