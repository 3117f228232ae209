"""The named costs and constraints of the whole-body program, as functions of one :class:`Instant`;
nothing here solves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from jumplab.models.spatial import SpatialState, cross
from jumplab.ocp.problem import Term, limit
from jumplab.robot.motors import SLIDING_RATE
from jumplab.robot.reduction import mirror
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import SIDES
from jumplab.stages.whole_body.coordinates import BASE
from jumplab.stages.whole_body.instant import Instant
from jumplab.stages.whole_body.legs import independent, off_foothold
from jumplab.stages.whole_body.mode import Mode
from jumplab.stages.whole_body.settings import LATE_SHARE, RESERVE_SHARE
from jumplab.stages.whole_body.shapes import Apart

MOMENT_ARM_M = 0.2  # nominal size of moments over that of forces
# [kg m^2/s], [m/s^2, rad/s^2] for conditioning
SPIN_SCALE = 10.0
ACCELERATION_SCALE = 10.0
PLACE_SCALE = 0.1  # [m]
SOLE_SHARES = 0.0, 0.25, 0.5, 0.75, 1.0  # of the way from toes to heel
# where a foot hardly carries both sides of the row vanish; at the least load at which the audit
# looks, 0.12 of the weight, this is 7 % of what it allows
TORSION_SLACK_M = 2e-5
CAPTURE = "replaces WF-E2"
TORQUE_SPEED = "torque-speed"  # the term of the motors' lines
# of the knees at touchdown, kept from where the hips stop them: a landing sinks
SQUAT_ROOM_RAD = 0.15
SMOOTH_W = 1e-3  # of the power that all motors may draw, about where a joint begins to brake
HOLDING = "torques of held joints"  # the term of :func:`.held_joints`
RECORD = "record"  # the term of what is largest
FAR = 100.0  # [m, m/s, rad] beyond any of it, so that its cost is nearly a straight line
# of one of these units of it, in units of the effort: with more of it, motions leave the physics
# between the nodes
WORTH = 1000.0

Contact = tuple[int, int]  # number of its phase, side

ROOF_ENDS = 0.95  # of the way from a block to the nearest foothold, where the roof over it ends
ROOF_HIGH = 0.2  # of that way, up to where the roof is at least as high as the block
ROOF_ROUND = 0.02  # of the block's height, by which the roof's end is rounded
CLEAR = {"scale": PLACE_SCALE, "group": "clearance"}


def smoothness(m: Mode, follows: bool = False) -> list[Term]:
    """Costs [1] on accelerations, jerk, torques and forces, and on the waist's and the arms' way
    from the stance, or from the motion that it ``follows``.
    """
    w = m.weights

    def bent(p):
        near = p.ref.chart if follows else ca.DM(m.body.stance)
        return (p.tree.q - near)[m.body.upper]

    def uneven(p):
        rows = [p.q[BASE + k] - sign * p.q[BASE + i] for i, k, sign in mirror(m.robot.model)]
        return p.p.straight * ca.vertcat(p.q[3:5], *rows)

    terms = [
        Term(
            "acceleration",
            "WL-J2, WF-J2",
            "rad/s^2",
            "node",
            lambda p: m.moving(p.a),
            w.acceleration,
        ),
        Term("jerk", "WL-J2, WF-J2", "rad/s^3", "mid", lambda p: m.moving(p.j), w.jerk),
        Term("torque", "ours: effort", "N m", "node", "joint_torques", w.torque),
    ]
    if not m.flying:
        terms.append(
            Term("force", "ours: spread", "N", "node", lambda p: p.z[: m.n_forces], w.force)
        )
    if m.body.upper:
        straight = "ours: joints without a role stay near the stance, or what is followed"
        terms.append(Term("waist and arms", straight, "rad", "node", bent, w.posture))
    if not (m.robot.planar or m.free.even):
        even = "ours: a jump straight ahead is even"
        terms.append(Term("mirror", even, "rad", "node", uneven, w.mirror))
    return terms


def dynamics(m: Mode, skip: tuple[int, int]) -> list[Term]:
    """Newton and Euler, M q'' + h = S tau + J^T f: nothing but the ground moves the base [N, N m],
    joint torques go with the motion [of the effort], and motors of joints that are held, in this
    jump or in every one, can hold them. ``skip`` is (first, last) nodes without rows.
    """
    free = m.free
    mg = m.body.mg
    shared = {"skip": skip, "group": "dynamics"}
    options = shared | {"identity": True}
    effort = np.array([*m.body.motors.effort[m.held], *(x.effort for x in m.locked)])

    def torques(p):
        return (p.needed[2][free.joints] - p.motor_torques) / ca.DM(m.motors.effort)

    def forces(p):
        return p.needed[0][free.places]

    def moments(p):
        return p.needed[1][free.spins]

    def holding(p):
        locked = [p.tree.locked_torque(x) for x in m.locked]
        return ca.vertcat(p.needed[2][m.held], *locked) / ca.DM(effort)

    rows = [
        Term("joint dynamics", "ours", "of the effort", "node", torques, **options),
        Term("base forces", "ours", "N", "node", forces, **options, scale=mg),
        Term("base moments", "ours", "N m", "node", moments, **options, scale=MOMENT_ARM_M * mg),
    ]
    if len(effort):
        locked = [m.limits.torque_share * x.effort for x in m.locked]
        most = np.array([*m.usable_torques[m.held], *locked]) / effort
        rows.append(
            limit(HOLDING, "ours: limit", "of the effort", "node", holding, -most, most, **shared)
        )
    return rows


def motor_lines(m: Mode, skip: tuple[int, int]) -> Term:
    """Torque against speed of every joint: |tau + slope rate| <= slope no_load_speed [N m]."""
    motors = m.motors
    slope = m.limits.torque_share * motors.slope
    most = (slope * motors.no_load_speed - motors.friction) / motors.effort

    def line(p):
        return (p.motor_torques + ca.DM(slope) * p.rates) / ca.DM(motors.effort)

    return limit(
        TORQUE_SPEED, "ours: motor line", "of the effort", "node", line, -most, most, skip=skip
    )


def bus_power(m: Mode, skip: tuple[int, int]) -> list[Term]:
    """Power that all motors draw, sum of tau q' + losses tau^2, braking less what is not used
    [W]; of a robot that limits it.
    """
    bus = m.robot.bus
    if not np.isfinite(bus.power_w):
        return []
    most = m.limits.power_share * bus.power_w

    def drawn(p):
        rates = p.tree.v[BASE:]
        rubbed = ca.DM(m.body.motors.friction) * ca.tanh(rates / SLIDING_RATE)
        return ca.sum1(bus.drawn(p.joint_torques + rubbed, rates, ca, SMOOTH_W * most))

    return [
        limit("bus power", "ours: limit", "W", "node", drawn, -np.inf, most, scale=most, skip=skip)
    ]


def body_clearance(m: Mode) -> Term:
    """Knees and hands stay away from the ground, and shanks from an edge that they go onto, or
    over.
    """
    body = m.body
    lim = m.limits
    counted = set(m.model.left_half if m.free.even else range(len(m.model.bodies)))
    room = [lim.body_clearance_m + body.shank_m] * 2  # of the knees; of the hands less
    room += [lim.body_clearance_m] * (len(body.limb_points) - 2)
    limbs = [x for x in zip(body.limb_points, room, strict=True) if x[0][0] in counted]
    shanks = [spot for spot in body.shank_points if spot[0] in counted]
    face = body.shank_m + lim.shank_clearance_m

    def heights(p):
        top = p.p.platform
        step = (top > 0) * (top + face)
        drop = (top < 0) * (face - top)
        points = [p.tree.point(*spot) for spot, _ in limbs]
        rows = [x[2] - p.ground(x, lim.edge_clearance_m) for x in points]
        for spot in shanks:
            x = p.tree.point(*spot)
            near = p.over_edge(x, face)
            # beyond an edge up, and about an edge down: behind that, the feet keep it up
            beside = step * near + drop * (near - p.over_edge(x, -face))
            rows.append(x[2] - ca.fmin(top, 0) - beside)
        return ca.vertcat(*rows)

    least = np.array([least for _, least in limbs] + [0.0] * len(shanks))
    return limit("body clearance", "ours", "m", "node", heights, least, skip=(1, 0), **CLEAR)


def over_block(m: Mode, over: tuple[float, float, float], beside_m: float) -> Term:
    """Hands, knees, shanks, and soles in the air stay above a roof over a block (from, to, top),
    ahead of the toes' first place [m], that ends short of footholds ``beside_m`` [m] away. Over a
    flat top, links pass through the block between two nodes.
    """
    body = m.body
    lim = m.limits
    first, last, top = over
    middle = float(body.places[:, 0].mean()) + (first + last) / 2
    beyond = max(min(lim.edge_step_m / 2, ROOF_HIGH * beside_m), lim.edge_smoothing_m)
    half = (last - first) / 2 + beyond  # of the part that is at least as high as the block
    slope = max(ROOF_ENDS * beside_m - beyond, 2 * half)  # steeper, its ridge is out of reach
    face = body.shank_m + lim.clearance_m
    spots = [(spot, face) for spot in (*body.limb_points[:2], *body.shank_points)]
    spots += [(spot, lim.body_clearance_m) for spot in body.limb_points[2:]]
    for side in {0, 1} - set(m.modes):
        toes, heels = np.split(body.corners[side], 2)
        sole = [toes + share * (heels - toes) for share in SOLE_SHARES[::2]]
        spots += [((body.feet[side], x), lim.clearance_m) for x in np.concatenate(sole)]

    def roof(x):
        share = 1 - (ca.sqrt((x - middle) ** 2 + lim.edge_smoothing_m**2) - half) / slope
        return (share + ca.sqrt(share**2 + ROOF_ROUND**2)) / 2

    def heights(p):
        points = [(p.tree.point(*spot), room) for spot, room in spots]
        return ca.vertcat(*(x[2] - (top + room) * roof(x[0]) for x, room in points))

    return limit("over the block", "ours", "m", "node", heights, -lim.link_distance_m, **CLEAR)


def sides_apart(m: Mode) -> list[Term]:
    """Left and right knees, ankles, toes and heels keep a share of their distance in the stance,
    seen from the trunk; hands stay outside. Cheap rows, which hold for most motions what distances
    of links would. In the plane legs do not move across it.
    """
    if m.robot.planar and m.free.plane:
        return []
    body = m.body
    even = m.free.even
    hands = [x for x in body.limb_points[2:] if not even or x[0] in m.model.left_half]
    pairs = []
    if not m.free.plane:
        origins = [(k, np.zeros(3)) for k in body.feet]
        heels = body.corners[:, 2:].mean(axis=1)
        soles = [list(zip(body.feet, places, strict=True)) for places in (body.tips, heels)]
        pairs = [body.limb_points[:2], origins, *soles]

    def across(tree):
        def left(spot):
            return tree.from_base(*spot)[1]

        legs = (2 * left(one) if even else left(one) - left(other) for one, other in pairs)
        return ca.vertcat(*legs, *(left(hand) for hand in hands))

    chart = ca.SX(body.stance)
    stance = across(SpatialState(m.model, chart, 0 * chart, 0 * chart))
    stance = ca.evalf(stance).full().ravel()
    way = np.sign(stance)
    least = np.abs(stance)
    least[: len(pairs)] *= m.limits.sides_share
    least[len(pairs) :] -= m.limits.hands_inward_m

    def rows(p):
        return ca.DM(way) * across(p.tree)

    return [limit("sides apart", "ours", "m", "node", rows, least, skip=(1, 0), **CLEAR)]


def link_distance(m: Mode, kept: Apart, intervals: int) -> Term:
    """Two links stay apart [m] at the nodes for which it is asked, of a phase of ``intervals``."""
    return limit(
        kept.pair.key,
        "ours",
        "m",
        "node",
        lambda p: kept.pair.gap(p.tree),
        m.limits.link_distance_m + kept.more_m,
        scale=PLACE_SCALE,
        skip=(kept.first, intervals - kept.last),
        group=kept.pair.key,
    )


def largest(name: str) -> Term:
    """A parameter of the target that is an unknown is as large as can be: as close as can be to
    :data:`FAR`, which no target reaches. Effort counts little beside it.
    """

    def missing(p):
        return FAR - getattr(p.p, name)

    return Term(RECORD, "ours: what is largest", "m, m/s, rad", "end", missing, WORTH / (2 * FAR))


def gentle_heels(m: Mode) -> Term:
    """Heels begin to rise so gently that angles, rates and accelerations of a 1 kHz tape agree:
    effort, which else sees to that, counts little beside a record.
    """
    most = m.limits.heel_jerk
    words = "heels rise gently", "ours: the tape's steps", "rad/s^3", "mid"
    return limit(*words, lambda p: p.j[m.nv :], -most, most, scale=most)


def trunk_clearance(m: Mode) -> Term:
    """The trunk stays off the ground: effort, which else keeps it up, counts little beside a
    record.
    """
    least = m.limits.body_clearance_m

    def heights(p):
        middles = [p.tree.point(x.body, x.centre) for x in m.body.trunk_boxes]
        up = ca.DM([0, 0, 1])
        boxes = zip(middles, m.body.trunk_boxes, strict=True)
        return ca.vertcat(*(at[2] - p.ground(at, least) - x.reach(p.tree, up) for at, x in boxes))

    words = "trunk clearance", "ours", "m", "node"
    return limit(*words, heights, np.full(len(m.body.trunk_boxes), least), skip=(1, 0), **CLEAR)


# feet on the ground
# ---------------------------------------------------------------------------------------------
def kept_rows(m: Mode, side: int, rows: ca.SX, yaw_and_roll: ca.SX) -> ca.SX:
    """Of the six rows of a foot (x, y, z, heading, roll, pitch) those that can change."""
    return independent(rows[m.free.foot], m.short, side, yaw_and_roll)


def foot_rows(m: Mode, side: int, joined: bool, landed: bool) -> list[Term]:
    """A foot that carries is in its place, still, and stays so, on its toes about their edge: six
    rows on all three levels [m, rad].

    At a node that is ``joined`` to the phase before these rows stand there; where another foot
    lands, place and velocity are shared, so one that stood before has only the last level; one that
    has ``landed`` has all.
    """
    name = SIDES[side]
    tip = m.body.feet[side], m.body.tips[side]
    axes = ca.DM(m.body.axes[side])

    def place(p):
        rows = off_foothold(p.tree, m.body, side, *p.foothold(side))
        rows[5] += ca.sin(p.pitch(side, p.q))
        return kept_rows(m, side, rows, p.q[3:5])

    def moving(p, level, x):
        linear, spin = (axes.T @ y for y in level(*tip))
        rows = ca.vertcat(linear, spin[2], spin[0], spin[1] - p.pitch(side, x))
        return kept_rows(m, side, rows, x[3:5])

    def rates(p):
        return moving(p, p.tree.own_rates, p.v)

    def accelerations(p):
        return moving(p, p.tree.own_accelerations, p.a)

    def row(word, unit, of, scale, skip):
        options = {"identity": True, "scale": scale, "skip": (skip, 0), "group": name}
        return Term(f"{name} foot {word}", "ours: contact", unit, "node", of, **options)

    first = int(joined or not landed)
    return [
        row("in place", "m, 1", place, 1.0, first),
        row("still", "m/s, rad/s", rates, 1.0, first),
        row("held", "m/s^2, rad/s^2", accelerations, ACCELERATION_SCALE, int(joined)),
    ]


def loads(m: Mode) -> Term:
    """Both flat feet carry."""
    mg = m.body.mg
    least = (m.limits.least_push / 2 if m.free.even else m.limits.foot_share) * mg

    def forces(p):
        return ca.vertcat(*(p.feet_forces[side][2] for side in m.sides))

    return limit("load of each foot", "ours", "N", "node", forces, least, scale=mg)


def torsion(m: Mode, side: int) -> Term:
    """Friction holds a foot against the moment about the vertical through its CoP:
    |f . m| <= mu arm f_z^2, with force f and moment m (3,).
    """
    arm = m.limits.friction * m.limits.torsion_arm_m

    def left(p):
        force, moment = (x / m.body.mg for x in p.pressed(side))
        twist = ca.dot(force, moment)  # that moment times the load
        most = arm * force[2] ** 2
        return ca.vertcat(most - twist, most + twist)

    words = f"spin of {SIDES[side]} foot", "ours: friction", "m, of the squared weight", "node"
    return limit(*words, left, -TORSION_SLACK_M, scale=MOMENT_ARM_M / 10, group="torsion")


def reserve(m: Mode) -> list[Term]:
    """The CoP of flat feet keeps off both ends of the sole, but for the ends of the phase."""
    room = 2 * m.body.half_m * m.limits.cop_reserve_share
    begins, ends = RESERVE_SHARE
    if not room:
        return []

    def left(p):
        kept = room * ca.fmax(0, ca.fmin(1, ca.fmin(p.s / begins, (1 - p.s) / ends)))
        rows = []
        for side in m.sides:
            force, moment = (x / m.body.mg for x in p.pressed(side))
            behind = moment[1]  # of the toe
            length = -m.points[side][-1, 0]
            rows += [behind - kept * force[2], (length - kept) * force[2] - behind]
        return ca.vertcat(*rows)

    return [limit("CoP reserve", "ours", "m, of the weight", "node", left, scale=PLACE_SCALE)]


# feet in the air
# ---------------------------------------------------------------------------------------------
def swing_rows(m: Mode, side: int, follows: bool) -> Term:
    """A foot in the air keeps its sole's corners off the ground [m], in the plane points along its
    middle line, by as much as the references ask for.

    Its ankle stays as high as it stands, or the shank would graze, and a margin, which in a motion
    that ``follows`` another comes and goes with the clearance.
    """
    body = m.body
    foot = body.feet[side]
    margin = m.limits.ankle_margin_m
    places = body.corners[side]
    if m.free.plane:
        toe, heel = places.reshape(2, 2, 3).mean(axis=1)
        places = [toe + share * (heel - toe) for share in SOLE_SHARES]

    def heights(p):
        asked = getattr(p.ref, f"{SIDES[side]}_clearance")
        more = margin * asked / m.limits.clearance_m if follows else margin
        lows = [asked] * len(places) + [body.ankle_m + more]
        points = [p.tree.point(foot, place) for place in (*places, np.zeros(3))]
        return ca.vertcat(*(x[2] - p.ground(x) - low for x, low in zip(points, lows, strict=True)))

    return limit(
        f"clearance of {SIDES[side]} sole", "ours", "m", "node", heights, skip=(1, 1), **CLEAR
    )


def flight_rows(m: Mode) -> list[Term]:
    """Flight: the CoM's parabola and all components of L that can change, at every node, the one of
    take-off included.
    """
    free = m.free
    at = free.turns

    def com(p):
        fall = ca.vertcat(0, 0, p.p.gravity * p.time**2 / 2)
        return (p.com - (p.flight("com") + p.flight("vel") * p.time - fall))[free.places]

    def velocity(p):
        fall = ca.vertcat(0, 0, p.p.gravity * p.time)
        return (p.com_velocity - (p.flight("vel") - fall))[free.places]

    def momentum(p):
        return (p.L - p.flight("L"))[free.spins]

    def angles(left, right, step):
        """Of the base [rad]: rates come from L, and accelerations from the moments."""
        turned = right.q[at] - left.q[at] - step * (left.v[at] + right.v[at]) / 2
        return turned - step**2 * (left.a[at] - right.a[at]) / 12

    link = {"identity": True, "group": "flight"}
    spin = {"scale": SPIN_SCALE, "group": "flight"}
    return [
        Term("ballistic CoM", "WF-D1", "m", "node", com, **link),
        Term("ballistic CoM velocity", "WF-D1", "m/s", "node", velocity, **link),
        Term("angular momentum", "WF-D1, three components", "kg m^2/s", "node", momentum, **spin),
        Term("base turns", "state equation", "rad", "interval", angles, identity=True),
    ]


def opening_rows(m: Mode) -> list[Term]:
    """If asked, joints open a tuck so slowly, and with so little torque, that they could do so
    later and faster; it sets in gradually.
    """
    lim = m.limits

    def late(p):
        return ca.fmax(0, ca.fmin(1, 20 * (p.s - 1 + LATE_SHARE)))

    def rates(p):
        return late(p) * p.rates

    def torques(p):
        return late(p) * p.motor_torques / ca.DM(m.motors.effort)

    rows = []
    if lim.opening_speed_share < lim.speed_share:
        most = lim.opening_speed_share * m.motors.speed
        words = "opening speed", "ours, for flips", "rad/s", "node"
        rows.append(limit(*words, rates, -most, most, scale=10.0, skip=(1, 0)))
    if (most := lim.opening_torque_share) < lim.torque_share:
        words = "opening torque", "ours, for flips", "of the effort", "node"
        rows.append(limit(*words, torques, -most, most, skip=(1, 0)))
    return rows


# a target
# ---------------------------------------------------------------------------------------------
def rise() -> Term:
    """The flight has the take-off speed of the target."""

    def takeoff(p):
        return p.c.vel_z - p.p.takeoff_speed

    return Term("vertical take-off speed", "SL-E2, WL-E1", "m/s", "start", takeoff)


def distance_flown(
    body: Body, names: Sequence[str], left: Sequence[Contact], landed: Sequence[Contact]
) -> Term:
    """Each foot that has ``landed`` is as far ahead of where it stood first [m] as those that
    ``left``, and the distance of the target; contacts by number of the phase, of which ``names``
    are given, and side.
    """

    def ahead(ends, contact):
        k, side = contact
        return ends[names[k]].start.foothold(side)[0][0] - body.places[side][0]

    def missed(ends):
        from_here = sum(ahead(ends, contact) for contact in left) / len(left)
        asked = from_here + ends[names[0]].start.p.distance
        return ca.vertcat(*(ahead(ends, contact) - asked for contact in landed))

    return Term("distance of the flight", "WL-E1", "m", "problem", missed)


# touchdown at the end of the schedule
# ---------------------------------------------------------------------------------------------
def touchdown_rows(m: Mode) -> list[Term]:
    """Touchdown: :func:`touchdown_feet`, posture, rates, and the soles against the CoM."""
    lim = m.limits
    free = m.free
    angles = [free.free[k] - 3 for k in free.turns]
    # hips that hardly bend let a robot squat less than a landing should have
    bent = min(lim.touchdown_knee[0], m.body.squat_rad - SQUAT_ROOM_RAD), lim.touchdown_knee[1]
    rates = lim.touchdown_side_rate, lim.touchdown_side_rate, lim.touchdown_trunk_rate
    trunk = rates_within(m, np.array(rates)[angles], np.eye(3)[0][angles])
    rate = lim.touchdown_joint_rate
    return [
        rise(),
        *touchdown_feet(m),
        *landing_posture(m, bent),
        limit("joint rates at touchdown", "WF-E1, relaxed", "rad/s", "end", "rates", -rate, rate),
        limit(
            "trunk rates at touchdown", "ours", "rad/s", "end", lambda p: p.v[free.turns], *trunk
        ),
        *upright_waist(m),
        *ankle_stroke(m, lim.touchdown_ankle_stroke if free.plane else None),
        *capture_rows(m),
    ]


def rebound_rows(m: Mode) -> list[Term]:
    """End of a flight after which the robot is caught on both feet, and goes on: posture, stroke of
    the ankles, and the soles against the CoM. Feet come down as the ground asks, without speed.
    """
    lim = m.limits
    bent = lim.straight_knee_rad, lim.touchdown_knee[1]
    return [*landing_posture(m, bent), *ankle_stroke(m, lim.rebound_ankle_rad), *capture_rows(m)]


def landing_posture(m: Mode, bent: tuple[float, float]) -> list[Term]:
    """Attitude of the base, and flexion of the knees between ``bent`` [rad], at touchdown."""
    lim = m.limits
    free = m.free
    angles = [free.free[k] - 3 for k in free.turns]
    yaw, roll = lim.touchdown_yaw, lim.touchdown_roll
    low, high = np.array([(-yaw, yaw), (-roll, roll), lim.touchdown_pitch])[angles].T

    def attitude(p):
        return (p.attitude - ca.vertcat(p.p.yaw, 0, p.p.rotation))[angles]

    def knees(p):
        legs = m.body.knees[: len(free.sides)]
        return ca.vertcat(*(sign * p.tree.q[BASE + k] + angle for k, sign, angle in legs))

    return [
        limit("attitude at touchdown", "ours", "rad", "end", attitude, low, high),
        limit("knees at touchdown", "ours: stroke", "rad", "end", knees, *bent),
    ]


def upright_waist(m: Mode) -> list[Term]:
    """A waist is as in the stance, more or less: at its stop its motors cannot catch the trunk."""
    columns = [k for k in m.body.waist if k in m.free.free]
    if not columns:
        return []
    most = m.limits.touchdown_waist_rad
    stance = ca.DM(m.body.stance[columns])

    def bent(p):
        return p.tree.q[columns] - stance

    return [limit("waist at touchdown", "ours: stroke", "rad", "end", bent, -most, most)]


def rates_within(
    m: Mode, rates: float | np.ndarray, vertical: Sequence[float]
) -> tuple[Callable, Callable]:
    """Bounds on ``rates`` (n,) [rad/s] at touchdown; those about the ``vertical`` (n,) wider where
    more than half a turn has to be stopped.
    """

    def most(parameters):
        more = max(0.0, abs(float(parameters["yaw"])) / np.pi - 1)
        return rates + m.limits.touchdown_turning * more * np.array(vertical, float)

    return (lambda parameters: -most(parameters)), most


def touchdown_feet(m: Mode) -> list[Term]:
    """Both feet in their new places, flat, without spin or slip."""
    free = m.free
    body = m.body
    turning = [1] if free.plane else [0, 1, 2]

    def goal(p):
        ahead = p.turned([1.0, 0.0, 0.0])
        rows = []
        for side, sole in zip(free.sides, p.soles, strict=True):
            way = sole - ca.vertcat(p.p.distance, p.p.side, p.p.platform)
            first = body.places[side] - [body.half_m, 0.0, 0.0]
            axes = p.sole_axes(side)
            missed = p.turned(way, -1) - first
            six = ca.vertcat(missed, ca.dot(ahead, axes[:, 1]), axes[2, 1], axes[2, 0])
            rows.append(kept_rows(m, side, six, ca.vertcat(p.q[3] - p.p.yaw, p.q[4])))
        return ca.vertcat(*rows)

    def spins(p):
        return ca.vertcat(*(p.tree.spin(body.feet[side])[turning] for side in free.sides))

    def sliding(p):
        """By how much soles come down steeply enough to stick, each way along x and y."""
        rows = []
        for side in free.sides:
            speed = p.tree.point_velocity(body.feet[side], body.middles[side])
            rows.append(np.sign(m.edges[:, :2]) @ speed[:2] - m.limits.touchdown_slope * speed[2])
        return ca.vertcat(*rows)

    vertical = np.eye(3)[2][turning].tolist() * len(free.sides)
    spin = rates_within(m, m.limits.touchdown_foot_rate, vertical)
    sticks = "soles that stick at touchdown", "ours: friction", "m/s", "end"
    return [
        Term("touchdown of the feet", "WL-E1, SL-E1: place and heading", "m, 1", "end", goal),
        limit("foot rates at touchdown", "ours", "rad/s", "end", spins, *spin),
        *([] if free.plane else [limit(*sticks, sliding)]),
    ]


def ankle_stroke(m: Mode, stroke: float | None) -> list[Term]:
    """Ankles keep a ``stroke`` [rad], if it is given, to the stop that the shanks lean into."""
    if stroke is None:
        return []
    least = float(m.robot.sagittal.lower[2]) + stroke
    sides = slice(len(m.free.sides))
    words = "ankles at touchdown", "ours: stroke", "rad", "end"
    return [limit(*words, lambda p: p.joints.ankle[sides], least)]


def capture_rows(m: Mode) -> list[Term]:
    """Constraint on where soles meet the ground, so that the robot can be caught; of a flip, on its
    momentum.
    """
    lim = m.limits
    if lim.capture_moment is not None:
        return [flip_capture(m)]

    def capture(p):
        ahead = p.turned([lim.capture_offset_m - m.body.ahead_m, 0.0, 0.0])
        caught = p.sole_middle - p.com - ahead - lim.capture_slope_s * p.flight("vel")
        return caught[[k for k in m.free.places if k < 2]]

    words = "capture window", f"ours; {CAPTURE}", "m", "end"
    return [limit(*words, capture, -lim.capture_window_m, lim.capture_window_m, scale=PLACE_SCALE)]


def about(m: Mode, p: Instant, place: ca.SX) -> ca.SX:
    """Angular momentum (3,) about a place (3,), at the end of the flight [kg m^2/s]."""
    speed = p.flight("vel") - ca.vertcat(0, 0, p.p.gravity * p.time)
    return p.flight("L") + m.model.mass * cross(p.com - place, speed)


def flip_capture(m: Mode) -> Term:
    """L about the middle of the soles, which the impact does not change; in the plane within what
    most flips of that direction are caught with.
    """
    lim = m.limits
    size = m.body.spin_size
    level = [k for k in m.free.spins if k < 2]
    most = np.full(len(level), lim.capture_moment * size)
    windows = lim.capture_in_plane if m.robot.planar else lim.capture_even

    def momentum(p):
        return about(m, p, p.sole_middle)[level]

    def measured(side):
        def bound(parameters):
            backward, forward = windows[:2], windows[2:]
            return size * (forward if float(parameters["rotation"]) > 0 else backward)[side]

        return bound

    bounds = (measured(0), measured(1)) if m.free.plane else (-most, most)
    words = "capture by momentum", f"ours, for flips; {CAPTURE}", "kg m^2/s", "end"
    return limit(*words, momentum, *bounds, scale=SPIN_SCALE)
