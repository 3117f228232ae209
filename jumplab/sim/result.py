"""What a simulated jump leaves behind: logs at 1 kHz, numbers measured from them, and what its checks found.

A :class:`Recorder` collects the log step by step and makes the :class:`SimulationResult` from it.
"""

from __future__ import annotations

import io
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import pinocchio as pin

from jumplab.errors import InputError, Shown, SolverError
from jumplab.io.columns import Named
from jumplab.io.folder import read_json, write_file
from jumplab.io.motion import CONTACT_FORCE_N, SIMULATION_NAME, SIMULATION_SCHEMA, read_simulation
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge, pitch_of
from jumplab.sim.playback import Actuators
from jumplab.sim.scene import Contacts

STAND_S = 3.0  # standing this long after touchdown, and not a moment less, is a landing
STILL_SPEED = 0.05  # [m/s] a CoM slower than this at the end stands
LEVEL_TOLERANCE_M = 0.05  # soles this close to the planned height stand on the planned surface
IMPACT_S = 0.1  # the landing impulse is summed over this time after touchdown
SMOOTHING_S = 0.02  # longer than an impact, whose force is a matter of the engine's step, shorter than the catch
SATURATED = 0.999  # share of the available torque that counts as "at the limit"
MIN_FLIGHT_S = 0.05  # a shorter loss of contact is a hop of the launch; the lowest jump flies 0.13 s
REPORT_NAME = "simulation.json"


