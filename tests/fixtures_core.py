"""Fixtures of the core's tests: refusals, jumps planned once per session, tapes looked at again, planar motions."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path

import grimp
import numpy as np
import pinocchio as pin
import pytest

from jumplab.errors import InputError
from jumplab.io import folder as store
from jumplab.robot import Robot
from jumplab.robot.stance import configuration
from jumplab.sim import SimulationResult, simulate_jump
from jumplab.stages.planner import JumpPlan, Planner
from jumplab.stages.srmp import SrmpPlan, SrmpPlanner
from jumplab.task import JumpTask

LIMBS = ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch")


def refused(call: Callable, *arguments, by: type[Exception] = InputError, **options) -> str:
    """The sentence that refuses a call."""
    with pytest.raises(by) as e:
        call(*arguments, **options)
    return str(e.value)


def slopes(f, x: np.ndarray, step: float, ways: np.ndarray | None = None) -> np.ndarray:
    """Jacobian (..., n) of ``f`` at ``x`` (n,) by central differences, or times ``ways`` (k, n)."""
    ways = step * (np.eye(len(x)) if ways is None else ways)
    return np.stack([(np.asarray(f(x + way)) - np.asarray(f(x - way))) / (2 * step) for way in ways], axis=-1)


@cache
def planner() -> Planner:
    """The stages, built once."""
    return Planner(Robot.load())


@cache
def jump(distance_m: float, height_m: float, platform_m: float = 0.0, method: str = "three-step") -> JumpPlan:
    """One finished plan per target and method."""
    return planner().plan(JumpTask(distance_m, height_m, platform_m), method)


@cache
def simulated(distance_m: float, height_m: float) -> SimulationResult:
    """One simulation per jump of three steps, by the usual engine and mode."""
    plan = jump(distance_m, height_m)
    return simulate_jump(plan.tape, plan.robot)


def on_file(folder: Path, plan: JumpPlan | None = None) -> Path:
    """A folder that holds a plan, by default that of a small jump."""
    plan = plan or jump(0.6, 0.3, method="direct")
    store.write_plan(folder, plan.tape, plan.robot, plan.summary)
    return folder


@cache
def srmp_planner() -> SrmpPlanner:
    """Stage 1, built once."""
    return SrmpPlanner(Robot.load())


@cache
def pendulum(distance_m: float, height_m: float, platform_m: float = 0.0) -> SrmpPlan:
    """One stage-1 plan per target."""
    return srmp_planner().plan(JumpTask(distance_m, height_m, platform_m))


def turned(angle: float, vector) -> np.ndarray:
    """(x, z) turned by an angle about +y."""
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) @ np.asarray(vector, float)


def chain_motion(arms, angles, rates, accels) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place, velocity and acceleration of the tip of a chain of vectors, each turned by its own angle."""
    place, speed, accel = np.zeros(2), np.zeros(2), np.zeros(2)
    for arm, angle, w, b in zip(arms, angles, rates, accels, strict=True):
        r = turned(angle, arm)
        across = np.array([r[1], -r[0]])  # d r / d angle
        place, speed, accel = place + r, speed + w * across, accel + b * across - w * w * r
    return place, speed, accel


def full_state(
    robot: Robot, angles, rates, accels, toe=(0.0, 0.0), toe_velocity=(0.0, 0.0), toe_acceleration=(0.0, 0.0)
):
    """(q, v, a) of the full robot for a symmetric planar motion; worked out here, not by the package."""
    s, model = robot.sagittal, robot.model
    arms = [*s.span[:3], s.base]
    _, speed, accel = chain_motion(arms, angles[:4], rates[:4], accels[:4])
    speed, accel = speed + toe_velocity, accel + toe_acceleration
    pitch, w, b = angles[3], rates[3], accels[3]
    v, a = np.zeros(model.nv), np.zeros(model.nv)
    v[[0, 2]], v[4] = turned(-pitch, speed), w
    a[[0, 2]], a[4] = turned(-pitch, accel - w * np.array([speed[1], -speed[0]])), b
    for i, role in enumerate(LIMBS):
        for name in robot.joints[role]:
            column = model.idx_vs[model.getJointId(name)]
            v[column] = s.signs[i, 0] * s.joint_angles(rates)[i]
            a[column] = s.signs[i, 0] * s.joint_angles(accels)[i]
    return configuration(robot, np.asarray(angles), toe), v, a


