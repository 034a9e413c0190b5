# SPDX-License-Identifier: Apache-2.0
"""Steering in angles, curvatures and paths, against closed forms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from torch import nn

from ds_driver.control.bicycle import Geometry, pursuit_curvature
from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.description import OutputSpec, PathSpec
from ds_driver.networks.pilot import DriverError, Frame
from ds_sim.registry import STANDARD, spec_of

CAR = Geometry(wheelbase=2.5, max_steering_angle=math.radians(40.0))


def on_arc(radius: float, *angles: float) -> np.ndarray:
    """Points on a circle to the left (radius > 0) that is tangent to the vehicle at its rear axle."""
    return np.array([(abs(radius) * math.sin(a), radius * (1.0 - math.cos(a))) for a in angles])


@pytest.mark.parametrize("radius", [4.0, -7.5, 120.0])
def test_every_point_of_an_arc_gives_its_curvature(radius: float) -> None:
    for angle in (0.1, 0.7, 1.5):
        assert pursuit_curvature(on_arc(radius, angle), math.inf) == pytest.approx(1.0 / radius)


def test_a_path_is_pursued_where_it_leaves_the_circle_of_the_lookahead() -> None:
    path = np.array([[1.0, 0.2], [2.5, 0.4], [3.0, 1.8], [1.0, 6.0]])
    ways = [path[k] + t * (path[k + 1] - path[k]) for k in range(3) for t in np.linspace(0, 1, 100_001)]
    goal = next(point for point in ways if np.hypot(*point) >= 3.3)
    assert pursuit_curvature(path, 3.3) == pytest.approx(2.0 * goal[1] / 3.3**2, abs=1e-4)
    assert pursuit_curvature(path, 50.0) == pytest.approx(2.0 * 6.0 / 37.0)
    assert pursuit_curvature(np.zeros((2, 2)), 3.0) == 0.0


def test_angles_and_curvatures_become_shares_of_a_vehicles_full_steering() -> None:
    assert OutputSpec(unit="degrees").steering(10.0, CAR) == pytest.approx(0.25)
    assert OutputSpec(unit="degrees", ratio=15.0).steering(-150.0, CAR) == pytest.approx(-0.25)
    assert OutputSpec(unit="radians").steering(math.radians(80.0), CAR) == 1.0
    turn = OutputSpec(unit="curvature").steering(-0.1, CAR)
    assert math.tan(CAR.angle_of(turn)) / CAR.wheelbase == pytest.approx(0.1)  # left positive in REP-103


@pytest.mark.parametrize("axes", [("forward", "left"), ("left", "forward"), ("forward", "right"), ("right", "forward")])
def test_a_path_is_read_along_its_axes_from_its_origin(axes: Any) -> None:
    path = on_arc(9.0, *np.linspace(0.05, 0.9, 18)) - [0.6, 0.0]
    columns = {"forward": path[:, 0], "left": path[:, 1], "right": -path[:, 1]}
    numbers = np.array([7.0, *np.column_stack([columns[one] for one in axes]).reshape(-1) / 2.0], np.float32)
    spec = PathSpec(index=1, points=18, axes=axes, scale=2.0, ahead=0.6, lookahead=5.0)
    # The path is a polygon in the circle, whose points are not on it.
    assert math.tan(CAR.angle_of(spec.steering(numbers, CAR))) / 2.5 == pytest.approx(1.0 / 9.0, rel=0.01)


class Fixed(nn.Module):
    """Answers the same numbers to every image."""

    def __init__(self, *numbers: float) -> None:
        super().__init__()
        self.numbers = nn.Parameter(torch.tensor([numbers]))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.numbers + 0.0 * image.mean()


def described(folder: Path, outputs: dict[str, Any], *numbers: float) -> Path:
    torch.onnx.export(Fixed(*numbers).eval(), (torch.zeros(1, 3, 8, 16),), str(folder / "n.onnx"), dynamo=False)
    path = folder / "n.yaml"
    path.write_text(yaml.safe_dump({"file": "n.onnx", "input": {"size": [8, 16]}, "outputs": outputs}))
    return path


@pytest.mark.filterwarnings("ignore:.*legacy TorchScript:DeprecationWarning")
def test_an_angle_is_another_share_on_every_vehicle(tmp_path: Path) -> None:
    pilot = DescribedNetworkPilot(described(tmp_path, {"steering": {"unit": "degrees"}}, 8.0))
    shares = {}
    for name in STANDARD:
        spec = spec_of(name)
        vehicle = Geometry(spec.wheelbase, spec.max_steering_angle)
        shares[name] = pilot.predict(Frame(image=Frame.black().image, speed=0.0, vehicle=vehicle)).steering
        assert shares[name] == pytest.approx(math.radians(8.0) / spec.max_steering_angle)
    assert len(set(shares.values())) > 1
    with pytest.raises(DriverError, match="steering in degrees needs the vehicle"):
        pilot.predict(Frame(image=Frame.black().image, speed=0.0))


@pytest.mark.filterwarnings("ignore:.*legacy TorchScript:DeprecationWarning")
@pytest.mark.parametrize(
    ("outputs", "said"),
    [
        ({"path": {"points": 3, "lookahead": 4.0}}, "the output for path has 2 numbers: its description needs 6"),
        ({"path": {"points": 3}}, "lookahead is the distance"),
        ({"path": {}, "steering": {}}, "expected either steering or path"),
        ({"path": {"axes": ["left", "right"]}}, "axes are forward and either left or right"),
        ({"path": {"point": 1}}, r"keys of outputs\.path: output, index, points"),
        ({"steering": {"ratio": 15}}, "ratio is of a steering wheel's angle"),
        ({"throttle": {"unit": "degrees"}}, "throttle is a share"),
        ({"steering": {"bins": True}}, r"outputs\.steering\.bins"),
    ],
)
def test_wrong_outputs_are_refused_in_one_line(tmp_path: Path, outputs: dict[str, Any], said: str) -> None:
    with pytest.raises(DriverError, match=said) as raised:
        DescribedNetworkPilot(described(tmp_path, outputs, 1.0, 2.0))
    assert "\n" not in str(raised.value)


@pytest.mark.filterwarnings("ignore:.*legacy TorchScript:DeprecationWarning")
def test_a_path_that_is_not_a_number_is_an_error_of_the_drive(tmp_path: Path) -> None:
    with pytest.raises(DriverError, match="steering is nan"):
        DescribedNetworkPilot(described(tmp_path, {"path": {}}, math.nan, 1.0))
