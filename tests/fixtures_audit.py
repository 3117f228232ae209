"""Fixtures of the audit's tests: a good plan, and tools that break a tape (or robot) in just one way."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.task import JumpTask

TASK = JumpTask(1.0, 0.5)
ROBOT = Robot.load()
LEFT, RIGHT = 0, 1
STANDING = 100  # row early in the launch, the foot flat
FLYING, LAST, PUSHING = "flight", -1, -30  # rows from take-off: 100 later, the last of the launch, heel up


def joint(name: str) -> int:
    """Index of a joint among the columns of tau; add 6 for v and 7 for q."""
    return ROBOT.joint_names.index(name)


KNEE, HIP = joint("left_knee"), joint("left_hip_pitch")


def edit(tape: Tape, **changes) -> Tape:
    """Copy of a tape on which each function has changed its array in place."""
    arrays = {name: np.array(getattr(tape, name)) for name in changes}
    for name, change in changes.items():
        change(arrays[name], tape.takeoff_index)
    return dataclasses.replace(tape, **arrays)


def row_of(row, takeoff: int) -> int:
    """Row index; negative ones are counted back from take-off."""
    return takeoff + 100 if row == FLYING else row + takeoff if row < 0 else row


def put(row, column, amount, *, relative=True):
    """Change that adds ``amount`` to (or sets) one entry."""

    def change(x, takeoff):
        at = (row_of(row, takeoff), *np.atleast_1d(column))
        x[at] = amount + (x[at] if relative else 0.0)

    return change


def everywhere(column, amount, phase: str | None = None):
    """Change that adds ``amount`` to a column over a phase or the whole tape."""

    def change(x, takeoff):
        rows = {"launch": slice(takeoff), "flight": slice(takeoff, None), None: slice(None)}[phase]
        x[(rows, *np.atleast_1d(column))] += amount

    return change


def bump(t, first, last):
    """Smooth bump (n,) from 0 to 1 and back between two times, and its two derivatives."""
    s = (t - first) / (last - first)
    inside = (s > 0) & (s < 1)
    p = np.poly1d([-64, 192, -192, 64, 0, 0, 0])  # 64 s^3 (1 - s)^3
    rows = [np.where(inside, p.deriv(k)(s) if k else p(s), 0.0) / (last - first) ** k for k in range(3)]
    return rows


def shifted(tape: Tape, axis: int, amount: float, first: float, last: float) -> Tape:
    """The whole robot shifted along a world axis by a smooth bump, with consistent q, v, a and their forces."""
    s, rate, acceleration = (amount * x for x in bump(tape.t, first, last))
    q, v, a = np.array(tape.q), np.array(tape.v), np.array(tape.a)
    q[:, axis] += s
    turn = np.array([pin.Quaternion(x).matrix() for x in tape.q[:, 3:7]])  # base to world
    v[:, :3] += turn[:, axis] * rate[:, None]
    drag = np.cross(v[:, 3:6], turn[:, axis] * rate[:, None])
    a[:, :3] += turn[:, axis] * acceleration[:, None] - drag
    return with_forces(dataclasses.replace(tape, q=q, v=v, a=a))


def with_forces(tape: Tape, robot: Robot = ROBOT) -> Tape:
    """Wrenches (half to each foot) and torques that the motion needs; in flight torques only."""
    model = robot.model
    data, feet = model.createData(), [model.getFrameId(str(n)) for n in tape.contact_frames]
    f, tau = np.zeros_like(tape.f), np.zeros_like(tape.tau)
    for i in range(len(tape.t)):
        q = tape.q[i]
        need = pin.rnea(model, data, q, tape.v[i], tape.a[i])
        pin.framesForwardKinematics(model, data, q)
        tau[i] = need[6:]
        if tape.phase[i] == "flight":
            continue
        total = data.oMi[1].act(pin.Force(need[:6]))  # about the world's origin
        middle = np.mean([data.oMf[frame].translation for frame in feet], axis=0)
        moment = total.angular - np.cross(middle, total.linear)  # about the middle between the feet
        for k, frame in enumerate(feet):
            f[i, k] = np.concatenate([total.linear, moment]) / 2
            jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
            tau[i] -= (jacobian.T @ f[i, k])[6:]
    return dataclasses.replace(tape, f=f, tau=tau)


def drop_row(tape: Tape, row: int) -> Tape:
    names = ("t", "q", "v", "a", "tau", "phase", "f")
    return dataclasses.replace(tape, **{n: np.delete(getattr(tape, n), row, axis=0) for n in names})


def moved_cop(tape: Tape, row: int, metres: float) -> Tape:
    """Centre of pressure of the left foot moved forward in one row, by its pitch moment."""

    def change(f, takeoff):
        i = row_of(row, takeoff)
        f[i, LEFT, 4] -= metres * f[i, LEFT, 2]

    return edit(tape, f=change)


def strong_at_speed(tape: Tape) -> Tape:
    """Nearly full torque, allowed at low speed, in the joint and the sample nearest to the speed limit."""
    limits = [ROBOT.actuators[n] for n in ROBOT.joint_names]
    speed = tape.v[:, 6:] / [x["speed"] for x in limits]
    i, j = np.unravel_index(np.argmax(np.abs(speed)), speed.shape)
    assert limits[j]["corner_speed"] / limits[j]["speed"] < abs(speed[i, j]) < 1
    return edit(tape, tau=put(int(i), j, math.copysign(0.99 * limits[j]["effort"], speed[i, j]), relative=False))


def robot_with(urdf=(), config=()) -> Robot:
    """The default robot with replacements in its files, unchecked; each old text must be there."""
    texts = [ROBOT.urdf, ROBOT.config_text]
    for which, pair in ((0, urdf), (1, config)):
        if pair:
            assert pair[0] in texts[which]
            texts[which] = texts[which].replace(*pair)
    return Robot(*texts)  # faults that only the audit finds shall reach it
