# SPDX-License-Identifier: Apache-2.0
"""Content of a bag, read by independent readers; needs the installed message definitions."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from ds_bags.info import describe, info_in_words
from ds_bags.layout import LEVELS, BagError, Level
from ds_bags.reader import BagReader, read_run
from ds_bags.rosbag2_writer import Rosbag2Writer, typestore
from ds_bags.run_writer import message_builder, write_bag
from ds_sim.camera.lens import optical_axes
from ds_sim.messages import MessageBuilder
from ds_sim.registry import DONKEY, SOFTBODY, make_simulator
from ds_sim.session import ResimulationError, RunRecord, resimulate
from ds_sim.simulator import Outcome, VehicleState

pytestmark = pytest.mark.graph

FRAMES = 41
ALWAYS = {
    "/twin/road": ("ds_interfaces/msg/Road", 1),
    "/twin/road_markers": ("visualization_msgs/msg/MarkerArray", 1),
    "/tf_static": ("tf2_msgs/msg/TFMessage", 1),
    "/tf": ("tf2_msgs/msg/TFMessage", FRAMES),
    "/twin/state": ("ds_interfaces/msg/VehicleState", FRAMES),
    "/twin/odom": ("nav_msgs/msg/Odometry", FRAMES),
    "/twin/drive": ("ds_interfaces/msg/DriveCommand", FRAMES - 1),
    "/twin/outcome": ("ds_interfaces/msg/Outcome", 1),
}
INFO = {"/twin/camera/camera_info": ("sensor_msgs/msg/CameraInfo", FRAMES)}
EXTRA: dict[Level, dict[str, tuple[str, int]]] = {
    "telemetry": {},
    "compressed": INFO | {"/twin/camera/image_raw/compressed": ("sensor_msgs/msg/CompressedImage", FRAMES)},
    "raw": INFO | {"/twin/camera/image_raw": ("sensor_msgs/msg/Image", FRAMES)},
}


def read_all(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([folder]) as reader:  # the strict typestore: schemas in the file, hashes compared
        for connection, stamp, raw in reader.messages():
            found.setdefault(connection.topic, []).append((stamp, reader.deserialize(raw, connection.msgtype)))
    return found


@pytest.mark.parametrize("level", LEVELS)
def test_rosbags_reads_every_value(bags: Path, run: RunRecord, level: Level) -> None:
    with AnyReader([bags / level]) as reader:
        counts = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        jazzy = get_typestore(Stores.ROS2_JAZZY)
        for connection in reader.connections:
            if connection.msgtype in jazzy.fielddefs:
                assert connection.digest == jazzy.hash_rihs01(connection.msgtype)
    assert counts == ALWAYS | EXTRA[level]
    messages = read_all(bags / level)
    for (stamp, state), seen in zip(messages["/twin/state"], run.observations, strict=True):
        assert stamp == state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == 10**9 + seen.step * 50_000_000
        vehicle = seen.vehicle
        assert (state.step, state.x, state.y, state.yaw) == (seen.step, vehicle.x, vehicle.y, vehicle.yaw)
        assert state.lateral_position == seen.lane.lateral_position
    for (_, drive), command in zip(messages["/twin/drive"], run.commands, strict=True):
        assert (drive.steering, drive.throttle) == (command.steering, command.throttle)
    assert messages["/twin/outcome"][0][1].value == int(Outcome.CANCELLED)
    assert [(p.x, p.y) for p in messages["/twin/road"][0][1].control_points] == list(run.road.control_points)


def test_images_are_those_that_the_driver_saw(bags: Path, run: RunRecord) -> None:
    images = [seen.image for seen in resimulate(DONKEY, run)]
    raw = read_all(bags / "raw")["/twin/camera/image_raw"]
    compressed = read_all(bags / "compressed")["/twin/camera/image_raw/compressed"]
    for image, (_, kept), (_, jpeg) in zip(images, raw, compressed, strict=True):
        assert (kept.encoding, kept.step, kept.header.frame_id) == ("rgb8", 960, "twin/camera_optical")
        assert kept.data.tobytes() == image.tobytes()
        assert "jpeg" in jpeg.format and jpeg.header.frame_id == "twin/camera_optical"
        assert jpeg.header.stamp.nanosec == kept.header.stamp.nanosec
        decoded = cv2.cvtColor(cv2.imdecode(jpeg.data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        assert cv2.PSNR(decoded, image) > 32.0


def test_transforms_and_camera_info_put_the_road_where_the_camera_draws_it() -> None:
    """With roll and pitch: the chain of transforms against the pose with which the camera renders."""
    spec = make_simulator("donkey").spec
    vehicle = VehicleState(
        x=31.0, y=-7.0, yaw=2.1, speed=0.0, yaw_rate=0.0, steering_angle=0.0, roll=0.05, pitch=-0.08, heave=0.03
    )
    make = message_builder("/twin")
    body = make.body_transform(vehicle, make.stamp(0)).transforms[0]
    camera = make.camera_transform(spec.camera, make.stamp(0)).transforms[0]
    assert (body.header.frame_id, body.child_frame_id) == ("road", camera.header.frame_id)

    def matrix(stamped: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
        place, turn = stamped.transform.translation, stamped.transform.rotation
        made = np.eye(4)
        made[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        made[:3, 3] = (place.x, place.y, place.z)
        return made

    chain = matrix(body) @ matrix(camera)
    axes, position = (np.array(v) for v in optical_axes(spec.camera, vehicle))
    np.testing.assert_allclose(chain[:3, :3].T, axes, atol=1e-12)
    np.testing.assert_allclose(chain[:3, 3], position, atol=1e-12)


def test_messages_are_those_of_the_graph_byte_for_byte(run: RunRecord) -> None:
    """Messages of the graph serialised by rclpy, against the bag's writer, which works without ROS."""
    pytest.importorskip("rclpy")
    from rclpy.serialization import serialize_message

    from ds_sim.ros import conversions

    spec, seen, store = make_simulator("donkey").spec, run.observations[17], typestore()
    pixels = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)

    def made(make: MessageBuilder) -> list[Any]:
        stamp, header, camera = make.stamp(850_000_000), make.header(850_000_000, "road"), make.camera_frame
        return [
            make.state(seen, header, run.road.road_id),
            make.command(run.commands[17], header),
            make.odometry(seen.vehicle, stamp),
            make.camera_info(spec.camera, make.header(850_000_000, camera)),
            make.image(pixels, make.header(850_000_000, camera)),
            make.compressed_image(pixels, make.header(850_000_000, camera)),
            make.road_markers(run.road, spec.look, stamp),
            make.road(run.road),
        ]

    for theirs, ours in zip(made(conversions.message_builder("/twin")), made(message_builder("/twin")), strict=True):
        kind = ours.__msgtype__
        # rclpy leaves arbitrary padding bytes between fields; they are zero after rewriting.
        again = store.deserialize_cdr(serialize_message(theirs), kind)
        assert bytes(store.serialize_cdr(again, kind)) == bytes(store.serialize_cdr(ours, kind)), kind


