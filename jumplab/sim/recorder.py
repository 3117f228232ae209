"""Collects the raw log of a run and measures it: lift-off, touchdown, distance, rise, standing, limits."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.errors import SolverError
from jumplab.robot import Robot
from jumplab.sim.actuation import Actuators
from jumplab.sim.checks import STAND_S
from jumplab.sim.result import Metrics, SimulationResult
from jumplab.sim.world import STEP_S, Contacts

CONTACT_FORCE_N = 5.0  # our choice: "a few newtons"; a height threshold would see the lift-off 20 ms late
STILL_SPEED = 0.05  # [m/s] our choice: a CoM slower than this at the end stands
LEVEL_TOLERANCE_M = 0.05  # our choice: soles this close to the planned height stand on the planned surface
IMPACT_S = 0.1  # our choice: the landing impulse is summed over this time after touchdown
SATURATED = 0.999  # our choice: share of the available torque that counts as "at the limit"
MIN_FLIGHT_S = 0.05  # our choice: a shorter loss of contact is a hop of the launch; the lowest jump flies 0.13 s


class Recorder:
    """Raw log of one run; :meth:`result` derives everything else.

    Parameters
    ----------
    robot : the simulated robot, perturbed as it is.
    planned_end : (nq,) last configuration of the tape, which tells the height to land on.
    links : names of all links.
    """

    def __init__(self, robot: Robot, planned_end: np.ndarray, links: tuple[str, ...]):
        self._robot, self._links, self._feet = robot, links, frozenset(robot.foot.frames)
        self._planned_end, self._rows = planned_end, []
        self.fallen_steps = 0

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
            raise SolverError("PyBullet lost the robot: its state is not finite", stage="simulation")
        contacts = [row[3] for row in self._rows]
        wrench = np.array([c.wrench for c in contacts])
        touching = np.array([[name in c.touching for name in self._links] for c in contacts])
        colliding = np.array([bool(c.colliding) for c in contacts])
        com, com_velocity, momentum, inertia = _centroidal(self._robot, q, v)
        liftoff, touchdown = _events(wrench[:, :, 2].sum(axis=1))
        phase = np.full(len(q), "launch", dtype="<U7")
        if liftoff is not None:
            phase[liftoff:] = "flight"
        if touchdown is not None:
            phase[touchdown:] = "landing"
        log = dict(
            t=np.arange(len(q)) * STEP_S, q=q, v=v, tau=tau, foot_wrench=wrench, com=com, com_velocity=com_velocity,
            L=momentum, rho=inertia, phase=phase, touching=touching, colliding=colliding)  # fmt: skip
        metrics = self._metrics(log, liftoff, touchdown, STEP_S * float(colliding.sum()), solves)
        for array in log.values():
            array.setflags(write=False)
        return SimulationResult(**log, link_names=self._links, joint_names=self._robot.joint_names, metrics=metrics,
                                settings=settings)  # fmt: skip

    # measuring -------------------------------------------------------------------------------------------------

    def _metrics(self, log, liftoff, touchdown, collisions, solves) -> Metrics:
        other = [i for i, name in enumerate(self._links) if name not in self._feet]
        stray = log["touching"][:, other]
        standing, landed, reason = self._verdict(log, stray, liftoff, touchdown)
        air = slice(0, len(log["t"]) if touchdown is None else touchdown)
        flew, down = liftoff is not None, touchdown is not None
        com, velocity, force = log["com"], log["com_velocity"], log["foot_wrench"][:, :, :3].sum(axis=1)
        start = self._feet_middle(log["q"][0], self._robot.foot.toe)[0]
        soles_ahead = pitch = None
        if down:
            soles_ahead = float(self._feet_middle(log["q"][touchdown])[0] - com[touchdown, 0])
            pitch = _counted(np.array([_pitch(q) for q in log["q"][: touchdown + 1]]))
        return Metrics(
            foot_distance_m=self._toe_at(log, -1) - start if down else None,
            foot_distance_touchdown_m=self._toe_at(log, touchdown) - start if down else None,
            com_rise_m=float(com[liftoff : (touchdown or len(com)), 2].max() - com[liftoff, 2]) if flew else None,
            takeoff_velocity=_xz(velocity[liftoff]) if flew else None,
            takeoff_momentum=float(log["L"][liftoff]) if flew else None,
            standing_s=standing, landed=landed, reason=reason,
            **self._loads(log["v"][:, 6:], log["tau"], air),
            self_collision_s=collisions,
            stray_contacts=tuple(self._links[other[i]] for i in np.flatnonzero(stray[air].any(axis=0))),
            liftoff_s=float(log["t"][liftoff]) if flew else None,
            touchdown_s=float(log["t"][touchdown]) if down else None,
            touchdown_trunk_pitch_rad=pitch,
            touchdown_com_velocity=_xz(velocity[touchdown]) if down else None,
            sole_ahead_m=soles_ahead,
            launch_impulse=_xz(force[:liftoff].sum(axis=0) * STEP_S),
            landing_impulse=_xz(force[touchdown:][: round(IMPACT_S / STEP_S)].sum(axis=0) * STEP_S) if down else None,
            qp_solves=solves[0], qp_failures=solves[1])  # fmt: skip

    def _verdict(self, log, stray, liftoff, touchdown) -> tuple[float, bool, str]:
        """Seconds on the feet alone after touchdown, whether that is a landing, and why (not)."""
        if liftoff is None:
            return 0.0, False, "the feet never left the ground"
        if touchdown is None:
            return 0.0, False, "the feet never touched down"
        fallen = np.flatnonzero(stray[touchdown:].any(axis=1))
        steps = fallen[0] if len(fallen) else len(log["t"]) - touchdown
        standing = float(steps * STEP_S)
        if len(fallen):
            names = [n for n in self._links if n not in self._feet]
            name = names[int(np.argmax(stray[touchdown + steps]))]
            return standing, False, f"{name} touched the ground {standing:.2f} s after touchdown"
        if standing < STAND_S:
            return standing, False, f"watched for {standing:.2f} s only, not {STAND_S:g} s"
        speed = float(np.linalg.norm(log["com_velocity"][-1]))
        if speed > STILL_SPEED:
            return standing, False, f"still moving at {speed:.2f} m/s at the end"
        if not (log["foot_wrench"][-1, :, 2] > CONTACT_FORCE_N).all():
            return standing, False, "a foot was in the air at the end"
        miss = self._feet_middle(log["q"][-1])[2] - self._feet_middle(self._planned_end)[2]
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

        def by_joint(values):
            return {name: float(x) for name, x in zip(names, values, strict=True)}

        return dict(
            max_torque_ratio=float(torque.max()), max_speed_ratio=float(speed.max()),
            max_torque_ratio_before_touchdown=float(torque[air].max()),
            max_speed_ratio_before_touchdown=float(speed[air].max()),
            max_torque_ratio_by_joint=by_joint(torque.max(axis=0)),
            max_speed_ratio_by_joint=by_joint(speed.max(axis=0)),
            saturated_s=by_joint(saturated.sum(axis=0) * STEP_S),
            overspeed_s=by_joint((speed > 1).sum(axis=0) * STEP_S))  # fmt: skip

    def _toe_at(self, log, row: int) -> float:
        return float(self._feet_middle(log["q"][row], self._robot.foot.toe)[0])

    def _feet_middle(self, q: np.ndarray, x: float | None = None) -> np.ndarray:
        """Mean over both feet (3,) of the sole's point at ``x`` along the foot; of its middle if None [m]."""
        model, foot = self._robot.model, self._robot.foot
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        point = foot.center if x is None else np.array([x, 0.0, foot.sole_z])
        return np.mean([data.oMf[model.getFrameId(name)].act(point) for name in foot.frames], axis=0)