def inverse_dynamics(robot: Robot, q, v, a, wrench, at, gravity=9.8) -> np.ndarray:
    """(nv,) generalised forces left over after half of (F_x, F_z, M_y), acting at (x, z), went to each foot."""
    model = robot.model.copy()
    model.gravity.linear = np.array([0.0, 0.0, -gravity])
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    pin.updateFramePlacements(model, data)
    pin.computeJointJacobians(model, data, q)
    out = pin.rnea(model, data, q, v, a)
    for name in robot.foot.frames:
        frame = model.getFrameId(name)
        origin = data.oMf[frame].translation
        force = np.array([wrench[0], 0.0, wrench[1]]) / 2
        moment = np.array([0.0, wrench[2] / 2, 0.0]) + np.cross([at[0] - origin[0], 0.0, at[1] - origin[2]], force)
        jacobian = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        out = out - jacobian.T @ np.concatenate([force, moment])
    return out


@dataclass(frozen=True)
class Replay:
    """A plan's tape once more, through Pinocchio alone; world coordinates, origin between the soles at the start."""

    plan: JumpPlan

    @property
    def tape(self):
        return self.plan.tape

    @property
    def robot(self):
        return self.plan.robot

    @cached_property
    def flying(self) -> np.ndarray:
        return self.tape.phase == "flight"

    @cached_property
    def _model(self) -> pin.Model:
        model = self.robot.model.copy()
        model.gravity.linear = np.array([0.0, 0.0, -self.plan.task.gravity])
        return model

    @cached_property
    def _rows(self) -> dict[str, np.ndarray]:
        model, data, tape = self._model, self._model.createData(), self.tape
        frames = [model.getFrameId(str(n)) for n in tape.contact_frames]
        corners = self.robot.foot.corners
        rows = {
            k: []
            for k in ("com", "com_velocity", "com_acceleration", "L", "momentum", "rho", "corners", "feet", "residual")
        }
        for q, v, a, tau, f in zip(tape.q, tape.v, tape.a, tape.tau, tape.f, strict=True):
            pin.computeJointJacobians(model, data, q)
            pin.updateFramePlacements(model, data)
            places = [data.oMf[i].copy() for i in frames]
            force = np.concatenate([np.zeros(6), tau])
            for frame, wrench in zip(frames, f, strict=True):
                jacobian = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
                force = force + jacobian.T @ wrench
            residual = pin.rnea(model, data, q, v, a) - force
            pin.centerOfMass(model, data, q, v, a)
            rows["com_acceleration"].append(data.acom[0].copy())
            pin.ccrba(model, data, q, v)
            rows["com"].append(data.com[0].copy())
            rows["com_velocity"].append(data.hg.linear / self.robot.total_mass)
            rows["L"].append(data.hg.angular[1])
            rows["momentum"].append(np.concatenate([data.hg.linear, data.hg.angular]))
            rows["rho"].append(data.Ig.inertia[1, 1])
            rows["corners"].append([[p.act(c) for c in corners] for p in places])
            rows["feet"].append([p.translation for p in places])
            rows["residual"].append(residual)
        return {k: np.array(x) for k, x in rows.items()}

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)
        return self._rows[name]

    @cached_property
    def cop_x(self) -> np.ndarray:
        """(N,) centre of pressure of both feet [m], nan without load."""
        f, feet = self.tape.f, self.feet
        fz = f[..., 2].sum(1)
        moment = (f[..., 4] + feet[..., 2] * f[..., 0] - feet[..., 0] * f[..., 2]).sum(1)  # about the world's origin
        return np.where(fz > 1.0, -moment / np.where(fz > 1.0, fz, 1.0), np.nan)


@cache
def replay(distance_m: float, height_m: float, platform_m: float = 0.0, method: str = "three-step") -> Replay:
    """A plan, looked at again."""
    return Replay(jump(distance_m, height_m, platform_m, method))


def import_graph():
    """Imports within the package; a sub-package that loads its modules lazily counts as importing all of them."""
    graph = grimp.build_graph("jumplab", cache_dir=None)
    for room in [m for m in graph.modules if m.count(".") == 1]:
        below = graph.find_children(room)
        if below and "lazy.attach(" in Path(import_module(room).__file__).read_text():
            for module in below:
                graph.add_import(importer=room, imported=module)
    return graph
