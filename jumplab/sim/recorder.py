"""Collects the raw log of a run and measures it: lift-off, touchdown, distance, rise, standing, limits."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.errors import SolverError
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.actuation import Actuators
from jumplab.sim.kinematics import Gauge, pitch_of
from jumplab.sim.result import STAND_S, Metrics, SimulationResult
from jumplab.sim.scene import Contacts

CONTACT_FORCE_N = 5.0  # "a few newtons"; a height threshold would see the lift-off 20 ms late
STILL_SPEED = 0.05  # [m/s] a CoM slower than this at the end stands
LEVEL_TOLERANCE_M = 0.05  # soles this close to the planned height stand on the planned surface
IMPACT_S = 0.1  # the landing impulse is summed over this time after touchdown
SATURATED = 0.999  # share of the available torque that counts as "at the limit"
MIN_FLIGHT_S = 0.05  # a shorter loss of contact is a hop of the launch; the lowest jump flies 0.13 s


class Recorder:
    """Raw log of one run; :meth:`result` derives everything else.

    ``robot`` is the simulated one, perturbed as it is; ``planned_end`` (nq,), the last configuration of the tape, tells
    the height to land on; ``links`` are the names of all links.
    """

    def __init__(self, robot: Robot, planned_end: np.ndarray, links: tuple[str, ...]):
        self._robot, self._links, self._feet = robot, links, frozenset(robot.foot.frames)
        self._planned_end, self._rows, self._gauge = planned_end, [], Gauge(robot)
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
        return SimulationResult(**log, **names, metrics=metrics, settings=settings)

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
            start, touch, end = (float(self._gauge.toe(q[row])[0]) for row in (0, touchdown, -1))
            found |= dict(
                touchdown_s=float(t[touchdown]),
                foot_distance_m=end - start,
                foot_distance_touchdown_m=touch - start,
                touchdown_trunk_pitch_rad=_counted(pitch_of(q[: touchdown + 1])),
                touchdown_com_velocity=_xz(velocity[touchdown]),
                sole_ahead_m=float(self._gauge.soles(q[touchdown])[0] - com[touchdown, 0]),
                landing_impulse=_xz(force[touchdown:][: round(IMPACT_S / STEP_S)].sum(axis=0) * STEP_S),
            )
        collisions = STEP_S * float(log["colliding"].sum())
        return Metrics(**found, self_collision_s=collisions, qp_solves=solves[0], qp_failures=solves[1])

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
        miss = self._gauge.soles(log["q"][-1])[2] - self._gauge.soles(self._planned_end)[2]
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


def _xz(vector: np.ndarray) -> tuple[float, float]:
    return float(vector[0]), float(vector[2])


def _counted(pitch: np.ndarray) -> float:
    """The last of pitches (N,) within half a turn [rad], with the whole turns since the first added."""
    turns = round((float(np.unwrap(pitch)[-1]) - float(pitch[-1])) / (2 * np.pi))
    return float(pitch[-1]) + turns * 2 * np.pi