def _centroidal(robot: Robot, q: np.ndarray, v: np.ndarray):
    """CoM (N, 3), its velocity (N, 3), L_y (N,), pitch inertia (N,) of a log."""
    model, data, rows = robot.model, robot.model.createData(), []
    for qk, vk in zip(q, v, strict=True):
        pin.ccrba(model, data, qk, vk)
        rows.append((*data.com[0], *(data.hg.linear / robot.total_mass), data.hg.angular[1], data.Ig.inertia[1, 1]))
    rows = np.array(rows)
    return rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7]


def _events(force: np.ndarray) -> tuple[int | None, int | None]:
    """Rows of lift-off and touchdown: the ends of the first long time without vertical force (N,)."""
    edges = np.concatenate([[-1], np.flatnonzero(force > CONTACT_FORCE_N), [len(force)]])
    flights = np.flatnonzero((np.diff(edges) - 1) * STEP_S >= MIN_FLIGHT_S)
    if not len(flights):
        return None, None
    liftoff, touchdown = int(edges[flights[0]]) + 1, int(edges[flights[0] + 1])
    return liftoff, touchdown if touchdown < len(force) else None


def _xz(vector: np.ndarray) -> tuple[float, float]:
    return float(vector[0]), float(vector[2])


def _pitch(q: np.ndarray) -> float:
    x, y, z, w = q[3:7]
    return float(np.arctan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y)))


def _counted(pitch: np.ndarray) -> float:
    """The last of pitches (N,) within half a turn [rad], with the whole turns since the first added."""
    turns = round((float(np.unwrap(pitch)[-1]) - float(pitch[-1])) / (2 * np.pi))
    return float(pitch[-1]) + turns * 2 * np.pi
