"""No robot is changed by accident: neither in memory, nor by what is kept of another one."""

import copy
import gc
import json
import os
import subprocess
import sys
import weakref
from collections.abc import Mapping
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_robots import alike, through_processes

import jumplab as jl
from jumplab.robot import Robot


def exposed(x, path: str = "robot"):
    """(path, thing) of everything that can be reached by public names, Pinocchio's model apart."""
    yield path, x
    if isinstance(x, Mapping):
        for key, value in x.items():
            yield from exposed(value, f"{path}[{key!r}]")
    elif isinstance(x, tuple):
        for i, value in enumerate(x):
            yield from exposed(value, f"{path}[{i}]")
    elif is_dataclass(x):
        for name in (n for n in dir(x) if not n.startswith("_") and n != "model" and not callable(getattr(x, n))):
            yield from exposed(getattr(x, name), f"{path}.{name}")


@pytest.mark.parametrize("way", [lambda r: r, lambda r: r.with_limits(effort=0.9), through_processes, copy.deepcopy])
def test_whatever_is_exposed_refuses_to_be_written_to(way):
    robot, kinds = way(Robot.load()), set()
    for path, x in [*exposed(robot), *exposed(robot.role_signs(), "role_signs()")]:
        kinds.add(type(x).__name__)
        if isinstance(x, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                x[...] = 0.0
        elif isinstance(x, Mapping):
            with pytest.raises(TypeError, match="does not support item assignment"):
                x[next(iter(x), "new")] = 0.0
        elif is_dataclass(x):
            for name in [f.name for f in fields(x)]:
                with pytest.raises(FrozenInstanceError):
                    setattr(x, name, 0.0)
        else:
            assert isinstance(x, str | int | float | tuple), path
    assert kinds == {*"Robot SagittalModel MotorLimits Bus Foot ndarray mappingproxy tuple str int float bool".split()}
    assert alike(robot, way(Robot.load()))


def test_the_sentence_that_used_to_poison(bhr):
    with pytest.raises(TypeError):
        bhr.actuators["left_knee"]["effort"] = 1000.0
    with pytest.raises((ValueError, TypeError), match="stance is declared with init=False"):  # the latter from 3.13 on
        replace(bhr, stance={"knee_rad": 1.0})
    with pytest.raises(AttributeError):
        bhr.model = pin.Model()


def test_the_model_is_a_copy_that_belongs_to_its_user(bhr):
    model = bhr.model
    model.upperEffortLimit[8] = 1.0
    model.inertias[3].mass = 99.0
    model.gravity.linear = np.zeros(3)
    model.addFrame(pin.Frame("tool", 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    assert model != bhr.model == Robot.load().model
    assert not bhr.model.existFrame("tool") and bhr.total_mass == pytest.approx(42.0)


def test_what_is_read_from_an_unnamed_copy_keeps_it_alive(bhr):
    for read in (lambda m: m.upperEffortLimit[6:], lambda m: m.inertias[1].lever, lambda m: m.frames[5].placement):
        model = bhr.model
        alive, x = weakref.ref(model), read(model)
        del model
        gc.collect()
        assert alive() is not None and str(read(bhr.model)) == str(x)
        del x
        gc.collect()
        assert alive() is None


def test_a_robot_goes_to_another_process_whole(bhr):
    moon = bhr.with_stance(knee_rad=0.7).under_gravity(1.62)
    for other in (through_processes(moon), copy.deepcopy(moon)):
        assert alike(other, moon) and other == moon and other.model.gravity.linear[2] == -1.62
    assert moon.with_limits(speed=0.9).gravity == 1.62 and moon.under_gravity(9.8).model.gravity.linear[2] == -9.8
    assert moon.hash == bhr.with_stance(knee_rad=0.7).hash


# kept between processes --------------------------------------------------------------------------------------
PLAN = """
import json, sys
import jumplab as jl
robot = jl.Robot.load("bhr")
if sys.argv[1] == "changed":
    robot = robot.with_limits(effort=1.5).with_mass("trunk", factor=1.2)
plan = jl.plan(jl.JumpTask(distance_m=0.3, height_m=0.2), robot)
print(json.dumps([robot.hash, plan.tape.q.sum().hex(), plan.tape.tau.max().hex(), plan.tape.f.max().hex()]))
"""


@pytest.mark.slow
def test_a_fresh_process_after_a_change_plans_as_if_there_had_been_none(bhr, tmp_path):
    """Files that are kept between processes belong to another robot under another name."""

    def said(which: str) -> list:
        environment = os.environ | {"JUMPLAB_CACHE": str(tmp_path / "cache")}
        done = subprocess.run([sys.executable, "-c", PLAN, which], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    changed, plain = said("changed"), said("plain")
    tape = jl.plan(jl.JumpTask(distance_m=0.3, height_m=0.2), bhr).tape  # of a process with another cache
    assert any((tmp_path / "cache").iterdir())
    assert plain == [bhr.hash, tape.q.sum().hex(), tape.tau.max().hex(), tape.f.max().hex()]
    assert all(a != b for a, b in zip(plain, changed, strict=True))
