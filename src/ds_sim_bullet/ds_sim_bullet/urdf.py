"""Generates the car's URDF: body, four hubs on vertical guides, two steering knuckles, four wheels."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

from ds_sim_bullet.parameters import BulletParameters

HUB_RADIUS_OF_GYRATION = 0.12
"""Radius of gyration of hub and knuckle, m; chosen: hand-sized castings. They turn with body and steering only."""
STOP_DEPTH = 0.05
"""Travel from the rubber stop to metal, m; chosen: the stop then bears five times the static load."""
CORNERS = ("front_left", "front_right", "rear_left", "rear_right")
"""Order of the corners wherever there is one value per corner."""


def car_urdf(p: BulletParameters) -> str:
    """Generate the URDF of the car, with frames as in REP-103.

    At rest the root `base_link` is on the ground, midway between the axles. Joints of each corner: `<corner>_guide`
    (prismatic, positive up), `<corner>_steering` (revolute, positive left, front only), `<corner>_spin` (continuous,
    positive forward). The collision shape of a wheel is a sphere: it has a single contact point under the axle whatever
    the camber, and no edge that could catch.
    """
    robot = Element("robot", name="bullet_car")
    body = _link(
        robot,
        "base_link",
        p.sprung_mass,
        p.body_inertia,
        centre=(p.body_forward, 0.0, p.centre_of_mass_height),
    )
    _collision(
        body,
        "box",
        centre=(0.0, 0.0, 0.5 * (p.height + p.ground_clearance)),
        size=_text(p.length, p.width, p.height - p.ground_clearance),
    )
    for corner in CORNERS:
        _add_corner(robot, p, corner)
    indent(robot)
    return tostring(robot, encoding="unicode")


def _add_corner(robot: Element, p: BulletParameters, corner: str) -> None:
    front, left = corner.startswith("front"), corner.endswith("left")
    mass = p.unsprung_mass - p.wheel_mass
    hub_mass = 0.5 * mass if front else mass
    inertia = hub_mass * HUB_RADIUS_OF_GYRATION**2
    position = (
        (0.5 if front else -0.5) * p.wheelbase,
        (0.5 if left else -0.5) * p.track,
        p.wheel_radius,
    )
    guide_limit = p.travel + STOP_DEPTH
    _link(robot, f"{corner}_hub", hub_mass, (inertia, inertia, inertia))
    _joint(robot, f"{corner}_guide", "prismatic", "base_link", f"{corner}_hub", "0 0 1", position, guide_limit)
    carrier = f"{corner}_hub"
    if front:
        carrier = f"{corner}_knuckle"
        _link(robot, carrier, mass - hub_mass, (inertia, inertia, inertia))
        _joint(robot, f"{corner}_steering", "revolute", f"{corner}_hub", carrier, "0 0 1", (0.0, 0.0, 0.0), 1.2)
    spin_inertia = p.wheel_spin_inertia + (0.0 if front else p.rotor_inertia)
    diametral_inertia = 0.5 * spin_inertia  # that of a thin ring
    wheel = _link(robot, f"{corner}_wheel", p.wheel_mass, (diametral_inertia, spin_inertia, diametral_inertia))
    _collision(wheel, "sphere", radius=repr(p.wheel_radius))
    contact = SubElement(wheel, "contact")
    SubElement(contact, "lateral_friction", value=repr(p.friction))
    _joint(robot, f"{corner}_spin", "continuous", carrier, f"{corner}_wheel", "0 1 0", (0.0, 0.0, 0.0))


def _link(
    robot: Element,
    name: str,
    mass: float,
    inertia: tuple[float, float, float],
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Element:
    link = SubElement(robot, "link", name=name)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=_text(*centre))
    SubElement(inertial, "mass", value=repr(mass))
    xx, yy, zz = (repr(value) for value in inertia)
    SubElement(inertial, "inertia", ixx=xx, iyy=yy, izz=zz, ixy="0", ixz="0", iyz="0")
    return link


def _collision(link: Element, shape: str, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), **sizes: str) -> None:
    collision = SubElement(link, "collision")
    SubElement(collision, "origin", xyz=_text(*centre))
    SubElement(SubElement(collision, "geometry"), shape, sizes)


def _joint(
    robot: Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    axis: str,
    position: tuple[float, float, float],
    limit: float = 0.0,
) -> None:
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", xyz=_text(*position))
    SubElement(joint, "axis", xyz=axis)
    SubElement(joint, "dynamics", damping="0", friction="0")
    if limit:
        SubElement(joint, "limit", lower=repr(-limit), upper=repr(limit), effort="1e9", velocity="1e9")


def _text(*values: float) -> str:
    return " ".join(repr(value) for value in values)
