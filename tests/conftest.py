"""Shared by all tests: no display, one thread per process, and the default robot once."""

import os

os.environ["MPLBACKEND"] = "Agg"
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["JUMPLAB_CACHE"] = ""  # nothing that an earlier version built

import pytest


@pytest.fixture(scope="session")
def bhr():
    """The default robot."""
    from jumplab.robot import Robot

    return Robot.load()


@pytest.fixture
def odd_folder(tmp_path):
    """A folder whose path has a space, letters beyond ASCII, braces and a dollar sign."""
    folder = tmp_path / "Sprünge und 跳跃 {x} $HOME"
    folder.mkdir()
    return folder
