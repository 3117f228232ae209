"""Motions between their samples."""

import numpy as np
import pinocchio as pin
from fixtures_core import jump
from pytest import approx

from jumplab.io.motion import Motion


def test_a_tape_on_its_own_grid_is_itself_without_the_double_sample(bhr):
    tape = jump(1.0, 0.5).tape
    x = Motion.of(tape).every(1000.0)
    keep = np.concatenate([np.diff(tape.t) > 0, [True]])
    keep &= np.abs(tape.t * 1000 - np.round(tape.t * 1000)) < 1e-6  # the end is no whole millisecond
    at = np.round(tape.t[keep] * 1000).astype(int)  # a tape leaves out a sample that would lie just before its end
    assert len(x.t) - 1 <= len(at) <= len(x.t) < len(tape.t)
    assert np.diff(x.t) == approx(0.001, abs=1e-12)
    for name in ("q", "v", "tau"):
        assert np.abs(getattr(x, name)[at] - getattr(tape, name)[keep]).max() < 1e-6, name
    assert list(x.phase[at]) == list(tape.phase[keep])
    assert Motion.of(tape).source == "plan" and Motion.of(tape).duration == tape.t[-1]


def test_forces_on_the_feet_go_along(bhr):
    tape = jump(1.0, 0.5).tape
    x = Motion.of(tape).at(tape.t[[100, 700]])
    assert np.abs(x.wrench - tape.f[[100, 700]]).max() < 1e-6 and np.abs(x.wrench).max() > 100
    bare = Motion(tape.t, tape.q, tape.v, tape.tau, tape.phase, "plan")
    assert bare.at([0.05]).wrench is None


def test_velocities_are_those_of_the_resampled_motion(bhr):
    """Pinocchio's difference over time agrees with the mean of v, up to a trapezoid's error of second order."""
    motion, worst = Motion.of(jump(1.0, 0.5).tape), []
    for hz in (240.0, 480.0):
        x = motion.every(hz)
        rate = [pin.difference(bhr.model, a, b) * hz for a, b in zip(x.q[:-1], x.q[1:], strict=True)]
        worst.append(np.abs(np.array(rate) - (x.v[:-1] + x.v[1:]) / 2).max())
    # accelerations are linear between the plan's nodes, and a kink between two samples costs some of the second order
    assert worst[0] < 0.025 and worst[1] < worst[0] / 2.5
