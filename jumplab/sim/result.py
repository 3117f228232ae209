"""Result of a simulated jump: logs at 1 kHz, numbers measured from them, and its checks.
:func:`record` makes it from the records of every step.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jumplab.arguments import checked
from jumplab.control import STAND_S
from jumplab.control.kinematics import Gauge, Motion, about_vertical, pitch_of
from jumplab.errors import InputError, Shown, SolverError
from jumplab.io.columns import Named
from jumplab.io.folder import read_json, write_file
from jumplab.io.motion import CONTACT_FORCE_N, SIMULATION_NAME, SIMULATION_SCHEMA, read_simulation
from jumplab.robot import Robot
from jumplab.robot.motors import MotorLimits
from jumplab.sim import STEP_S
from jumplab.sim.engine import Log

STILL_SPEED = 0.05  # [m/s] a CoM slower than this at the end stands
LEVEL_TOLERANCE_M = 0.05  # soles this close to the planned height stand on the planned surface
IMPACT_S = 0.1  # the landing impulse is summed over this time after touchdown
# longer than an impact, whose force is a matter of the engine's step, shorter than the catch
SMOOTHING_S = 0.02
SATURATED = 0.999  # share of the available torque that counts as "at the limit"
# a shorter loss of contact is a hop of the launch; the lowest jump flies 0.13 s
MIN_FLIGHT_S = 0.05
LOADED = 0.05  # [1] of the weight
FLOWN_M = 0.01  # way of the toe until the middle of a flight; feet that only carry nothing stay
REPORT_NAME = "simulation.json"
BOTH = 0, 1  # feet
XZ = tuple[float, float]
ByJoint = dict[str, float]
Maybe = float | None  # where the jump did not get so far


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
        return self.value <= self.limit

    def to_json(self) -> dict:
        """Plain data."""
        return {**asdict(self), "passed": self.passed}

    def __str__(self) -> str:
        amount = f"{self.name}: {self.value:.4g} {self.unit}".rstrip()
        return f"{amount} (at most {self.limit:.4g}; {self.catches})"


@dataclass(frozen=True, kw_only=True)
class Metrics(Shown):
    """Numbers of one run, all measured in the simulation; None where it did not get so far.

    Take-off is that of the flight that rises highest, touchdown the end of the last one. Loads are
    ratios ``|value| / limit``, largest over the run; vectors are (x, z), those of the
    landing along the heading in which the robot was meant to land, those of the launch along the
    one in which it began.
    """

    # travel of the toes from the start to where they stand at the end
    foot_distance_m: Maybe = None
    # the same of the feet that are to land, to the touchdown; None unless it is on them
    foot_distance_touchdown_m: Maybe = None
    side_m: Maybe = None  # travel of the soles to the left, from the start to the end
    yaw_rad: Maybe = None  # turn of the feet about the vertical, whole turns counted
    # apex minus CoM at lift-off, the last contact force above a few newtons
    com_rise_m: Maybe = None
    com_apex_m: Maybe = None  # apex minus CoM at the start, where the robot stands and waits
    takeoff_velocity: XZ | None = None  # of the CoM at lift-off [m/s]
    takeoff_momentum: Maybe = None  # L_y at lift-off [kg m^2/s]
    # from touchdown to the end, or until anything but the feet touched the ground
    standing_s: float
    landed: bool
    reason: str  # of that verdict
    max_torque_ratio: float
    max_speed_ratio: float
    max_torque_ratio_before_touchdown: float
    max_speed_ratio_before_touchdown: float
    max_torque_ratio_by_joint: ByJoint
    max_speed_ratio_by_joint: ByJoint
    saturated_s: ByJoint  # by joint: time at its torque limit
    # by joint: beyond its speed limit; a light foot for milliseconds at touchdown
    overspeed_s: ByJoint
    self_collision_s: float  # time during which links of the robot pressed on each other
    # links other than the feet that touched the ground before touchdown
    stray_contacts: tuple[str, ...]
    liftoff_s: Maybe = None
    touchdown_s: Maybe = None
    touchdown_trunk_pitch_rad: Maybe = None  # whole turns counted
    touchdown_trunk_rate: Maybe = None  # about the trunk's own pitch axis [rad/s]
    touchdown_com_velocity: XZ | None = None  # [m/s]
    sole_ahead_m: Maybe = None  # middle of the soles minus CoM at touchdown
    launch_impulse: XZ  # of the ground until lift-off [N s]
    # of the ground in the 0.1 s after touchdown [N s]
    landing_impulse: XZ | None = None
    # largest mean over 20 ms of what presses on both feet then [N]
    landing_force_n: Maybe = None
    # largest way of a toe along the ground while its foot is loaded, until the last touchdown [m]
    slip_m: Maybe = None
    # when, after touchdown, a foot first left to catch the robot elsewhere; where the feet end
    # counts such steps
    recovery_step_s: Maybe = None
    recovery_steps: int = 0
    qp_solves: int  # of the landing controller
    qp_failures: int

    def line(self) -> str:
        """The verdict."""
        return self.reason


@dataclass(frozen=True, repr=False)
class SimulationResult(Shown, Named):
    """Logs of one simulated jump at 1 kHz, its metrics and its settings.

    Row k holds the state at t[k] and what acted in the step that follows.
    """

    t: np.ndarray  # (N,) [s]
    q: np.ndarray  # (N, nq) true configuration in Pinocchio's conventions
    v: np.ndarray  # (N, nv) true velocity
    tau: np.ndarray  # (N, nv - 6) torques that the motors really gave [N m]
    # (N, 2, 6) force and moment on each foot, world axes, at the origin of the foot link
    foot_wrench: np.ndarray
    com: np.ndarray  # (N, 3) of the simulated (perturbed) robot [m]
    com_velocity: np.ndarray  # (N, 3) [m/s]
    L: np.ndarray  # (N,) angular momentum about the pitch axis through the CoM [kg m^2/s]
    rho: np.ndarray  # (N,) total pitch inertia about the CoM [kg m^2]
    # (N,) by the simulated contact forces: "flight", "landing" after the last one, "launch" before
    phase: np.ndarray
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
        far, high = (
            "none" if x is None else f"{x:.3f} m" for x in (m.foot_distance_m, m.com_rise_m)
        )
        many = "s" * (m.recovery_steps > 1)
        stepped = f" after {m.recovery_steps} recovery step{many}" if m.recovery_steps else ""
        verdict = f"stands {m.standing_s:.2f} s{stepped}" if m.landed else f"FAILED, {m.reason}"
        return f"travel {far}, rise {high}, {verdict}"

    @cached_property
    def feet(self) -> np.ndarray:
        """(N, 2, 4, 4) homogeneous transforms of both foot links [m]."""
        return Gauge(self.robot).feet(self.q)

    @cached_property
    def motion(self) -> Motion:
        """Place and motion of the robot as a whole, (N, ...) each."""
        return Gauge(self.robot).motions(self.q, self.v)

    @cached_property
    def stray(self) -> np.ndarray:
        """(N, links) whether a link touches the ground, but for the feet, which shall."""
        return self.touching & ~np.isin(self.link_names, self.robot.foot.frames)

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
        """Reason for the verdict."""
        return self.metrics.reason

    def arrays(self) -> dict[str, np.ndarray]:
        """All logs under the names of ``simulation.npz``."""
        logs = {name: np.asarray(getattr(self, name)) for name in LOGS}
        return {"schema": np.array(SIMULATION_SCHEMA), **logs}

    def to_json(self) -> dict:
        """Metrics, settings and findings as plain data, the content of ``simulation.json``."""
        return dict(
            schema=SIMULATION_SCHEMA,
            **asdict(self.metrics),
            settings=self.settings,
            checks_passed=self.checks_passed,
            checks=[finding.to_json() for finding in self.checks],
        )

    @checked
    def save(self, folder: str | Path, extra: dict | None = None) -> None:
        """Write ``simulation.npz``, then ``simulation.json`` (with ``extra`` entries), each whole
        or not at all.

        Raises :class:`InputError` if the folder cannot be written.
        """
        text = json.dumps({**self.to_json(), **(extra or {})}, indent=2, allow_nan=False) + "\n"
        np.savez_compressed(logs := io.BytesIO(), **self.arrays())
        write_file(Path(folder) / SIMULATION_NAME, logs.getvalue())
        write_file(Path(folder) / REPORT_NAME, text.encode())

    @classmethod
    @checked
    def load(cls, folder: str | Path, robot: Robot) -> SimulationResult | None:
        """Read the simulation that :meth:`save` wrote into ``folder``; None if there is none.
        Raises :class:`InputError` if a file is damaged, or the simulation is not one of ``robot``.
        """
        if not (Path(folder) / SIMULATION_NAME).is_file():
            return None
        logs = read_simulation(folder, robot, LOGS)
        report = checks_named(read_json(Path(folder) / REPORT_NAME))
        try:
            names = {name: tuple(logs.pop(name).tolist()) for name in ("link_names", "joint_names")}
            if {len(log) for log in logs.values()} != {logs["t"].size}:
                raise ValueError("logs of different lengths")
            numbers = {f.name: report[f.name] for f in fields(Metrics) if f.name in report}
            plain = {k: tuple(x) if isinstance(x, list) else x for k, x in numbers.items()}
            metrics = Metrics(**plain)
            findings = tuple(
                Finding(*(row[f.name] for f in fields(Finding))) for row in report["checks"]
            )
            settings = dict(report["settings"])
        except (KeyError, TypeError, ValueError) as e:
            why = type(e).__name__
            raise InputError(
                f"{folder}: not a readable simulation ({why}); simulate the plan again"
            ) from e
        for array in logs.values():
            array.setflags(write=False)
        return cls(
            **logs, **names, metrics=metrics, settings=settings, checks=findings, robot=robot
        )


LOGS = tuple(
    f.name
    for f in fields(SimulationResult)
    if f.name not in ("metrics", "settings", "checks", "robot")
)
OLD_NAMES = {"honest": "checks_passed", "honesty": "checks"}  # in reports of earlier versions


def checks_named(report: dict) -> dict:
    """A ``report``, the content of ``simulation.json``, in today's words."""
    return {OLD_NAMES.get(name, name): value for name, value in report.items()}


