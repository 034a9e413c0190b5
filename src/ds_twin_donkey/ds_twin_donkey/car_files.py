# SPDX-License-Identifier: Apache-2.0
"""Files of a car: the YAML of a fit, which the simulator `donkey@FILE` loads, and files that a car has already.

From Donkey Car's `myconfig.py`, and RoboRacer's YAML and URDF, a fit takes start values. No file is executed. What a
file does not say keeps its nominal value.
"""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element

import numpy as np
import yaml
from numpy.typing import NDArray

from ds_base.bounded_file import FileError, read_regular
from ds_base.bounded_xml import parse_xml
from ds_base.bounded_yaml import DEFAULT_LIMITS, load_yaml
from ds_base.errors import InputError
from ds_base.folder_files import write_whole
from ds_road.road import abbreviated
from ds_twin_donkey.parameters import DonkeyParameters

if TYPE_CHECKING:  # whoever drives needs no part of SciPy, which takes half a second to import
    from ds_twin_donkey.fit import TwinFit
    from ds_twin_donkey.logs import Log

FORMAT = "ds_twin_donkey parameters 1"
EXPECTED = "a parameter file of `ds twin fit`, Donkey Car's myconfig.py, or a RoboRacer car's YAML or URDF"
ROBORACER = {
    "wheelbase": ("wheelbase", "l_wb"),
    "to_front": ("lf", "l_f", "l_cg2front"),
    "to_rear": ("lr", "l_r", "l_cg2rear"),
    "mass": ("m", "mass"),
    "yaw_inertia": ("I", "I_z", "moment_inertia"),
    "centre_of_mass_height": ("h", "h_cg", "height_cg"),
    "friction": ("mu", "friction_coeff"),
    "max_steering_angle": ("s_max", "max_steering_angle"),
    "servo_rate": ("sv_max", "max_steering_vel"),
    "front_stiffness": ("C_Sf", "C_S_front"),
    "rear_stiffness": ("C_Sr", "C_S_rear"),
    "servo_gain": ("steering_angle_to_servo_gain",),
    "servo_min": ("servo_min",),
    "servo_max": ("servo_max",),
}
"""Meaning -> keys in f1tenth_gym's parameters, f1tenth_simulator's params.yaml, and f1tenth_system's vesc.yaml."""
DONKEY = {"wheelbase": "WHEEL_BASE", "track": "AXLE_LENGTH", "max_steering_angle": "MAX_STEERING_ANGLE"}
"""Parameter -> key of `myconfig.py`, in Donkey Car's template path_follow."""
ARITHMETIC = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv}


class ParameterFileError(InputError):
    """The file holds no parameters of this car."""


def document_of(fit: TwinFit, logs: Sequence[Log]) -> dict[str, Any]:
    """Convert a fit to JSON values: each parameter with its status and interval, the logs, and the residuals."""
    from ds_twin_donkey.logs import CHANNELS

    units = dict(zip(CHANNELS, ("m", "m", "rad", "m/s", "rad/s"), strict=True))
    estimates = {estimate.name: estimate for estimate in fit.estimates}
    parameters: dict[str, dict[str, Any]] = {}
    for field in dataclasses.fields(DonkeyParameters):
        value = getattr(fit.parameters, field.name)
        estimate = estimates.get(field.name)
        if estimate is None:
            parameters[field.name] = {"value": value, "status": "held"}
            continue
        row: dict[str, Any] = {"value": _short(estimate.value), "unit": estimate.unit}
        row["status"] = estimate.status
        if estimate.determined:
            row["interval_95"] = [_short(estimate.low), _short(estimate.high)]
        parameters[field.name] = row | {"start": _short(estimate.start)}
    return {
        "format": FORMAT,
        "parameters": parameters,
        "logs": [
            {"name": log.name, "kind": log.kind, "sha256": log.sha256, "seconds": round(log.seconds, 2)} for log in logs
        ],
        "windows": fit.windows,
        "rms_residuals": {
            name: {"value": _short(value), "noise": _short(fit.noise[name]), "unit": units[name]}
            for name, value in fit.rms.items()
            if math.isfinite(value)
        },
    }


def write_parameters(path: Path, document: dict[str, Any]) -> None:
    """Write a document of `document_of`, in SI units of the model car."""
    head = (
        "# Parameters of the 1:16 car, fitted to recorded drives. SI units of the model car.\n"
        "# Drive with them by naming the simulator donkey@THIS_FILE. Status: fitted (95% interval within 5%),\n"
        "# weakly fitted (wider), not determined by these logs (left at the start), or held (not fitted).\n"
    )
    write_whole(path, head + yaml.safe_dump(document, sort_keys=False, width=120))