@dataclass(frozen=True)
class Finding:
    """One question about a run, answered: ``value`` may not exceed ``limit`` [unit]."""

    name: str
    value: float
    limit: float
    unit: str
    catches: str

    @property
    def passed(self) -> bool:
        """True if the value is within its limit."""
        return bool(self.value <= self.limit)

    def to_json(self) -> dict:
        """Plain data."""
        return {**asdict(self), "value": float(self.value), "passed": self.passed}

    def __str__(self) -> str:
        return f"{self.name}: {self.value:.4g} {self.unit}".rstrip() + f" (at most {self.limit:.4g}; {self.catches})"


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Numbers of one jump, all measured in the simulation; None where the jump did not get so far.

    Loads are ratios ``|value| / limit``, largest over the run; vectors are (x, z), those of the landing along the
    heading in which the robot was meant to land, those of the launch along the one in which it began.
    """

    foot_distance_m: float | None = None  # travel of the toes from the start to where they stand at the end
    foot_distance_touchdown_m: float | None = None  # the same, to the first touchdown
    side_m: float | None = None  # travel of the soles to the left, from the start to the end
    yaw_rad: float | None = None  # turn of the feet about the vertical, whole turns counted
    com_rise_m: float | None = None  # apex minus CoM at lift-off, the last contact force above a few newtons
    takeoff_velocity: tuple[float, float] | None = None  # of the CoM at lift-off [m/s]
    takeoff_momentum: float | None = None  # L_y at lift-off [kg m^2/s]
    standing_s: float  # from touchdown to the end, or until anything but the feet touched the ground
    landed: bool
    reason: str  # of that verdict
    max_torque_ratio: float
    max_speed_ratio: float
    max_torque_ratio_before_touchdown: float
    max_speed_ratio_before_touchdown: float
    max_torque_ratio_by_joint: dict[str, float]
    max_speed_ratio_by_joint: dict[str, float]
    saturated_s: dict[str, float]  # by joint: time at its torque limit
    overspeed_s: dict[str, float]  # by joint: beyond its speed limit; a light foot for milliseconds at touchdown
    self_collision_s: float  # time during which links of the robot pressed on each other
    stray_contacts: tuple[str, ...]  # links other than the feet that touched the ground before touchdown
    liftoff_s: float | None = None
    touchdown_s: float | None = None
    touchdown_trunk_pitch_rad: float | None = None  # whole turns counted
    touchdown_trunk_rate: float | None = None  # about the trunk's own pitch axis [rad/s]
    touchdown_com_velocity: tuple[float, float] | None = None  # [m/s]
    sole_ahead_m: float | None = None  # middle of the soles minus CoM at touchdown
    launch_impulse: tuple[float, float]  # of the ground until lift-off [N s]
    landing_impulse: tuple[float, float] | None = None  # of the ground in the 0.1 s after touchdown [N s]
    landing_force_n: float | None = None  # largest mean over 20 ms of what presses on both feet then [N]
    # when, after touchdown, a foot left to catch the robot elsewhere; where the feet end counts that step then
    recovery_step_s: float | None = None
    qp_solves: int  # of the landing controller
    qp_failures: int


@dataclass(frozen=True, repr=False)
class SimulationResult(Shown, Named):
    """Logs of one simulated jump at 1 kHz, its metrics and its settings.

    Row k holds the state at t[k] and what acted in the step that follows.
    """

    t: np.ndarray  # (N,) [s]
    q: np.ndarray  # (N, nq) true configuration in Pinocchio's conventions
    v: np.ndarray  # (N, nv) true velocity
    tau: np.ndarray  # (N, nv - 6) torques that the motors really gave [N m]
    foot_wrench: np.ndarray  # (N, 2, 6) force and moment on each foot, world axes, at the origin of the foot link
    com: np.ndarray  # (N, 3) of the simulated (perturbed) robot [m]
    com_velocity: np.ndarray  # (N, 3) [m/s]
    L: np.ndarray  # (N,) angular momentum about the pitch axis through the CoM [kg m^2/s]
    rho: np.ndarray  # (N,) total pitch inertia about the CoM [kg m^2]
    phase: np.ndarray  # (N,) "launch", "flight" or "landing", by the simulated contact forces
    touching: np.ndarray  # (N, links) whether a link pressed on the ground
    colliding: np.ndarray  # (N,) whether links of the robot pressed on each other
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    metrics: Metrics
    settings: dict
    checks: tuple[Finding, ...] = ()  # of jumplab.sim.checks.check
    robot: Robot | None = None  # as it really was; as planned, if read from a folder

    def line(self) -> str:
        """Travel, rise and verdict."""
        m = self.metrics
        far, high = ("none" if x is None else f"{x:.3f} m" for x in (m.foot_distance_m, m.com_rise_m))
        stepped = "" if m.recovery_step_s is None else " after a recovery step"
        verdict = f"stands {m.standing_s:.2f} s{stepped}" if m.landed else f"FAILED, {m.reason}"
        return f"travel {far}, rise {high}, {verdict}"

    @property
    def checks_passed(self) -> bool:
        """True if the run was checked, and every check passed."""
        return bool(self.checks) and all(finding.passed for finding in self.checks)

    @property
    def landed(self) -> bool:
        """True if the robot stood on its feet until the end."""
        return self.metrics.landed

    @property
    def reason(self) -> str:
        """Why the verdict is what it is."""
        return self.metrics.reason

    def arrays(self) -> dict[str, np.ndarray]:
        """All logs under the names of ``simulation.npz``."""
        return {"schema": np.array(SIMULATION_SCHEMA), **{name: np.asarray(getattr(self, name)) for name in LOGS}}

    def to_json(self) -> dict:
        """Metrics, settings and findings as plain data, the content of ``simulation.json``."""
        findings = [finding.to_json() for finding in self.checks]
        said = {"settings": self.settings, "honest": self.checks_passed, "honesty": findings}
        return {"schema": SIMULATION_SCHEMA, **asdict(self.metrics), **said}

    def save(self, folder: str | Path, extra: dict | None = None) -> None:
        """Write ``simulation.npz``, then ``simulation.json`` (with ``extra`` entries), each whole or not at all.

        Raises :class:`InputError` if the folder cannot be written.
        """
        text = json.dumps({**self.to_json(), **(extra or {})}, indent=2, allow_nan=False) + "\n"
        np.savez_compressed(logs := io.BytesIO(), **self.arrays())
        write_file(Path(folder) / SIMULATION_NAME, logs.getvalue())
        write_file(Path(folder) / REPORT_NAME, text.encode())

    @classmethod
    def load(cls, folder: str | Path, robot: Robot) -> SimulationResult | None:
        """What :meth:`save` wrote into ``folder``; None if it holds no simulation.

        Raises
        ------
        InputError
            If a file is damaged, or the simulation is not one of ``robot``.
        """
        if not (Path(folder) / SIMULATION_NAME).is_file():
            return None
        logs, said = read_simulation(folder, robot, LOGS), read_json(Path(folder) / REPORT_NAME)
        try:
            names = {name: tuple(logs.pop(name).tolist()) for name in ("link_names", "joint_names")}
            if {len(log) for log in logs.values()} != {logs["t"].size}:
                raise ValueError("logs of different lengths")
            numbers = {f.name: said[f.name] for f in fields(Metrics) if f.name in said}
            metrics = Metrics(**{k: tuple(x) if isinstance(x, list) else x for k, x in numbers.items()})
            findings = tuple(Finding(*(row[f.name] for f in fields(Finding))) for row in said["honesty"])
            settings = dict(said["settings"])
        except (KeyError, TypeError, ValueError) as e:
            why = type(e).__name__
            raise InputError(f"{folder}: not a readable simulation ({why}); simulate the plan again") from e
        for array in logs.values():
            array.setflags(write=False)
        return cls(**logs, **names, metrics=metrics, settings=settings, checks=findings, robot=robot)


LOGS = tuple(f.name for f in fields(SimulationResult) if f.name not in ("metrics", "settings", "checks", "robot"))


class Recorder:
    """Raw log of one run; :meth:`result` derives everything else.

    ``robot`` is the simulated one, perturbed as it is; ``planned_end`` (nq,), the last configuration of the tape, tells
    the height to land on, where the ground really is ``higher_m`` higher; ``links`` are the names of all links.
    """

    def __init__(self, robot: Robot, planned_end: np.ndarray, links: tuple[str, ...], higher_m: float = 0.0):
        self._robot, self._links, self._feet = robot, links, frozenset(robot.foot.frames)
        self._planned_end, self._rows, self._gauge = planned_end, [], Gauge(robot)
        self.fallen_steps, self._higher_m = 0, higher_m

    def add(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray, contacts: Contacts) -> None:
        """Log one step: the state before it, and what acted during it."""
        self._rows.append((q, v, tau, contacts))
        if self.fallen_steps or contacts.touching - self._feet:
            self.fallen_steps += 1

    def result(self, solves: tuple[int, int], settings: dict) -> SimulationResult:
        """The finished record; ``solves`` are the QPs posed and failed.

        Raises :class:`SolverError` if the engine's numbers have exploded.
        """
        q, v, tau = (np.array([row[i] for row in self._rows]) for i in range(3))
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            raise SolverError("the engine lost the robot: its state is not finite", stage="simulation")
        contacts = [row[3] for row in self._rows]
        wrench = np.array([c.wrench for c in contacts])
        liftoff, touchdown = _events(wrench[:, :, 2].sum(axis=1))
        phase = np.full(len(q), "launch", dtype="<U7")
        if liftoff is not None:
            phase[liftoff:] = "flight"
        if touchdown is not None:
            phase[touchdown:] = "landing"
        log = dict(t=np.arange(len(q)) * STEP_S, q=q, v=v, tau=tau, foot_wrench=wrench, phase=phase)
        log |= self._centroidal(q, v)
        log["touching"] = np.array([[name in c.touching for name in self._links] for c in contacts])
        log["colliding"] = np.array([bool(c.colliding) for c in contacts])
        for array in log.values():
            array.setflags(write=False)
        names = dict(link_names=self._links, joint_names=self._robot.joint_names)
        metrics = self._metrics(log, liftoff, touchdown, solves)
        return SimulationResult(**log, **names, metrics=metrics, settings=settings, robot=self._robot)

    def _centroidal(self, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
        model, data, rows = self._robot.model, self._gauge.data, []
        for qk, vk in zip(q, v, strict=True):
            pin.ccrba(model, data, qk, vk)
            velocity = data.hg.linear / self._robot.total_mass
            rows.append((*data.com[0], *velocity, data.hg.angular[1], data.Ig.inertia[1, 1]))
        rows = np.array(rows)
        return dict(com=rows[:, :3], com_velocity=rows[:, 3:6], L=rows[:, 6], rho=rows[:, 7])

    def _metrics(self, log: dict, liftoff: int | None, touchdown: int | None, solves: tuple[int, int]) -> Metrics:
        other = [i for i, name in enumerate(self._links) if name not in self._feet]
        stray, air = log["touching"][:, other], slice(0, touchdown)
        t, q, com, velocity = log["t"], log["q"], log["com"], log["com_velocity"]
        force = log["foot_wrench"][:, :, :3].sum(axis=1)
        found = self._loads(log["v"][:, 6:], log["tau"], air)
        found["standing_s"], found["landed"], found["reason"] = self._verdict(log, stray, liftoff, touchdown)
        found["stray_contacts"] = tuple(self._links[other[i]] for i in np.flatnonzero(stray[air].any(axis=0)))
        found["launch_impulse"] = _xz(force[:liftoff].sum(axis=0) * STEP_S)
        if liftoff is not None:
            found |= dict(
                liftoff_s=float(t[liftoff]),
                com_rise_m=float(com[liftoff : (touchdown or len(com)), 2].max() - com[liftoff, 2]),
                takeoff_velocity=_xz(velocity[liftoff]),
                takeoff_momentum=float(log["L"][liftoff]),
            )
        if touchdown is not None:
            turn = self._gauge.heading(self._planned_end)
            place = self._gauge.soles if turn else self._gauge.toe  # a turn moves the toes, and shall be no distance
            start, touch, end = (place(q[row]) for row in (0, touchdown, -1))
            ahead, window = self._gauge.soles(q[touchdown]) - com[touchdown], round(IMPACT_S / STEP_S)
            yaw = self._gauge.heading(q[-1]) - self._gauge.heading(q[0])
            found |= dict(
                touchdown_s=float(t[touchdown]),
                foot_distance_m=float(end[0] - start[0]),
                foot_distance_touchdown_m=float(touch[0] - start[0]),
                side_m=float(end[1] - start[1]),
                yaw_rad=yaw + 2 * np.pi * round((_turned(q) - yaw) / (2 * np.pi)),
                touchdown_trunk_pitch_rad=_counted(pitch_of(q[: touchdown + 1])),
                touchdown_trunk_rate=float(log["v"][touchdown, 4]),
                touchdown_com_velocity=_xz(_seen(velocity[touchdown], turn)),
                sole_ahead_m=float(_seen(ahead, turn)[0]),
                landing_impulse=_xz(_seen((impact := force[touchdown:][:window]).sum(axis=0), turn) * STEP_S),
                landing_force_n=_largest_mean(impact[:, 2]),
            )
        collisions = STEP_S * float(log["colliding"].sum())
        return Metrics(**found, self_collision_s=collisions, qp_solves=solves[0], qp_failures=solves[1])

    def _verdict(self, log, stray, liftoff, touchdown) -> tuple[float, bool, str]:
        """Seconds on the feet alone after touchdown, whether that is a landing, and why (not)."""
        if liftoff is None:
            return 0.0, False, "the feet never left the ground"
        if touchdown is None:
            return 0.0, False, "the feet never touched down"
        names = [n for n in self._links if n not in self._feet]
        fallen = np.flatnonzero(stray[touchdown:].any(axis=1))
        steps = fallen[0] if len(fallen) else len(log["t"]) - touchdown
        standing = float(steps * STEP_S)
        if len(fallen):
            name = names[int(np.argmax(stray[touchdown + steps]))]
            return standing, False, f"{name} touched the ground {standing:.2f} s after touchdown"
        early = np.flatnonzero(stray[:touchdown].any(axis=1))
        if len(early) and standing < STAND_S:
            name = names[int(np.argmax(stray[early[0]]))]
            before_s = float((touchdown - early[0]) * STEP_S)
            return standing, False, f"{name} touched the ground {before_s:.2f} s before touchdown"
        if standing < STAND_S:
            return standing, False, f"watched for {standing:.2f} s only, not {STAND_S:g} s"
        speed = float(np.linalg.norm(log["com_velocity"][-1]))
        if speed > STILL_SPEED:
            return standing, False, f"still moving at {speed:.2f} m/s at the end"
        if not (log["foot_wrench"][-1, :, 2] > CONTACT_FORCE_N).all():
            return standing, False, "a foot was in the air at the end"
        miss = self._gauge.soles(log["q"][-1])[2] - self._gauge.soles(self._planned_end)[2] - self._higher_m
        if abs(miss) > LEVEL_TOLERANCE_M:
            return standing, False, f"stands {miss:+.2f} m from the height it was meant to land on"
        return standing, True, f"stood for {standing:.2f} s on its feet alone"

    def _loads(self, rate: np.ndarray, tau: np.ndarray, air: slice) -> dict:
        """Torques and speeds as shares of their limits."""
        motors, names = Actuators(self._robot), self._robot.joint_names
        torque, speed = np.abs(tau) / motors.effort, np.abs(rate) / motors.speed
        low, high = motors.range(rate)
        room = np.where(tau > 0, high, -low)
        saturated = (np.abs(tau) >= SATURATED * room) & (np.abs(tau) > 0)

        def by_joint(values: np.ndarray) -> dict[str, float]:
            return {name: float(x) for name, x in zip(names, values, strict=True)}

        out = dict(saturated_s=by_joint(saturated.sum(axis=0) * STEP_S))
        out["overspeed_s"] = by_joint((speed > 1).sum(axis=0) * STEP_S)
        for name, ratio in (("max_torque_ratio", torque), ("max_speed_ratio", speed)):
            out[name], out[f"{name}_before_touchdown"] = float(ratio.max()), float(ratio[air].max())
            out[f"{name}_by_joint"] = by_joint(ratio.max(axis=0))
        return out


def _events(force: np.ndarray) -> tuple[int | None, int | None]:
    """Rows of lift-off and touchdown: the ends of the first long time without vertical force (N,)."""
    edges = np.concatenate([[-1], np.flatnonzero(force > CONTACT_FORCE_N), [len(force)]])
    flights = np.flatnonzero((np.diff(edges) - 1) * STEP_S >= MIN_FLIGHT_S)
    if not len(flights):
        return None, None
    liftoff, touchdown = int(edges[flights[0]]) + 1, int(edges[flights[0] + 1])
    return liftoff, touchdown if touchdown < len(force) else None


def _largest_mean(force: np.ndarray) -> float:
    """Largest mean over :data:`SMOOTHING_S` of a force (N,), which is none before it."""
    window = round(SMOOTHING_S / STEP_S)
    return float(np.convolve(force, np.full(window, 1 / window))[: len(force)].max())


def _xz(vector: np.ndarray) -> tuple[float, float]:
    return float(vector[0]), float(vector[2])


def _seen(vector: np.ndarray, heading_rad: float) -> np.ndarray:
    """A vector (3,) as somebody sees it who looks along a heading; itself if that is zero."""
    if heading_rad == 0:
        return vector
    return pin.rpy.rpyToMatrix(0.0, 0.0, -heading_rad) @ vector


def _turned(q: np.ndarray) -> float:
    """How far the trunk turns about the vertical in configurations ``q`` (N, nq), whole turns counted [rad]."""
    x, y, z, w = q[:, 3:7].T
    yaw = np.unwrap(np.arctan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z)))
    return float(yaw[-1] - yaw[0])


def _counted(pitch: np.ndarray) -> float:
    """The last of pitches (N,) within half a turn [rad], with the whole turns since the first added."""
    turns = round((float(np.unwrap(pitch)[-1]) - float(pitch[-1])) / (2 * np.pi))
    return float(pitch[-1]) + turns * 2 * np.pi
