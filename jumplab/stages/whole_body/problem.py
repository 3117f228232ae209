"""A contact schedule as a problem: one phase after the other, with shared nodes where nothing
jumps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import itemgetter

import casadi as ca
import numpy as np

from jumplab.models.spatial import CHART
from jumplab.ocp.problem import Bound, Phase, Problem, Term
from jumplab.ocp.solution import PhaseSolution
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import HOLD, SIDES, Contacts
from jumplab.stages.whole_body.coordinates import BASE, Coordinates, whole
from jumplab.stages.whole_body.instant import Instant
from jumplab.stages.whole_body.mode import Mode
from jumplab.stages.whole_body.settings import Limits, Weights
from jumplab.stages.whole_body.shapes import Apart
from jumplab.stages.whole_body.terms import (
    body_clearance,
    bus_power,
    distance_flown,
    dynamics,
    flight_rows,
    foot_rows,
    gentle_heels,
    largest,
    link_distance,
    loads,
    motor_lines,
    opening_rows,
    over_block,
    rebound_rows,
    reserve,
    rise,
    sides_apart,
    smoothness,
    swing_rows,
    torsion,
    touchdown_rows,
    trunk_clearance,
)
from jumplab.stages.whole_body.tracking import following, tracking
from jumplab.task import RANGES

NAME = "whole body"
SCALES = {"q": 1.0, "v": 10.0, "a": 100.0}  # peaks of solutions, for conditioning
ANGLE_BOX_RAD = 15.0  # beyond two full turns
RATE_BOX = 60.0  # [rad/s, m/s] of the base
# of the flight's constants: the CoM at take-off [m], its velocity there [m/s], angular momentum
# [kg m^2/s]; scale
FLIGHT_BOXES = {"com": (-10.0, 10.0, 1.0), "vel": (-8.0, 8.0, 1.0), "L": (-200.0, 200.0, 10.0)}
TRACKED_IN_FLIGHT = {"rho": 1, "rho_rate": 1}  # references and their sizes
TRACKED = {**TRACKED_IN_FLIGHT, "velocity": 2, "L": 1}
PARAMETERS = dict(distance=1, side=1, yaw=1, platform=1, edge=1, along=2)
PARAMETERS |= dict(takeoff_speed=1, rotation=1, gravity=1, straight=1)

# parameters of the target that can be unknowns, each with a field of :class:`.JumpTask`; they go as
# far as that does
SOUGHT = {
    "distance": "distance_m",
    "side": "side_m",
    "platform": "platform_m",
    "yaw": "yaw_rad",
    "takeoff_speed": "height_m",
}


@dataclass(eq=False, repr=False)
class Schedule:
    """A schedule for one robot: the modes of contact, and the problem that they make.

    ``apart`` has rows for links that met; ``free`` are all coordinates if None; with ``tracking``
    a jump follows stage 1's trajectories, or it ``follows`` a given motion. ``sought`` are
    parameters of the target that are unknowns (of :data:`SOUGHT`), the first one as large as
    possible.
    """

    body: Body
    contacts: Contacts
    limits: Limits
    weights: Weights
    apart: tuple[Apart, ...] = ()
    free: Coordinates | None = None
    tracking: bool = False
    follows: bool = False
    sought: tuple[str, ...] = ()

    def __post_init__(self):
        self.free = self.free or whole(self.body)
        given = self.body, self.limits, self.weights
        self.modes = [Mode(*given, p.feet, self.free) for p in self.contacts.phases]

    def landed(self, k: int) -> list[int]:
        """Sides (0 left, 1 right) of the feet that come down as a phase starts; at first none."""
        phases = self.contacts.phases
        before = phases[max(k - 1, 0)].modes
        return [side for side in phases[k].modes if side not in before]

    @cached_property
    def _rebounds(self) -> tuple[int, ...]:
        """Of the schedule; a clip has its own ones."""
        return () if self.follows else self.contacts.rebounds

    @cached_property
    def whole(self) -> Schedule:
        """The same with every coordinate free."""
        if not self.free.even:
            return self
        return Schedule(self.body, self.contacts, self.limits, self.weights, self.apart)

    def spread(self, phases: Mapping[str, PhaseSolution]) -> dict[str, PhaseSolution]:
        """A solution as one of :attr:`whole`: q (n, 6 + joints), z (n, all states)."""
        if not self.free.even:
            return dict(phases)
        return {name: self._spread(k, x) for k, (name, x) in enumerate(phases.items())}

    def _spread(self, k: int, phase: PhaseSolution) -> PhaseSolution:
        mode = self.modes[k]
        every = self.whole.modes[k]
        motion = {}
        for level, name in enumerate("qvaj"):
            x = getattr(phase, name)
            heels = [x[:, mode.nv] for _ in every.raised]
            motion[name] = np.column_stack([self.free.charts(x, level), *heels])
        forces = [mode.spread_forces(phase.z[:, : mode.n_forces], side) for side in every.modes]
        torques = np.zeros((len(phase.z), mode.nv))
        torques[:, mode.nv - len(self.free.joints) :] = phase.z[:, mode.n_forces :]
        z = np.column_stack([*forces, self.free.charts(torques, 1)[:, BASE:]])
        constants = dict(phase.constants)
        if mode.flying:
            constants = dict.fromkeys(every.constants, 0.0) | constants
        if 1 in every.modes:
            for x, sign in (("x", 1.0), ("y", -1.0), ("z", 1.0), ("yaw", -1.0)):
                constants[f"right_{x}"] = sign * phase.constants[f"left_{x}"]
        return replace(phase, **motion, z=z, constants=constants)

    def problem(self) -> Problem:
        """All phases in one problem."""
        phases = tuple(self._phase(k) for k in range(len(self.contacts.phases)))
        parameters = {"stance": self.modes[0].nv, **PARAMETERS}
        if not self.tracking:
            joining = (self._distance(),) if self.contacts.aimed else ()
            return Problem(NAME, phases, joining, parameters)

        def longer(ends):
            launch = ca.vertcat(ends["flat"].end.duration, ends["toe"].end.duration)
            return launch - ends["flat"].end.p.launch_s

        weight = self.weights.track_duration
        joining = Term(
            "track durations", "ours: fixed in the paper", "s", "problem", longer, weight
        )
        return Problem(NAME, phases, (joining,), {**parameters, "momentum": 1, "launch_s": 2})

    def _distance(self) -> Term:
        """The distance of the target, from the feet that leave last to those that land."""
        flight = self.contacts.last_flight
        left = [(flight - 1, side) for side in self.modes[flight - 1].sides]
        landed: dict[int, int] = {}
        for k in range(flight + 1, len(self.modes)):
            for side in self.landed(k):
                landed.setdefault(side, k)
        landed = [(k, side) for side, k in landed.items() if side in self.free.sides]
        return distance_flown(self.body, [p.name for p in self.contacts.phases], left, landed)

    def _terms(self, k: int) -> list[Term]:
        """Terms of a phase, from those that every phase has to those of its end."""
        m = self.modes[k]
        phases = self.contacts.phases
        last = k == len(phases) - 1
        landed = self.landed(k)
        once = (int(k > 0 and not landed), 0)  # the phase before has the rows of a shared node
        terms = [*smoothness(m, self.follows), *dynamics(m, once), motor_lines(m, once)]
        terms += bus_power(m, once)
        terms += [body_clearance(m), *sides_apart(m)]
        for side in m.sides:  # a first node that is given or shared needs no rows
            terms += foot_rows(m, side, not landed, side in landed)
        swinging = [side for side in self.free.sides if side not in m.modes]
        terms += [swing_rows(m, side, self.follows) for side in swinging]
        if self.contacts.over and len(m.modes) < len(SIDES):
            terms.append(over_block(m, self.contacts.over, self._beside_block_m()))
        if m.flying:
            terms += opening_rows(m)
        if self.tracking:
            terms += tracking(m)
        if self.follows:
            terms += following(m, landed)
        if m.feet == "LR" or (self.follows and m.feet.isupper()):
            terms += reserve(m)
        # where one foot steps the load goes from foot to foot
        steps = any(len(p.modes) == 1 for p in phases[max(k - 1, 0) : k + 2])
        if m.feet == "LR" and not steps and (m.limits.least_push or not m.free.even):
            terms.append(loads(m))
        if not self.free.even:
            terms += [torsion(m, side) for side in m.sides]
        if m.flying:
            terms += flight_rows(m)
        if last and self.contacts.ends == "touchdown":
            terms += touchdown_rows(m)
        if k in self._rebounds:
            terms += rebound_rows(m)
        if self.contacts.aimed and k == self.contacts.last_flight:
            terms.append(rise())
        met = [x for x in self.apart if x.phase == k]
        terms += [link_distance(m, x, phases[k].intervals) for x in met]
        if self.sought and m.raised:
            terms.append(gentle_heels(m))
        if self.sought and self.body.trunk_boxes:
            terms.append(trunk_clearance(m))
        if last and self.sought:
            terms.append(largest(self.sought[0]))
        return terms

    def _beside_block_m(self) -> float:
        """Least distance of a foothold from the schedule's block [m]; of one that the target
        places, a usual one.
        """
        begin, end, _ = self.contacts.over
        length = 2 * self.body.half_m
        places = (*self.contacts.first, *self.contacts.places)
        known = [x.ahead_m for i, x in enumerate(places) if not self.contacts.is_aimed(i)]
        away = [max(begin - toe, toe - length - end) for toe in known]
        return min(away + [self.limits.edge_step_m] * self.contacts.aimed)

    def _phase(self, k: int) -> Phase:
        mode = self.modes[k]
        given = self.contacts.phases[k]
        landed = self.landed(k)
        swinging = [side for side in self.free.sides if side not in mode.modes]
        references = {f"{SIDES[side]}_clearance": 1 for side in swinging}
        if self.tracking:
            references |= TRACKED_IN_FLIGHT if mode.flying else TRACKED
        if self.follows:
            references |= {"chart": len(self.body.stance), "lasts": 1}
            references |= {f"{SIDES[side]}_hold": len(HOLD) for side in landed}
        effort = np.maximum(mode.motors.effort, 1.0)
        sizes = np.concatenate([np.full(mode.n_forces, self.body.mg), effort])
        return Phase(
            given.name,
            mode.coordinates,
            given.intervals,
            given.time_s,
            tuple(self._terms(k)),
            (*self._boxes(mode), *self._ends(k)),
            mode.states,
            self._constants(k),
            references,
            SCALES | {"z": sizes},
            partial(Instant, mode),
            mode.integrated,
            "" if not k else "qv" if landed else "qvaz",
            mode.feet,
        )

    def _constants(self, k: int) -> dict:
        """Footholds of the feet that carry, by contact; in flight the CoM's parabola and L."""
        mode = self.modes[k]
        out = {}
        if mode.flying:
            out = {name: FLIGHT_BOXES[name.partition("_")[0]] for name in mode.constants}
        for side in mode.sides:
            contact = self.contacts.contact_of(k, side)
            hold = dict(zip(HOLD, self.foothold(contact), strict=True))
            if self.contacts.is_aimed(contact):
                height = partial(_landing_height, hold["z"][0])
                hold |= {"x": FLIGHT_BOXES["com"][:2], "z": (height, height)}
            for x, (low, high) in hold.items():
                out[f"{SIDES[side]}_{x}"] = (low, high, 1.0, f"contact {contact} {x}")
        for name in self.sought:
            # the largest one lies ahead, and a solver that steps over 0 may stay there
            ends = (partial(_furthest, name, max(0.0, x)) for x in RANGES[SOUGHT[name]][1:])
            out[name] = (*ends, 1.0, f"target {name}")
        return out

    def foothold(self, contact: int) -> list[tuple[float, float]]:
        """Bounds of x, y, z [m] and yaw [rad] of the middle of the toe edge in one contact; of one
        that the target places as for a target on the spot.
        """
        _, side = self.contacts.landings[contact]
        first = self.body.places[side]
        p = (*self.contacts.first, *self.contacts.places)[contact]
        middle = (*np.add(first, [p.ahead_m, p.left_m, p.up_m]), p.turn_rad)
        free = (*p.free_m, 0.0, p.free_rad)
        return [(x - y, x + y) for x, y in zip(middle, free, strict=True)]

    def _boxes(self, mode: Mode) -> tuple[Bound, ...]:
        """Ranges, speeds and torques of the joints; forces that only push; feet that tip only
        forward.
        """
        lim = self.limits
        motors = self.body.motors
        free = self.free
        none = np.zeros(len(mode.raised))
        wide = np.full(BASE, ANGLE_BOX_RAD)
        wide[CHART.index("roll")] = lim.roll_rad
        least = -np.inf if mode.flying else lim.straight_knee_rad
        most = np.inf if free.even else lim.knee_rad
        margin = lim.range_margin_rad
        if self._rebounds:
            stance = self.body.stance[BASE:]
            off = np.minimum(stance - motors.lower, motors.upper - stance)  # the nearer stop
            margin = np.maximum(margin, np.minimum(lim.rebound_range_rad, off / 2))
        low, high = self.body.ranges(margin, least, most)
        if not free.plane:  # in the plane no leg needs the way that it loses
            low = np.maximum(low, self.body.unlocked[0])
            high = np.minimum(high, self.body.unlocked[1])
        low, high = free.within(np.concatenate([-wide, low]), np.concatenate([wide, high]))
        low = np.concatenate([low, none])
        high = np.concatenate([high, none + lim.heel_up_rad])
        speed = np.concatenate([np.full(BASE, RATE_BOX), lim.speed_share * motors.speed])
        rates = np.concatenate([free.within(-speed, speed)[1], none + np.inf])
        torques = np.concatenate([wide, mode.usable_torques])
        torques = free.within(-torques, torques)[1][free.size - len(free.joints) :]
        pushes = np.zeros(mode.n_forces)
        least = np.concatenate([pushes, -torques])
        most = np.concatenate([pushes + np.inf, torques])
        return (
            Bound("joint range", "ours: stops; WL-K2", "rad", "q", low, high),
            Bound("joint speed", "ours: limit", "rad/s", "v", -rates, rates),
            Bound("forces and torques", "ours: limit", "N, N m", "z", least, most),
        )

    def _ends(self, k: int) -> list[Bound]:
        """The first node of the schedule and of heels that rise; forces that vanish; the last node,
        at rest.
        """
        mode = self.modes[k]
        phases = self.contacts.phases
        last = k == len(phases) - 1
        after = mode.modes if last else phases[k + 1].modes
        rises, falls = (
            [mode.nv + i for i, side in enumerate(mode.raised) if modes.get(side) == "flat"]
            for modes in (phases[k - 1].modes if k else {}, after)
        )
        still = [i for i, name in enumerate(mode.coordinates) if name in mode.integrated]
        rests = still if last and self.contacts.ends == "rest" else []
        angles = "rad, rad/s, rad/s^2"
        lift_off = "SL-E3, E4, E6 for the whole body"
        vanishing = [
            *(("start", on, rises, f"heels rise from rest ({on})", "ours", angles) for on in "qva"),
            ("end", "z", self._leaving(mode, after), "no force where contact ends", lift_off, "N"),
            *(("end", on, falls, f"heels come down ({on})", "ours", "rad, rad/s") for on in "qv"),
            ("end", "v", rests, "at rest in the end", "ours", "rad/s"),
            ("end", "a", rests, "at rest in the end (acceleration)", "ours", "rad/s^2"),
        ]
        out = []
        if k == 0:
            words = "stance", "ours: the paper prints no start", "rad", "q"
            stance = itemgetter("stance")  # of the parameters
            out = [
                Bound(*words, stance, stance, "start"),
                Bound("at rest", "ours", "rad/s", "v", 0.0, 0.0, "start"),
                Bound("at rest (acceleration)", "ours", "rad/s^2", "a", 0.0, 0.0, "start"),
            ]
        for where, on, columns, *words in vanishing:
            if columns:
                most = np.full(len(mode.states if on == "z" else mode.coordinates), np.inf)
                most[columns] = 0.0
                out.append(Bound(*words, on, -most, most, where))
        return out

    def _leaving(self, mode: Mode, after: Mapping[int, str]) -> list[int]:
        """Columns of the forces that the phase ``after`` no longer has: of feet that leave, of
        heels that rise.
        """
        gone = []
        first = 0
        for side, points in mode.points.items():
            count = len(mode.edges) * len(points)
            rises = mode.modes[side] == "flat" and after.get(side) == "toe"
            kept = 0 if side not in after else count // 2 if rises else count
            gone += range(first + kept, first + count)
            first += count
        return gone


def _landing_height(level: float, parameters: Mapping) -> float:
    """Height of a toe edge on the landing surface, which on the first one is at ``level`` [m]."""
    return level + parameters["platform"]


def _furthest(name: str, end: float, parameters: Mapping) -> float:
    """An ``end`` of the range of a target's number, as the parameter ``name``."""
    if name == "takeoff_speed":
        return float(np.sqrt(2 * parameters["gravity"] * end))
    return end