def read_parameters(path: Path) -> tuple[DonkeyParameters, str]:
    """Read the parameters of a car and the SHA-256 of their file; ParameterFileError if it is no such file."""
    try:
        content = read_regular(path, DEFAULT_LIMITS.size)
        raw = load_yaml(content, unique_keys=True)
    except OSError as error:
        raise ParameterFileError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except FileError as error:
        raise ParameterFileError(f"{path}: not YAML ({error})") from None
    if not isinstance(raw, dict) or raw.get("format") != FORMAT or not isinstance(raw.get("parameters"), dict):
        raise ParameterFileError(f"{path}: not a file of {FORMAT!r}: write one with `ds twin fit`")
    values = {}
    for name, row in raw["parameters"].items():
        value = row.get("value") if isinstance(row, dict) else None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ParameterFileError(
                f"{path}: {name!s:.60} has the value {value!r:.60}, expected a number under `value`"
            )
        values[str(name)] = value
    try:
        return DonkeyParameters().changed(**values), hashlib.sha256(content).hexdigest()
    except ValueError as error:
        raise ParameterFileError(f"{path}: {' '.join(str(error).split()):.1000}") from None


def _short(value: float) -> float:
    """Round to six digits."""
    return float(f"{value:.6g}")


@dataclass(frozen=True)
class Start:
    """Start of a fit, and what a file says of the car, as `name value`; nothing of a parameter file."""

    parameters: DonkeyParameters
    taken: list[str] = dataclasses.field(default_factory=list)


