"""Shared by all tests: no display, one thread per process, and the default robot once."""

import os
import shutil
import tempfile

os.environ["MPLBACKEND"] = "Agg"
os.environ.setdefault("OMP_NUM_THREADS", "1")
WORKER = "PYTEST_XDIST_WORKER" in os.environ
if not WORKER:  # a new folder: nothing that an earlier run built, and each function is made once for all processes
    os.environ["JUMPLAB_CACHE"] = tempfile.mkdtemp(prefix="jumplab-tests-")

import pytest  # noqa: E402


def pytest_unconfigure():
    if not WORKER:
        shutil.rmtree(os.environ["JUMPLAB_CACHE"], ignore_errors=True)


@pytest.fixture(scope="session")
def bhr():
    """The default robot."""
    from jumplab.robot import Robot

    return Robot.load()


@pytest.fixture(scope="session")
def tape():
    """A small jump of the default robot, by the direct planner."""
    from fixtures_core import jump

    return jump(0.6, 0.3, method="direct").tape


@pytest.fixture(scope="session")
def plan():
    """A long jump of the default robot, by three steps."""
    from fixtures_core import jump

    return jump(1.0, 0.5)


@pytest.fixture(scope="session")
def good(plan):
    """Its tape."""
    return plan.tape


@pytest.fixture(scope="session")
def simulation():
    """That jump, simulated."""
    from fixtures_core import simulated

    return simulated(1.0, 0.5)


@pytest.fixture
def folder(tmp_path):
    """A folder that holds that jump."""
    from fixtures_core import on_file

    return on_file(tmp_path / "plan")


@pytest.fixture
def odd_folder(tmp_path):
    """A folder whose path has a space, letters beyond ASCII, braces and a dollar sign."""
    folder = tmp_path / "Sprünge und 跳跃 {x} $HOME"
    folder.mkdir()
    return folder
