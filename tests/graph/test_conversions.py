# SPDX-License-Identifier: Apache-2.0
"""Messages against the plain values that they carry."""

from __future__ import annotations

import numpy as np
import pytest
from ds_interfaces.msg import Outcome as OutcomeMsg
from ds_interfaces.msg import Reason as ReasonMsg
from ds_interfaces.msg import Road as RoadMsg
from rclpy.serialization import deserialize_message, serialize_message

from ds_road import Road, RoadError
from ds_sim.messages import road_from_message
from ds_sim.ros.conversions import message_builder, road_to_message
from ds_sim.simulator import Outcome, Reason, VehicleState

pytestmark = pytest.mark.graph

POINTS = [(125.0 + 8.0 * (i % 2), 25.0 * i) for i in range(9)]
ROADS = {
    "plain": Road(POINTS),
    "narrow": Road(POINTS, lane_width=3.5),
    "maxitwo": Road(POINTS, maxitwo_compatible=True),
    "sampled": Road.from_road_points(Road(POINTS).points, lane_width=3.0),
    "left": Road(POINTS, lane="left"),
    "middle": Road(POINTS, lane="middle"),
    "single": Road.from_road_points(Road(POINTS).points, lane_width=2.5, lane="single"),
}


@pytest.mark.parametrize("name", ROADS)
def test_a_road_message_makes_an_equal_road_with_the_same_id(name: str) -> None:
    sent = deserialize_message(serialize_message(road_to_message(ROADS[name])), RoadMsg)
    made = road_from_message(sent)
    assert made == ROADS[name] and made.road_id == ROADS[name].road_id == sent.road_id
    np.testing.assert_array_equal(made.points, ROADS[name].points)


def test_a_road_message_without_a_width_has_the_usual_one_and_contradictions_are_refused() -> None:
    message = road_to_message(ROADS["plain"])
    message.lane_width = 0.0
    assert road_from_message(message) == ROADS["plain"]
    message.sampled = message.maxitwo_compatible = True
    with pytest.raises(RoadError, match="both sampled and maxitwo_compatible"):
        road_from_message(message)


def test_the_numbers_of_outcomes_and_reasons_are_those_of_the_messages() -> None:
    for kind, message in ((Outcome, OutcomeMsg), (Reason, ReasonMsg)):
        constants = {name: getattr(message, name) for name in vars(type(message)).get("_Metaclass_Constants", [])}
        constants = constants or {name: getattr(message, name) for name in kind.__members__}
        assert constants == {member.name: int(member) for member in kind}


def test_odometry_is_marked_as_ground_truth() -> None:
    """Tiny variances for exact values, huge ones for missing values; zeros would mean unknown."""
    vehicle = VehicleState(x=1.0, y=2.0, yaw=0.5, speed=3.0, yaw_rate=0.1, steering_angle=0.0)
    make = message_builder("/ds1")
    message = make.odometry(vehicle, make.stamp(0))
    assert (message.header.frame_id, message.child_frame_id) == ("road", "ds1/base_link")
    for covariance in (message.pose.covariance, message.twist.covariance):
        matrix = np.reshape(covariance, (6, 6))
        assert np.all(np.linalg.eigvalsh(matrix) > 0.0)
        assert np.all(np.diag(matrix)[[0, 1, 5]] < 1e-6) and np.all(np.diag(matrix)[[2, 3, 4]] > 1e6)