def record(
    robot: Robot,
    steps: Log,
    links: tuple[str, ...],
    goal: np.ndarray,
    *,
    higher_m: float = 0.0,
    flights: int = 1,
    lands: Sequence[int] = BOTH,
    solves: tuple[int, int] = (0, 0),
    steps_s: Sequence[float] = (),
    settings: dict | None = None,
) -> SimulationResult:
    """The finished record of a run of ``robot`` as it really is, whose ``links`` are named.

    ``steps`` are those of the engine; ``goal`` (nq,) is how the tape ends, where the ground is
    really ``higher_m`` higher [m], after so many ``flights``, of which the last one ends on the
    feet ``lands`` (0 left, 1 right); ``solves`` are QPs posed and failed, ``steps_s`` times of
    recovery steps. Raises :class:`SolverError` if the engine's numbers have exploded.
    """
    q, v, _, wrench, *_ = steps
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        raise SolverError("the engine lost the robot: its state is not finite", stage="simulation")
    gauge = Gauge(robot)
    flown = events(wrench[:, :, 2].sum(axis=1), lambda row: gauge.toe(q[row]), flights)
    phase = np.full(len(q), "launch", dtype="<U7")
    for liftoff, touchdown in flown:
        phase[liftoff:touchdown] = "flight"
    if len(flown) == flights and flown[-1][1] is not None:
        phase[flown[-1][1] :] = "landing"
    motion = gauge.motions(q, v)
    log = dict(
        **steps._asdict(),
        t=np.arange(len(q)) * STEP_S,
        phase=phase,
        com=motion.com,
        com_velocity=motion.velocity,
        L=motion.momentum[:, 1],
        rho=motion.inertia[:, 1, 1],
    )
    for array in log.values():
        array.setflags(write=False)
    names = dict(link_names=links, joint_names=robot.joint_names)
    run = SimulationResult(**log, **names, metrics=None, settings=settings or {}, robot=robot)
    vars(run)["motion"] = motion  # known already
    jump = _Jump(run, gauge, goal, flown, flights, list(lands))
    standing_s, landed, reason = jump.verdict(higher_m)
    metrics = Metrics(
        **jump.loads(),
        **jump.launch(),
        **jump.landing(),
        standing_s=standing_s,
        landed=landed,
        reason=reason,
        self_collision_s=STEP_S * float(run.colliding.sum()),
        qp_solves=solves[0],
        qp_failures=solves[1],
        recovery_step_s=next(iter(steps_s), None),
        recovery_steps=len(steps_s),
    )
    # no copy, which would have to find the feet anew
    object.__setattr__(run, "metrics", metrics)
    return run