def test_a_bag_describes_its_run(bags: Path, run: RunRecord) -> None:
    with BagReader(bags / "telemetry") as bag:
        recorded = read_run(bag)
    found = recorded.run
    assert (found.road, found.seed, found.commands) == (run.road, run.seed, run.commands)
    assert (found.outcome, found.message) == (run.outcome, run.message)
    ours, theirs = ([(one.step, one.time, one.vehicle, one.lane) for one in of.observations] for of in (found, run))
    assert ours == theirs
    assert (recorded.simulator, recorded.driver, recorded.namespace) == ("donkey", "autopilot", "/twin")
    document = describe(bags / "raw")
    facts = document["facts"]
    assert json.loads(facts["road"]) == [list(point) for point in run.road.control_points]
    assert (facts["seed"], facts["outcome"], facts["steps"]) == ("3", "CANCELLED", "40")
    assert float(facts["fitness"]) == run.fitness and facts["version.numpy"] == np.__version__
    words = "\n".join(info_in_words(document))
    assert "autopilot drove on donkey: cancelled after 40 frames (that is enough)" in words
    assert f"Road {run.road.road_id}, seed 3, level raw" in words


def test_the_same_run_gives_the_same_bytes_and_replaces_its_bag(bags: Path, run: RunRecord, tmp_path: Path) -> None:
    for _ in range(2):
        write_bag(tmp_path / "telemetry", "/twin", DONKEY, run, {"driver": "autopilot"})
        assert sorted(p.name for p in tmp_path.iterdir()) == ["telemetry"]
        for name in ("telemetry.mcap", "metadata.yaml"):
            assert (tmp_path / "telemetry" / name).read_bytes() == (bags / "telemetry" / name).read_bytes()


def test_images_of_a_run_that_does_not_come_out_the_same_are_refused(run: RunRecord, tmp_path: Path) -> None:
    with pytest.raises(ResimulationError, match="at step 1, "):
        write_bag(tmp_path / "bag", "/twin", SOFTBODY, run, {}, "raw")
    assert not (tmp_path / "bag").exists()


def test_what_is_no_bag_is_reported_in_one_line(bags: Path, tmp_path: Path) -> None:
    for name in ("cut", "damaged"):
        shutil.copytree(bags / "telemetry", tmp_path / name)
    file = tmp_path / "cut" / "telemetry.mcap"
    file.write_bytes(file.read_bytes()[:2000])
    (tmp_path / "damaged" / "metadata.yaml").write_text("{")
    reasons = {"none": "no such bag", ".": "with metadata.yaml", "cut": "ds bag recover", "damaged": "cannot be read"}
    for name, reason in reasons.items():
        with pytest.raises(BagError, match=reason):
            describe(tmp_path / name)


def test_the_file_repeats_the_metadata_of_its_folder(bags: Path, tmp_path: Path) -> None:
    facts = {"message": "words " * 60, "road": "[1, 2], " * 90, "é: -": "a\nb", "number": "1", "": ""}
    with Rosbag2Writer(tmp_path / "empty", {}) as writer:
        writer.close(facts)
    for folder in (bags / "compressed", tmp_path / "empty"):
        outside = yaml.safe_load((folder / "metadata.yaml").read_text())
        with (folder / f"{folder.name}.mcap").open("rb") as file:
            (record,) = (record for record in make_reader(file).iter_metadata() if record.name == "rosbag2")
        assert outside == {"rosbag2_bagfile_information": yaml.safe_load(record.metadata["serialized_metadata"])}
    assert outside["rosbag2_bagfile_information"]["custom_data"] == facts