def read_start(path: Path) -> Start:
    """Read where a fit starts, from a file whose content tells its kind; ParameterFileError if none does."""
    notes: list[str] = []
    try:
        content = read_regular(path, DEFAULT_LIMITS.size)
        if path.suffix == ".py":
            parameters = _of_myconfig(content.decode())
        elif content.lstrip()[:1] == b"<":
            parameters, notes = _of_urdf(parse_xml(content))
        else:
            raw = load_yaml(content)
            if isinstance(raw, dict) and "parameters" in raw:
                return Start(read_parameters(path)[0])
            parameters = _of_yaml(raw)
        if not parameters:
            raise ValueError(f"nothing about the car's geometry: expected {EXPECTED}")
        taken = [f"{name} {value:.4g}" for name, value in parameters.items()]
        return Start(DonkeyParameters().changed(**parameters), taken + notes)
    except OSError as error:
        raise ParameterFileError(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except (ValueError, SyntaxError, FileError) as error:
        raise ParameterFileError(f"{path}: {' '.join(str(error).split()):.500}") from None


def _number(name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
        raise ValueError(f"{name} is {abbreviated(value)}, expected a number: correct it")
    return float(value)


def _of_myconfig(text: str) -> dict[str, float]:
    """Parameters of literal assignments; of several, as in Python, the last one counts."""
    settings: dict[str, Any] = {}
    try:
        lines = ast.parse(text).body
    except (MemoryError, RecursionError):
        raise ValueError("nested too deeply: expected literal assignments") from None
    for line in lines:
        if isinstance(line, ast.Assign) and len(line.targets) == 1 and isinstance(line.targets[0], ast.Name):
            value = _literal(line.value)
            # The pulse counts stand in a mapping of the drive train, or at the top.
            settings |= value if isinstance(value, dict) else {line.targets[0].id: value}
    settings = {name: value for name, value in settings.items() if value is not None}
    parameters = {name: _number(key, settings[key]) for name, key in DONKEY.items() if key in settings}
    for name, full, zero, share in (
        ("steering_pulse_steps", "STEERING_LEFT_PWM", "STEERING_RIGHT_PWM", 0.5),
        ("throttle_pulse_steps", "THROTTLE_FORWARD_PWM", "THROTTLE_STOPPED_PWM", 1.0),
    ):
        if full in settings and zero in settings:
            parameters[name] = round(share * abs(_number(full, settings[full]) - _number(zero, settings[zero])))
    return parameters


def _literal(value: ast.expr) -> Any:
    """Value of a literal, of arithmetic on numbers, or of `math.radians(number)`; None for anything else."""
    if isinstance(value, ast.BinOp) and type(value.op) in ARITHMETIC:
        try:
            sides = [_literal(side) for side in (value.left, value.right)]
            numbers = all(isinstance(side, int | float) for side in sides)
            return ARITHMETIC[type(value.op)](*sides) if numbers else None
        except (ArithmeticError, RecursionError):
            return None
    if isinstance(value, ast.Call) and ast.unparse(value.func) == "math.radians" and len(value.args) == 1:
        degrees = _literal(value.args[0])
        return math.radians(degrees) if isinstance(degrees, int | float) else None
    try:
        return ast.literal_eval(value)
    except (ValueError, TypeError, MemoryError, RecursionError):
        return None


def _items(raw: object) -> Iterator[tuple[str, Any]]:
    """All keys with values, however deep: a node's parameters stand below `ros__parameters`."""
    for key, value in raw.items() if isinstance(raw, Mapping) else ():
        yield str(key), value
        yield from _items(value)


def _of_yaml(raw: object) -> dict[str, float]:
    items = dict(_items(raw))
    said = {name: _number(key, items[key]) for name, keys in ROBORACER.items() for key in keys if key in items}
    front, rear = said.pop("to_front", 0.0), said.pop("to_rear", 0.0)
    if front > 0.0 and rear > 0.0:
        said |= {"wheelbase": front + rear, "front_share": rear / (front + rear)}
    gain, low, high = (said.pop(name, 0.0) for name in ("servo_gain", "servo_min", "servo_max"))
    if gain and high > low:
        said["max_steering_angle"] = 0.5 * (high - low) / abs(gain)
    for axle in ("front_stiffness", "rear_stiffness"):
        if axle in said:  # of theirs, friction is a factor
            said[axle] *= said.get("friction", 1.0)
    return said


def _of_urdf(root: Element) -> tuple[dict[str, float], list[str]]:
    """Geometry from the places of the wheels' joints, and a note about the camera, whose pose is no parameter."""
    if any("xacro" in one.tag or "${" in "".join(one.attrib.values()) for one in root.iter()):
        raise ValueError("a xacro, expected a URDF: type `xacro FILE > car.urdf`")
    joints = {child.get("link", ""): joint for joint in root.iter("joint") for child in joint.iter("child")}
    places: dict[str, NDArray[np.float64]] = {}
    for link in root.iter("link"):
        _place(str(link.get("name")), joints, places)
    wheels = {name.lower(): place[:3, 3] for name, place in places.items() if "wheel" in name.lower()}
    front = [place for name, place in wheels.items() if "front" in name]
    rear = [place for name, place in wheels.items() if "rear" in name or "back" in name]
    if not front or not rear:
        raise ValueError("no front and rear wheels: expected links such as front_left_wheel and back_left_wheel")
    middle = [np.mean(places, axis=0) for places in (front, rear)]
    parameters = {"wheelbase": float(middle[0][0] - middle[1][0])}
    track = float(np.ptp([place[1] for place in front]))
    parameters |= {"track": track} if track > 0.0 else {}
    masses = [_number("mass", float(mass.get("value", "nan"))) for mass in root.iter("mass")]
    parameters |= {"mass": sum(masses)} if masses else {}
    limits = [
        min(abs(float(limit.get(side, "nan"))) for side in ("lower", "upper"))
        for joint in root.iter("joint")
        for limit in joint.iter("limit")
        if joint.get("type") == "revolute" and any(w in str(joint.get("name")).lower() for w in ("steer", "hinge"))
    ]
    parameters |= {"max_steering_angle": min(limits)} if limits else {}
    shapes = [
        shape
        for link in root.iter("link")
        if "wheel" in str(link.get("name")).lower()
        for shape in link.iter("cylinder")
    ]
    radii = [_number("radius", float(shape.get("radius", "nan"))) for shape in shapes]
    camera = next((place for name, place in places.items() if "camera" in name.lower()), None)
    if camera is None or not radii:
        return parameters, []
    seat = camera[:3, 3] - 0.5 * (middle[0] + middle[1])
    pose = {
        "height_m": seat[2] + radii[0],
        "pitch_rad": -math.asin(max(-1.0, min(camera[2, 0], 1.0))),
        "forward_m": seat[0],
    }
    return parameters, ["for camera.yaml: " + ", ".join(f"{name}: {value:.4g}" for name, value in pose.items())]


def _place(link: str, joints: Mapping[str, Element], places: dict[str, NDArray[np.float64]]) -> None:
    """Add the poses of a link and of those above it in the root's axes, (4, 4) (REP-103)."""
    above: list[tuple[str, Element]] = []
    while link not in places and (joint := joints.get(link)) is not None:
        above.append((link, joint))
        if len(above) > len(joints):
            raise ValueError(f"the joints of {abbreviated(link)} form a circle")
        parent = joint.find("parent")
        link = "" if parent is None else parent.get("link", "")
    pose = places.setdefault(link, np.eye(4))
    for below, joint in reversed(above):
        pose = places[below] = np.einsum("ij,jk->ik", pose, _transform(joint.find("origin")))


def _transform(origin: Element | None) -> NDArray[np.float64]:
    transform = np.eye(4)
    if origin is not None:
        from scipy.spatial.transform import Rotation

        xyz, rpy = ([float(v) for v in origin.get(name, "0 0 0").split()] for name in ("xyz", "rpy"))
        if len(xyz) != 3 or len(rpy) != 3 or not np.isfinite([xyz, rpy]).all():
            raise ValueError(f"the origin {abbreviated(origin.attrib)}: expected three finite numbers in xyz and rpy")
        transform[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        transform[:3, 3] = xyz
    return transform