@dataclass
class _Jump:
    """Measurements of a run: names and values of :class:`Metrics`. The flights in ``flown`` are
    rows of its log.
    """

    run: SimulationResult
    gauge: Gauge
    goal: np.ndarray
    flown: list[tuple[int, int | None]]
    flights: int
    lands: list[int]

    @cached_property
    def liftoff(self) -> int | None:
        """Row in which the highest flight begins."""
        return max(self.flown, key=self.rise, default=(None, None))[0]

    @property
    def touchdown(self) -> int | None:
        """Row in which the last flight ends."""
        return self.flown[-1][1] if len(self.flown) == self.flights else None

    def rise(self, rows: tuple[int, int | None]) -> float:
        """Apex minus CoM at the beginning of a flight [m]."""
        height = self.run.com[slice(*rows), 2]
        return float(height.max() - height[0])

    def launch(self) -> dict[str, Any]:
        """Up to the touchdown."""
        run = self.run
        liftoff = self.liftoff
        stray = run.stray[: self.touchdown].any(axis=0)
        out = dict(
            stray_contacts=tuple(run.link_names[i] for i in np.flatnonzero(stray)),
            launch_impulse=_xz(run.foot_wrench[:liftoff, :, :3].sum(axis=(0, 1)) * STEP_S),
            slip_m=self.slip(),
        )
        if liftoff is None:
            return out
        rise = max(map(self.rise, self.flown))
        return out | dict(
            liftoff_s=float(run.t[liftoff]),
            com_rise_m=rise,
            com_apex_m=rise + float(run.com[liftoff, 2] - run.com[0, 2]),
            takeoff_velocity=_xz(run.com_velocity[liftoff]),
            takeoff_momentum=float(run.L[liftoff]),
        )

    def slip(self) -> float:
        """The largest way of a toe along the ground, of those that a foot goes while it is loaded,
        until the last touchdown [m].
        """
        robot = self.run.robot
        rows = slice(0, self.touchdown)
        loaded = self.run.foot_wrench[rows, :, 2] > LOADED * robot.total_mass * robot.gravity
        tips = (self.run.feet[rows] @ [*robot.foot.tip, 1.0])[..., :3]
        ways = [0.0]
        for down, tip in zip(loaded.T, tips.swapaxes(0, 1), strict=True):
            edges = np.flatnonzero(np.diff(down.astype(int), prepend=0, append=0)).reshape(-1, 2)
            ways += [np.linalg.norm((tip[a:b] - tip[a])[:, :2], axis=1).max() for a, b in edges]
        return float(max(ways))

    def landing(self) -> dict[str, Any]:
        """From the touchdown on; nothing if there is none."""
        run = self.run
        down = self.touchdown
        if down is None:
            return {}
        gauge = self.gauge
        heading = gauge.heading(self.goal)
        foot = run.robot.foot
        # a turn moves the toes, and shall be no distance
        point = foot.center if heading else foot.tip
        start, touch, end = (gauge.points(run.q[row], point) for row in (0, down, -1))
        way = (end - start).mean(axis=0)
        heights = gauge.points(run.q[down], foot.center)[:, 2]
        on_them = heights[self.lands].max() - heights.min() < LEVEL_TOLERANCE_M
        seen = about_vertical(-heading)
        impact = run.foot_wrench[down:, :, :3].sum(axis=1)[: round(IMPACT_S / STEP_S)]
        window = round(SMOOTHING_S / STEP_S)
        means = np.convolve(impact[:, 2], np.full(window, 1 / window))[: len(impact)]
        yaw = gauge.heading(run.q[-1]) - gauge.heading(run.q[0])
        # with as many whole turns as the trunk has made
        x, y, z, w = run.q[:, 3:7].T
        trunk = np.unwrap(np.arctan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z)))
        landed_m = float((touch - start)[self.lands, 0].mean())
        return dict(
            touchdown_s=float(run.t[down]),
            foot_distance_m=float(way[0]),
            foot_distance_touchdown_m=landed_m if on_them else None,
            side_m=float(way[1]),
            yaw_rad=float(np.unwrap([trunk[-1] - trunk[0], yaw])[1]),
            touchdown_trunk_pitch_rad=float(np.unwrap(pitch_of(run.q[: down + 1]))[-1]),
            touchdown_trunk_rate=float(run.v[down, 4]),
            touchdown_com_velocity=_xz(seen @ run.com_velocity[down]),
            sole_ahead_m=float((seen @ (gauge.soles(run.q[down]) - run.com[down]))[0]),
            landing_impulse=_xz(seen @ impact.sum(axis=0) * STEP_S),
            landing_force_n=float(means.max()),
        )

    def verdict(self, higher_m: float) -> tuple[float, bool, str]:
        """Seconds on the feet alone after touchdown, whether that is a landing, and why (not)."""
        run = self.run
        down = self.touchdown
        fallen = np.flatnonzero(run.stray.any(axis=1))
        if down is None:
            return 0.0, False, self._unfinished(fallen)
        after = fallen[fallen >= down]
        standing = float(([*after, len(run.t)][0] - down) * STEP_S)
        # a fall in the air is told only of a robot that did not stand
        falls = [*after, *(fallen if standing < STAND_S else ())]
        speed = float(np.linalg.norm(run.com_velocity[-1]))
        miss = (self.gauge.soles(run.q[-1]) - self.gauge.soles(self.goal))[2] - higher_m
        if falls:
            side = "after" if falls[0] >= down else "before"
            when = f"{abs(falls[0] - down) * STEP_S:.2f} s {side} touchdown"
            reason = f"{self._link(falls[0])} touched the ground {when}"
        elif standing < STAND_S:
            reason = f"watched for {standing:.2f} s only, not {STAND_S:g} s"
        elif speed > STILL_SPEED:
            reason = f"still moving at {speed:.2f} m/s at the end"
        elif not (run.foot_wrench[-1, :, 2] > CONTACT_FORCE_N).all():
            reason = "a foot was in the air at the end"
        elif abs(miss) > LEVEL_TOLERANCE_M:
            reason = f"stands {miss:+.2f} m from the height it was meant to land on"
        else:
            return standing, True, f"stood for {standing:.2f} s on its feet alone"
        return standing, False, reason

    def _link(self, row: int) -> str:
        """The first link that lies on the ground in a row."""
        return self.run.link_names[int(np.argmax(self.run.stray[row]))]

    def _unfinished(self, fallen: np.ndarray) -> str:
        """Reason why there is no last touchdown; the robot has ``fallen`` in these rows."""
        if not self.flown:
            return "the feet never left the ground"
        if self.flights == 1:
            return "the feet never touched down"
        fell = ""
        if len(fallen):
            when = f"{fallen[0] * STEP_S:.2f} s"
            fell = f", {self._link(fallen[0])} touched the ground after {when}"
        return f"{len(self.flown)} of {self.flights} flights were begun{fell}"

    def loads(self) -> dict[str, Any]:
        """Torques and speeds as shares of their limits."""
        run = self.run
        rates = run.v[:, 6:]
        motors = run.robot.limits
        torque = np.abs(run.tau) / motors.effort
        speed = np.abs(rates) / motors.speed

        by_joint = {
            "saturated_s": motors_spent(motors, run.tau, rates).sum(axis=0) * STEP_S,
            "overspeed_s": (speed > 1).sum(axis=0) * STEP_S,
        }
        out: dict[str, Any] = {}
        for name, ratio in (("max_torque_ratio", torque), ("max_speed_ratio", speed)):
            out[name] = float(ratio.max())
            out[f"{name}_before_touchdown"] = float(ratio[: self.touchdown].max())
            by_joint[f"{name}_by_joint"] = ratio.max(axis=0)
        for name, values in by_joint.items():
            out[name] = dict(zip(run.joint_names, values.tolist(), strict=True))
        return out


