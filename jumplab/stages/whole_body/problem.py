"""A contact schedule as a problem: one phase after the other, with shared nodes where nothing jumps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cached_property, partial

import casadi as ca
import numpy as np

from jumplab.models.spatial import CHART
from jumplab.ocp.problem import Bound, Phase, Problem, Term
from jumplab.ocp.solution import PhaseSolution
from jumplab.stages.whole_body.apart import Apart
from jumplab.stages.whole_body.contacts import SIDES, Contacts
from jumplab.stages.whole_body.coordinates import BASE, Coordinates, whole
from jumplab.stages.whole_body.settings import Limits, Weights
from jumplab.stages.whole_body.terms import Body, WholeBodyTerms
from jumplab.stages.whole_body.view import BodyView

SCALES = {"q": 1.0, "v": 10.0, "a": 100.0}  # peaks of solutions, for conditioning
ANGLE_BOX_RAD = 15.0  # beyond two full turns
RATE_BOX = 60.0  # [rad/s, m/s] of the base
PLACE_BOX = (-10.0, 10.0, 1.0)  # [m] the CoM at take-off; scale
SPEED_BOX = (-8.0, 8.0, 1.0)  # [m/s] its velocity there; scale
SPIN_BOX = (-200.0, 200.0, 10.0)  # [kg m^2/s] angular momentum in flight; scale
TRACKED_IN_FLIGHT = {"rho": 1, "rho_rate": 1}  # references and their sizes
TRACKED = {**TRACKED_IN_FLIGHT, "velocity": 2, "L": 1}


def mode_key(modes: dict[int, str]) -> tuple:
    """A mode of contact as a key."""
    return tuple(sorted(modes.items()))


class Schedule:
    """A schedule for one robot: the terms of each mode, and the problem that they make."""

    def __init__(
        self,
        body: Body,
        contacts: Contacts,
        limits: Limits,
        weights: Weights,
        apart: Iterable[Apart] = (),
        terms: dict[tuple, WholeBodyTerms] | None = None,
        name: str = "whole body",
        free: Coordinates | None = None,
        tracking: bool = False,
    ):
        """``terms`` are those of the modes that are known already; others are added. With ``tracking`` a jump follows
        stage 1's trajectories."""
        self.tracking = tracking
        self.free = free or whole(body)
        self.body, self.contacts, self.limits, self.weights, self.name = body, contacts, limits, weights, name
        self.apart = tuple(apart)
        self.terms = {} if terms is None else terms
        for phase in contacts.phases:
            key = mode_key(phase.modes)
            if key not in self.terms:
                self.terms[key] = WholeBodyTerms(body, limits, weights, phase.modes, self.free)

    def of(self, k: int) -> WholeBodyTerms:
        """Terms of a phase."""
        return self.terms[mode_key(self.contacts.phases[k].modes)]

    def landed(self, k: int) -> list[int]:
        """Sides of the feet that come down at the start of a phase; none at that of the first."""
        before = self.contacts.phases[k - 1].modes if k else self.contacts.phases[0].modes
        return [side for side in self.contacts.phases[k].modes if side not in before]

    @cached_property
    def whole(self) -> Schedule:
        """The same with every coordinate free."""
        if not self.free.even:
            return self
        return Schedule(self.body, self.contacts, self.limits, self.weights, self.apart, name=self.name)

    def spread(self, phases: Mapping[str, PhaseSolution]) -> dict[str, PhaseSolution]:
        """A solution as one of :attr:`whole`."""
        if not self.free.even:
            return dict(phases)
        return {name: self._spread(k, x) for k, (name, x) in enumerate(phases.items())}

    def _spread(self, k: int, phase: PhaseSolution) -> PhaseSolution:
        b, w = self.of(k), self.whole.of(k)
        motion = []
        for level, x in enumerate((phase.q, phase.v, phase.a, phase.j)):
            heels = [x[:, b.nv] for _ in w.raised]
            motion.append(np.column_stack([self.free.charts(x, level), *heels]))
        forces = [b.spread_forces(phase.z[:, : b.n_forces], side) for side in w.modes]
        torques = np.zeros((len(phase.z), b.nv))
        torques[:, b.nv - len(self.free.joints) :] = phase.z[:, b.n_forces :]
        z = np.column_stack([*forces, self.free.charts(torques, 1)[:, BASE:]])
        constants = dict(phase.constants)
        if b.flying:
            constants |= dict.fromkeys((n for n in w.constants if n not in constants), 0.0)
        for side in w.modes:
            for x, sign in (("x", 1.0), ("y", -1.0), ("z", 1.0), ("yaw", -1.0)):
                value = phase.constants[f"{SIDES[0]}_{x}"]
                constants[f"{SIDES[side]}_{x}"] = sign * value if side else value
        q, v, a, j = motion
        return replace(phase, q=q, v=v, a=a, j=j, z=z, constants=constants)

    def problem(self) -> Problem:
        """All phases in one problem."""
        phases = tuple(self._phase(k) for k in range(len(self.contacts.phases)))
        parameters = dict(stance=self.of(0).nv, distance=1, side=1, yaw=1, platform=1, edge=1, along=2)
        parameters |= dict(takeoff_speed=1, rotation=1, gravity=1, straight=1)
        if not self.tracking:
            return Problem(self.name, phases, (), parameters)
        return Problem(self.name, phases, (self._durations(),), parameters | dict(momentum=1, launch_s=2))

    def _durations(self) -> Term:
        def off(ends):
            return ca.vertcat(ends["flat"].end.duration, ends["toe"].end.duration) - ends["flat"].end.p.launch_s

        return Term(
            "track durations", "ours: fixed in the paper", "s", "problem", off, weight=self.weights.track_duration
        )

    def _phase(self, k: int) -> Phase:
        b, given, last = self.of(k), self.contacts.phases[k], k == len(self.contacts.phases) - 1
        landed = self.landed(k)
        joined = bool(k) and not landed
        terms = [
            *b.smoothness(),
            *b.dynamics(joined),
            *b.held_torques(joined),
            b.motor_lines(joined),
            b.body_clearance(),
            *b.sides_apart(),
        ]
        terms += [b.link_distance(x, given.intervals) for x in self.apart if x.phase == k]
        for side in b.sides:
            # the first node is given, so it needs no rows
            terms += b.foot_rows(side, joined or k == 0, side in landed)
        terms += [b.swing_rows(side) for side in self.free.sides if side not in b.modes]
        around = self.contacts.phases[max(k - 1, 0) : k + 2]
        if b.flying:
            terms += b.opening_rows()
        if self.tracking:
            terms += b.tracking()
        if given.feet == "LR":
            terms += b.reserve()
        if (
            (b.limits.least_push or not self.free.even)
            and given.feet == "LR"
            and all(p.flying or len(p.modes) == 2 for p in around)
        ):
            terms.append(b.loads())  # where one foot steps the load goes from foot to foot
        if len(b.modes) == 1:
            terms += [b.torsion(side) for side in b.modes]
        if b.flying:
            terms += b.flight_rows()
        if last and self.contacts.ends == "touchdown":
            terms += b.touchdown_rows()
        references = {f"{SIDES[side]}_clearance": 1 for side in self.free.sides if side not in b.modes}
        if self.tracking:
            references |= TRACKED_IN_FLIGHT if b.flying else TRACKED
        return Phase(
            given.name,
            b.coordinates,
            given.intervals,
            given.time_s,
            tuple(terms),
            (*self._boxes(b), *self._ends(k)),
            b.states,
            self._constants(k),
            references,
            SCALES | {"z": self._sizes(b)},
            partial(BodyView, b),
            b.integrated,
            "" if not k else "qv" if landed else "qvaz",
            b.kind,
        )

    def _sizes(self, b: WholeBodyTerms) -> np.ndarray:
        effort = np.maximum(b.motors["effort"], 1.0)
        return np.concatenate([np.full(b.n_forces, self.body.mg), effort])

    def _constants(self, k: int) -> dict:
        """Footholds of the feet that carry, by contact; in flight the CoM's parabola and L."""
        b, out = self.of(k), {}
        if b.flying:
            boxes = {"com": PLACE_BOX, "vel": SPEED_BOX, "L": SPIN_BOX}
            out |= {name: boxes[name.partition("_")[0]] for name in b.constants}
        for side in b.sides:
            contact = self.contacts.contact_of(k, side)
            for x, (low, high) in zip(("x", "y", "z", "yaw"), self.foothold(contact), strict=True):
                out[f"{SIDES[side]}_{x}"] = (low, high, 1.0, f"contact {contact} {x}")
        return out

    def foothold(self, contact: int) -> list[tuple[float, float]]:
        """Bounds of x, y, z [m] and yaw [rad] of the middle of the toe edge in one contact."""
        _, side = self.contacts.landings[contact]
        first = self.body.places[side]
        number = contact - len(self.contacts.phases[0].modes)
        if number < 0:
            return [(x, x) for x in (*first, 0.0)]
        p = self.contacts.places[number]
        middle = (first[0] + p.ahead_m, first[1] + p.left_m, first[2] + p.up_m, p.turn_rad)
        free = (*p.free_m, 0.0, p.free_rad)
        return [(x - y, x + y) for x, y in zip(middle, free, strict=True)]

    def _boxes(self, b: WholeBodyTerms) -> tuple[Bound, ...]:
        """Ranges, speeds and torques of the joints; forces that only push; feet that tip only forward."""
        lim, m, raised, free = b.limits, b.body.motors, len(b.raised), self.free
        wide = np.full(BASE, ANGLE_BOX_RAD)
        wide[CHART.index("roll")] = lim.roll_rad
        low, high = m["lower"] + lim.range_margin_rad, m["upper"] - lim.range_margin_rad
        least = -np.inf if b.flying else lim.straight_knee_rad
        most = np.inf if free.even else lim.knee_rad
        for k, sign, angle in b.body.knees:
            bent = sorted((sign * (least - angle), sign * (most - angle)))
            low[k], high[k] = max(low[k], bent[0]), min(high[k], bent[1])
        rates = np.concatenate([np.full(BASE, RATE_BOX), lim.speed_share * m["speed"]])
        rates = np.concatenate([free.within(-rates, rates)[1], np.full(raised, np.inf)])
        torques = free.within(*(s * np.concatenate([wide, b.usable_torques]) for s in (-1, 1)))[1]
        torques = torques[free.size - len(free.joints) :]
        q_low, q_high = free.within(np.concatenate([-wide, low]), np.concatenate([wide, high]))
        q_low = np.concatenate([q_low, np.zeros(raised)])
        q_high = np.concatenate([q_high, np.full(raised, lim.heel_up_rad)])
        none, push = np.zeros(b.n_forces), np.full(b.n_forces, np.inf)
        return (
            Bound("joint range", "ours: stops; WL-K2", "rad", "q", q_low, q_high),
            Bound("joint speed", "ours: limit", "rad/s", "v", -rates, rates),
            Bound(
                "forces and torques",
                "ours: limit",
                "N, N m",
                "z",
                np.concatenate([none, -torques]),
                np.concatenate([push, torques]),
            ),
        )

    def _ends(self, k: int) -> list[Bound]:
        """The first node of the schedule and of heels that rise; forces that vanish; the last node, at rest."""
        b, phases = self.of(k), self.contacts.phases
        out, free = [], np.full(len(b.coordinates), np.inf)
        if k == 0:
            out += [
                Bound("stance", "ours: the paper prints no start", "rad", "q", _stance, _stance, "start"),
                Bound("at rest", "ours", "rad/s", "v", 0.0, 0.0, "start"),
                Bound("at rest (acceleration)", "ours", "rad/s^2", "a", 0.0, 0.0, "start"),
            ]
        before = phases[k - 1].modes if k else {}
        rising = [side for side in b.raised if before.get(side) == "flat"]
        if rising:
            for on in "qva":
                most = free.copy()
                most[[b.nv + b.raised.index(side) for side in rising]] = 0.0
                out.append(
                    Bound(f"heels rise from rest ({on})", "ours", "rad, rad/s, rad/s^2", on, -most, most, "start")
                )
        after = phases[k + 1].modes if k + 1 < len(phases) else b.modes
        if gone := self._leaving(b, after):
            most = np.full(len(b.states), np.inf)
            most[gone] = 0.0
            words = "SL-E3, E4, E6 for the whole body", "N"
            out.append(Bound("no force where contact ends", *words, "z", -most, most, "end"))
        lowered = [side for side in b.raised if after.get(side) == "flat"]
        if lowered:
            for on in "qv":
                most = free.copy()
                most[[b.nv + b.raised.index(side) for side in lowered]] = 0.0
                out.append(Bound(f"heels come down ({on})", "ours", "rad, rad/s", on, -most, most, "end"))
        if k == len(phases) - 1 and self.contacts.ends == "rest":
            still = np.array([0.0 if name in b.integrated else np.inf for name in b.coordinates])
            out += [
                Bound("at rest in the end", "ours", "rad/s", "v", -still, still, "end"),
                Bound("at rest in the end (acceleration)", "ours", "rad/s^2", "a", -still, still, "end"),
            ]
        return out

    def _leaving(self, b: WholeBodyTerms, after: dict[int, str]) -> list[int]:
        """Columns of the forces that the phase ``after`` no longer has: of feet that leave, of heels that rise."""
        gone, first = [], 0
        for side, points in b.points.items():
            count = len(b.edges) * len(points)
            toes = count // 2
            if side not in after:
                gone += range(first, first + count)
            elif b.modes[side] == "flat" and after[side] == "toe":
                gone += range(first + toes, first + count)
            first += count
        return gone


def _stance(parameters):
    return parameters["stance"]
