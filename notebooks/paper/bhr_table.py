"""Every number of the default robot in one table, and the URDF built from it.

The paper gives 42 kg, about 1.5 m, 14 joints and nine links (Sec. VI-A), nothing else. All other values below are *our
choice*; each row carries its reason. They are not the authors' robot.

``python -m paper.bhr_table``, run in this folder's parent, rewrites the package's ``bhr.urdf``; a test asserts that
the two agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree as ET

from jumplab.robot.files import SHIPPED

URDF_PATH = SHIPPED["bhr"].with_name("bhr.urdf")


@dataclass(frozen=True)
class Row:
    """One number: value, unit and where it comes from."""

    value: float
    unit: str
    source: str


TABLE: dict[str, Row] = {
    # whole robot ------------------------------------------------------------------------------------------------
    "total_mass": Row(42.0, "kg", "paper, Sec. VI-A"),
    "height": Row(1.50, "m", "paper, Sec. VI-A (approximately)"),
    # lengths ----------------------------------------------------------------------------------------------------
    "thigh_length": Row(0.35, "m", "our choice: hip at 0.52 of the height, as in adults (0.53), two equal segments"),
    "shank_length": Row(0.35, "m", "our choice: equal to the thigh, so that the leg can fold completely"),
    "ankle_height": Row(0.075, "m", "our choice: room for a two-axis ankle and a force sensor above the sole"),
    "hip_below_trunk_top": Row(0.43, "m", "our choice: shoulder axis at 0.80 of the height (adults 0.82)"),
    "hip_offset_y": Row(0.10, "m", "our choice: 0.10 m between the inner edges of the feet"),
    "shoulder_offset_y": Row(0.23, "m", "our choice: the arm's sweep clears trunk and abducted thigh"),
    "arm_length": Row(0.48, "m", "our choice: fingertip 0.05 m below the hip, forearm folded into one link"),
    "head_above_trunk_top": Row(0.295, "m", "our choice: completes 1.50 m"),
    "foot_heel_x": Row(-0.10, "m", "our choice: 0.24 m sole, ankle at 42 % from the heel"),
    "foot_toe_x": Row(0.14, "m", "our choice: a shorter toe lever lowers the ankle torque at take-off"),
    "foot_width": Row(0.10, "m", "our choice"),
    "foot_thickness": Row(0.03, "m", "our choice: clears the shank over the whole ankle range"),
    # collision geometry -----------------------------------------------------------------------------------------
    "trunk_depth": Row(
        0.16, "m", "our choice: with the box starting 0.10 m above the hip, flexion to -2.1 rad is free"
    ),
    "trunk_width": Row(0.28, "m", "our choice: inner arm surface at 0.195 m"),
    "trunk_bottom_above_hip": Row(0.10, "m", "our choice: see trunk_depth"),
    "pelvis_width": Row(0.08, "m", "our choice: fits between the thighs"),
    "thigh_thickness": Row(0.09, "m", "our choice"),
    "shank_thickness": Row(0.07, "m", "our choice"),
    "limb_gap": Row(0.04, "m", "our choice: boxes of thigh and shank keep this off hip and ankle"),
    "thigh_knee_gap": Row(0.07, "m", "our choice: with shank_knee_gap and shank_forward the knee folds to 2.5 rad"),
    "shank_knee_gap": Row(0.085, "m", "our choice: see thigh_knee_gap"),
    "shank_forward": Row(0.03, "m", "our choice: see thigh_knee_gap; a shin stands ahead of its joint line"),
    "arm_thickness": Row(0.07, "m", "our choice"),
    # masses -----------------------------------------------------------------------------------------------------
    "thigh_mass": Row(5.0, "kg", "our choice: 12 % of the body, hip and knee drives inside"),
    "shank_mass": Row(3.0, "kg", "our choice: 7 %, ankle drives in the upper half"),
    "foot_mass": Row(1.0, "kg", "our choice: 2.4 %, with force sensor"),
    "arm_mass": Row(2.0, "kg", "our choice: 4.8 %"),
    "dummy_mass": Row(
        0.001, "kg", "our choice: zero is refused by MuJoCo and read as 1 kg by PyBullet; taken off the trunk"
    ),
    "dummy_inertia": Row(1e-6, "kg m^2", "our choice: see dummy_mass"),
    # centres of mass --------------------------------------------------------------------------------------------
    "trunk_com_below_top": Row(0.20, "m", "our choice: hip drives and battery below, head above"),
    "thigh_com_below_hip": Row(0.15, "m", "our choice: drives near the hip"),
    "shank_com_below_knee": Row(0.14, "m", "our choice: drives near the knee"),
    "foot_com_x": Row(0.02, "m", "our choice: middle of the sole"),
    "foot_com_below_ankle": Row(0.045, "m", "our choice"),
    "arm_com_below_shoulder": Row(0.22, "m", "our choice"),
    # inertias: boxes of uniform density with these lengths ------------------------------------------------------
    "trunk_inertia_length": Row(0.60, "m", "our choice: trunk with head as one box 0.60 x 0.24 x 0.18 m"),
    "trunk_inertia_width": Row(0.24, "m", "our choice: see trunk_inertia_length"),
    "trunk_inertia_depth": Row(0.18, "m", "our choice: see trunk_inertia_length"),
    # actuators: peak torque [N m] and no-load speed [rad/s] -----------------------------------------------------
    "hip_yaw_effort": Row(80.0, "N m", "our choice: half of the pitch drives; not used in a sagittal jump"),
    "hip_roll_effort": Row(120.0, "N m", "our choice: carries one-legged stance (0.5 m g * 0.2 m) with margin"),
    "hip_pitch_effort": Row(200.0, "N m", "our choice: between Unitree G1 (88, 35 kg) and H1 (220, 47 kg)"),
    "knee_effort": Row(210.0, "N m", "our choice: 2 tau / (m g leg) = 1.46; published robots of this size 1.3 to 1.6"),
    "ankle_pitch_effort": Row(
        150.0, "N m", "our choice: half the body weight at 3.5 g on the toe lever, parallel drive"
    ),
    "ankle_roll_effort": Row(60.0, "N m", "our choice: half the body weight at 3 g on the half-width"),
    "shoulder_pitch_effort": Row(45.0, "N m", "our choice: G1 25, H1 40 to 75"),
    "hip_yaw_speed": Row(15.0, "rad/s", "our choice: published 15 to 20"),
    "hip_roll_speed": Row(15.0, "rad/s", "our choice: published 15 to 20"),
    "hip_pitch_speed": Row(18.0, "rad/s", "our choice: published 15 to 23"),
    "knee_speed": Row(20.0, "rad/s", "our choice: published 14 to 20"),
    "ankle_pitch_speed": Row(18.0, "rad/s", "our choice: published 9 to 30"),
    "ankle_roll_speed": Row(15.0, "rad/s", "our choice"),
    "shoulder_pitch_speed": Row(15.0, "rad/s", "our choice: published 9 to 37"),
    # ranges, what the boxes above allow without touching --------------------------------------------------------
    "hip_yaw_range": Row(0.3, "rad", "our choice: both ways"),
    "hip_roll_inward": Row(0.06, "rad", "geometry: both feet inward just clear each other"),
    "hip_roll_outward": Row(0.5, "rad", "geometry: thigh clears the hanging arm"),
    "hip_pitch_lower": Row(-2.05, "rad", "geometry: thigh meets the trunk box at -2.10"),
    "hip_pitch_upper": Row(0.70, "rad", "our choice"),
    "knee_lower": Row(0.0, "rad", "mechanical stop at the straight leg"),
    "knee_upper": Row(2.40, "rad", "geometry: shank meets the thigh near 2.5"),
    "ankle_pitch_lower": Row(-0.95, "rad", "our choice: published -0.9; dorsiflexion of a deep crouch"),
    "ankle_pitch_upper": Row(0.90, "rad", "our choice"),
    "ankle_roll_range": Row(0.35, "rad", "our choice: both ways"),
    "shoulder_pitch_lower": Row(-3.0, "rad", "our choice: overhead, in front"),
    "shoulder_pitch_upper": Row(1.2, "rad", "our choice: backward swing"),
}


def value(name: str) -> float:
    """Value of one row of the table, in its SI unit."""
    return TABLE[name].value


def _numbers(*values: float) -> str:
    return " ".join(f"{v:.10g}" for v in values)


def _box_inertia(mass: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    return mass / 12 * (y * y + z * z), mass / 12 * (x * x + z * z), mass / 12 * (x * x + y * y)


def _link(root, name, mass, com, inertia, boxes=(), color="0.75 0.78 0.82 1"):
    link = ET.SubElement(root, "link", name=name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_numbers(*com), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=_numbers(mass))
    ixx, iyy, izz = inertia
    ET.SubElement(
        inertial, "inertia", ixx=_numbers(ixx), ixy="0", ixz="0", iyy=_numbers(iyy), iyz="0", izz=_numbers(izz)
    )
    for centre, size, solid in boxes:
        for kind in ("visual", "collision") if solid else ("visual",):
            shape = ET.SubElement(link, kind)
            ET.SubElement(shape, "origin", xyz=_numbers(*centre), rpy="0 0 0")
            ET.SubElement(ET.SubElement(shape, "geometry"), "box", size=_numbers(*size))
            if kind == "visual":
                ET.SubElement(ET.SubElement(shape, "material", name=f"{name}_paint"), "color", rgba=color)


def _joint(root, name, parent, child, origin, axis, lower, upper, effort, speed):
    joint = ET.SubElement(root, "joint", name=name, type="revolute")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_numbers(*origin), rpy="0 0 0")
    ET.SubElement(joint, "axis", xyz=_numbers(*axis))
    ET.SubElement(
        joint, "limit", lower=_numbers(lower), upper=_numbers(upper), effort=_numbers(effort), velocity=_numbers(speed)
    )


def _trunk(root):
    v = value
    top, hip = v("head_above_trunk_top"), v("hip_below_trunk_top")
    limbs = sum(v(f"{part}_mass") for part in ("thigh", "shank", "foot", "arm"))
    mass = v("total_mass") - 2 * limbs - 6 * v("dummy_mass")
    bottom = -hip + v("trunk_bottom_above_hip")
    boxes = [
        ((0, 0, bottom / 2), (v("trunk_depth"), v("trunk_width"), -bottom), True),
        ((0, 0, bottom - 0.05), (0.10, v("pelvis_width"), 0.10), True),
        ((0.0, 0, top / 2 + 0.02), (0.14, 0.14, top - 0.04), True),
    ]
    size = (v("trunk_inertia_depth"), v("trunk_inertia_width"), v("trunk_inertia_length"))
    _link(root, "trunk", mass, (0, 0, -v("trunk_com_below_top")), _box_inertia(mass, *size), boxes, "0.30 0.36 0.45 1")


def _arm(root, side, sign):
    v = value
    length, thick = v("arm_length"), v("arm_thickness")
    box = ((0, 0, -length / 2), (thick, thick, length), True)
    inertia = _box_inertia(v("arm_mass"), thick, thick, length)
    _link(root, f"{side}_arm", v("arm_mass"), (0, 0, -v("arm_com_below_shoulder")), inertia, [box], "0.80 0.55 0.25 1")
    links = "trunk", f"{side}_arm", (0, sign * v("shoulder_offset_y"), 0), (0, 1, 0)
    limits = (v(f"shoulder_pitch_{limit}") for limit in ("lower", "upper", "effort", "speed"))
    _joint(root, f"{side}_shoulder_pitch", *links, *limits)


def _dummy(root, name):
    i = value("dummy_inertia")
    _link(root, name, value("dummy_mass"), (0, 0, 0), (i, i, i))


def _leg(root, side, sign):
    """Hip yaw, roll, pitch, knee, ankle pitch, roll; all axes point along +x, +y, +z on both sides, as is usual."""
    v = value
    thigh, shank, thin = v("thigh_length"), v("shank_length"), v("shank_thickness")
    _dummy(root, f"{side}_hip_yaw_link")
    yaw = v("hip_yaw_range")
    _joint(root, f"{side}_hip_yaw", "trunk", f"{side}_hip_yaw_link",
           (0, sign * v("hip_offset_y"), -v("hip_below_trunk_top")), (0, 0, 1), -yaw, yaw,
           v("hip_yaw_effort"), v("hip_yaw_speed"))  # fmt: skip
    _dummy(root, f"{side}_hip_roll_link")
    inward, outward = -sign * v("hip_roll_inward"), sign * v("hip_roll_outward")
    _joint(root, f"{side}_hip_roll", f"{side}_hip_yaw_link", f"{side}_hip_roll_link", (0, 0, 0), (1, 0, 0),
           min(inward, outward), max(inward, outward), v("hip_roll_effort"), v("hip_roll_speed"))  # fmt: skip
    top, bottom = v("limb_gap"), thigh - v("thigh_knee_gap")
    box = ((0, 0, -(top + bottom) / 2), (v("thigh_thickness"), v("thigh_thickness"), bottom - top), True)
    inertia = _box_inertia(v("thigh_mass"), v("thigh_thickness"), v("thigh_thickness"), thigh)
    _link(root, f"{side}_thigh", v("thigh_mass"), (0, 0, -v("thigh_com_below_hip")), inertia, [box])
    _joint(root, f"{side}_hip_pitch", f"{side}_hip_roll_link", f"{side}_thigh", (0, 0, 0), (0, 1, 0),
           v("hip_pitch_lower"), v("hip_pitch_upper"), v("hip_pitch_effort"), v("hip_pitch_speed"))  # fmt: skip
    top, bottom = v("shank_knee_gap"), shank - v("limb_gap")
    box = ((v("shank_forward"), 0, -(top + bottom) / 2), (thin, thin, bottom - top), True)
    inertia = _box_inertia(v("shank_mass"), thin, thin, shank)
    _link(root, f"{side}_shank", v("shank_mass"), (0, 0, -v("shank_com_below_knee")), inertia, [box])
    _joint(root, f"{side}_knee", f"{side}_thigh", f"{side}_shank", (0, 0, -thigh), (0, 1, 0),
           v("knee_lower"), v("knee_upper"), v("knee_effort"), v("knee_speed"))  # fmt: skip
    _dummy(root, f"{side}_ankle_link")
    _joint(root, f"{side}_ankle_pitch", f"{side}_shank", f"{side}_ankle_link", (0, 0, -shank), (0, 1, 0),
           v("ankle_pitch_lower"), v("ankle_pitch_upper"), v("ankle_pitch_effort"), v("ankle_pitch_speed"))  # fmt: skip
    heel, toe, thickness = v("foot_heel_x"), v("foot_toe_x"), v("foot_thickness")
    centre = ((heel + toe) / 2, 0, -v("ankle_height") + thickness / 2)
    size = (toe - heel, v("foot_width"), thickness)
    _link(root, f"{side}_foot", v("foot_mass"), (v("foot_com_x"), 0, -v("foot_com_below_ankle")),
          _box_inertia(v("foot_mass"), *size), [(centre, size, True)], "0.20 0.20 0.22 1")  # fmt: skip
    roll = v("ankle_roll_range")
    _joint(root, f"{side}_ankle_roll", f"{side}_ankle_link", f"{side}_foot", (0, 0, 0), (1, 0, 0), -roll, roll,
           v("ankle_roll_effort"), v("ankle_roll_speed"))  # fmt: skip


def build_urdf() -> str:
    """URDF text of the default robot, built from :data:`TABLE`. Base link ``trunk``, origin at the top of the trunk."""
    root = ET.Element("robot", name="bhr")
    _trunk(root)
    for side, sign in (("left", 1), ("right", -1)):
        _leg(root, side, sign)
    for side, sign in (("left", 1), ("right", -1)):
        _arm(root, side, sign)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


if __name__ == "__main__":
    URDF_PATH.write_text(build_urdf())