def motors_spent(motors: MotorLimits, tau: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Whether torques ``tau`` (N, n) [N m] at ``rates`` (N, n) [rad/s] are at the motors' limits,
    entry by entry.
    """
    low, high = motors.range(rates)
    return (np.abs(tau) >= SATURATED * np.where(tau > 0, high, -low)) & (tau != 0)


def events(
    force: np.ndarray, toe: Callable[[int], np.ndarray], flights: int = 1
) -> list[tuple[int, int | None]]:
    """Rows of lift-off and touchdown of the first ``flights``: long times without vertical
    ``force`` (N,) [N] in which the ``toe`` moves, (3,) [m] at each row. Where gravity is small, a
    crouch leaves no force either, but the feet stay.
    """
    edges = np.concatenate([[-1], np.flatnonzero(force > CONTACT_FORCE_N), [len(force)]])
    flown: list[tuple[int, int | None]] = []
    for k in np.flatnonzero((np.diff(edges) - 1) * STEP_S >= MIN_FLIGHT_S):
        liftoff, touchdown = int(edges[k]) + 1, int(edges[k + 1])
        middle = (liftoff + touchdown) // 2
        if len(flown) < flights and np.linalg.norm(toe(middle) - toe(liftoff)) > FLOWN_M:
            flown.append((liftoff, touchdown if touchdown < len(force) else None))
    return flown


def _xz(vector: np.ndarray) -> XZ:
    return float(vector[0]), float(vector[2])
