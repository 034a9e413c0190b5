# SPDX-License-Identifier: Apache-2.0
"""Open-loop evaluation on recordings of any origin: no image is lost, and the errors are correct."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from foreign_bags import foreign_bag
from rosbags.rosbag2 import StoragePlugin
from scipy.stats import wasserstein_distance
from tests.command_line import ds
from tubs import write_tub

from ds_analysis.paper.open_loop import evaluate_recording
from ds_analysis.paper.steering_error_stats import EDGES, density, distances, pooled_errors, summarise
from ds_bags.donkey_tub import TubError, read_tub
from ds_bags.layout import BagError
from ds_bags.reader import BagReader
from ds_driver.closed_loop.simulation import make_driver
from ds_driver.data.recordings import Reading, RecordedFrame, open_recording
from ds_driver.networks.images import Crop, ImageError, fit_to_network, rgb_of, rgb_of_file
from ds_driver.networks.network_driver import NetworkDriver
from ds_sim.registry import DONKEY, make_simulator
from ds_sim.session import RunRecord, resimulate

RNG = np.random.default_rng(1)
PICTURE = RNG.integers(0, 255, (30, 40, 3), dtype=np.uint8)


def brightness(frame: RecordedFrame, crop: Crop) -> float:
    """Answer with a steering that is easy to compute by hand."""
    assert frame.image is not None and frame.image.shape == (160, 320, 3)
    return float(frame.image.mean()) / 255.0


@pytest.fixture
def tub(tmp_path: Path) -> Path:
    """Five records of 160 x 120: the third deleted by its user, the fourth by the pilot, the fifth's image missing."""
    (tmp_path / "tub/images").mkdir(parents=True)
    for index in range(4):
        cv2.imwrite(str(tmp_path / f"tub/images/{index}.png"), np.full((120, 160, 3), 50 * index, np.uint8))
    by_user = {"user/throttle": 0.5, "user/mode": "user"}
    rows = [{"cam/image_array": f"{index}.png", "user/angle": 0.1 * index, **by_user} for index in range(5)]
    rows[3] |= {"user/mode": "local", "pilot/angle": -0.7, "pilot/throttle": 0.2}
    return write_tub(tmp_path / "tub", rows, deleted=[2])


def test_a_tub_is_read_with_its_sign_and_without_what_was_deleted(tub: Path) -> None:
    records = read_tub(tub).records
    assert [(r.index, r.steering, r.throttle) for r in records] == [
        (0, 0.0, 0.5),
        (1, 0.1, 0.5),
        (3, -0.7, 0.2),
        (4, 0.4, 0.5),
    ]
    (tub / "manifest.json").write_text("[]")
    with pytest.raises(TubError, match="not a tub of version 2"):
        read_tub(tub)


def test_no_image_of_a_tub_is_lost_and_a_missing_one_is_reported(tub: Path) -> None:
    answers = evaluate_recording(open_recording(tub, Reading()), brightness)
    assert answers.index.tolist() == [0, 1, 3] and answers.images == 4
    np.testing.assert_allclose(answers.errors, [0.0, 50 / 255 - 0.1, 150 / 255 + 0.7], atol=0.003)
    assert len(answers.trouble) == 1 and "4.png" in answers.trouble[0]
    assert answers.worst[0][0].index == 3


def test_a_network_answers_a_raw_bag_as_it_answered_in_the_loop(bags: Path, run: RunRecord) -> None:
    """Bit by bit for raw images; the autopilot's own answers are what the bag recorded."""
    driver = make_driver("dave2", make_simulator("donkey").spec)
    expected = [driver(seen).steering for seen in resimulate(DONKEY, run)]
    network = NetworkDriver("dave2")
    for truth in ("recorded", "autopilot"):
        recording = open_recording(bags / "raw", Reading(truth=truth))  # type: ignore[arg-type]
        answers = evaluate_recording(recording, lambda frame, crop: network.command(frame.seen(crop)).steering)
        assert answers.answered.tolist() == expected and answers.group == "donkey"
        told = [command.steering for command in run.commands]
        assert answers.recorded[:40].tolist() == told
        assert np.isfinite(answers.recorded[40]) == (truth == "autopilot")


@pytest.fixture(params=["Image", "CompressedImage"])
def foreign(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A real car's bag by another writer, in SQLite: a camera, and a command of an unknown type."""
    types = {"Wheel": "float32 angle", "Cmd": "std_msgs/Header header\ncar/Wheel wheel"}
    with foreign_bag(tmp_path / "car", StoragePlugin.SQLITE3, **types) as bag:
        for number in range(6):
            time = 10**9 + number * 200_000_000
            grey = np.full((48, 64, 3), 40 * number, np.uint8)
            message = bag.image(time, grey, "bgr8")
            if request.param == "CompressedImage":
                data = cv2.imencode(".jpg", grey)[1].reshape(-1)
                message = bag.make("sensor_msgs/CompressedImage", header=message.header, format="jpeg", data=data)
            bag.write("/cam", time, message)
            # The command comes 20 ms after the image, and there is none after the fourth image.
            if number < 4:
                wheel = bag.make("car/Wheel", angle=-0.1 * number)
                time += 20_000_000
                bag.write("/cmd", time, bag.make("car/Cmd", header=bag.header(time), wheel=wheel))
    return tmp_path / "car"


def test_a_foreign_bag_with_steering_from_any_field(foreign: Path) -> None:
    reading = Reading(steering="/cmd:wheel.angle", factor=-2.0)
    answers = evaluate_recording(open_recording(foreign, reading), brightness)
    np.testing.assert_allclose(answers.seconds, np.arange(6) * 0.2)
    np.testing.assert_allclose(answers.recorded[:4], [0.0, 0.2, 0.4, 0.6], atol=1e-6)
    assert np.isnan(answers.recorded[4:]).all() and np.isfinite(answers.answered).all()
    np.testing.assert_allclose(answers.errors, np.arange(4) * (40 / 255 - 0.2), atol=0.006)
    summary = summarise([answers])[0]
    assert (summary.group, summary.images, summary.answered, summary.compared) == ("car", 6, 6, 4)
    for wrong, said in (("/cmd", "expected TOPIC:FIELD"), ("/no:x", "/cam, /cmd"), ("/cmd:wheel", "no number 'wheel'")):
        with pytest.raises(BagError, match=said):
            evaluate_recording(open_recording(foreign, Reading(steering=wrong)), brightness)
    with pytest.raises(BagError, match="no images of topic /other"):
        open_recording(foreign, Reading(camera="/other"))


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_file_without_metadata_is_a_bag_of_its_own(tmp_path: Path, plugin: StoragePlugin) -> None:
    """So is the only one of a folder; and one that was indexed again names no storage."""
    with foreign_bag(tmp_path / "car", plugin) as bag:
        for index in range(5):
            bag.write("/speed", index * 10**9, bag.make("std_msgs/Float64", data=float(index)))
    metadata = tmp_path / "car" / "metadata.yaml"
    text = metadata.read_text()
    named = "mcap" if plugin is StoragePlugin.MCAP else "sqlite3"
    assert f"storage_identifier: {named}" in text
    metadata.write_text(text.replace(f"storage_identifier: {named}", "storage_identifier: ''"))

    def numbers(path: Path) -> list[float]:
        with BagReader(path) as reader:
            return [message.data for _, _, message in reader.decoded(reader.connections)]

    assert numbers(tmp_path / "car") == [0.0, 1.0, 2.0, 3.0, 4.0]
    metadata.unlink()
    (file,) = (tmp_path / "car").iterdir()
    for path in (tmp_path / "car", file):
        assert numbers(path) == [0.0, 1.0, 2.0, 3.0, 4.0]
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(BagError, match=f"{file.name}.* cannot be read"):
        numbers(tmp_path / "car")


def test_a_bag_without_images_says_what_to_do(bags: Path) -> None:
    with pytest.raises(BagError, match="--level compressed or raw"):
        open_recording(bags / "telemetry", Reading())


@pytest.mark.parametrize(
    ("encoding", "code"),
    [
        ("rgb8", None),
        ("bgr8", "COLOR_RGB2BGR"),
        ("rgba8", "COLOR_RGB2RGBA"),
        ("bgra8", "COLOR_RGB2BGRA"),
        ("yuv422", "COLOR_RGB2YUV_UYVY"),
        ("yuv422_yuy2", "COLOR_RGB2YUV_YUY2"),
    ],
)
def test_encodings_against_opencv_s_conversion_the_other_way(encoding: str, code: str | None) -> None:
    """Rows are padded, as by some drivers; subsampled YUV is compared on an image with one colour per row."""
    picture = PICTURE if "yuv" not in encoding else np.repeat(PICTURE[:, :1], 40, axis=1)
    if code is not None and not hasattr(cv2, code):
        pytest.skip("OpenCV 4.8 converts to no subsampled YUV")
    raw = picture if code is None else np.asarray(cv2.cvtColor(picture, getattr(cv2, code)))
    rows = raw.reshape(30, -1)
    padded = np.hstack((rows, np.zeros((30, 7), np.uint8))).reshape(-1)
    back = rgb_of(padded, encoding=encoding, height=30, width=40, step=rows.shape[1] + 7)
    assert np.abs(back.astype(int) - picture).max() <= (3 if "yuv" in encoding else 0)


BAYER = {"rggb": "RGGB", "bggr": "BGGR", "gbrg": "GBRG", "grbg": "GRBG"}


@pytest.mark.parametrize("pattern", BAYER)
@pytest.mark.parametrize("bits", [8, 16])
def test_a_colour_behind_a_bayer_pattern_is_that_colour(pattern: str, bits: int) -> None:
    colour = {"R": 200, "G": 110, "B": 40}
    tile = np.array([colour[letter] for letter in pattern.upper()]).reshape(2, 2)
    mosaic = np.tile(tile, (15, 20)).astype(np.uint16)
    raw = mosaic.astype(np.uint8) if bits == 8 else mosaic << 8
    for order, big in (("<u2", False), (">u2", True)):
        data = np.frombuffer(raw.tobytes() if bits == 8 else raw.astype(order).tobytes(), np.uint8)
        back = rgb_of(data, encoding=f"bayer_{pattern}{bits}", height=30, width=40, step=0, big_endian=big)
        assert (back[2:-2, 2:-2] == (200, 110, 40)).all()


@pytest.mark.parametrize(("encoding", "order"), [("nv12", (0, 1)), ("nv21", (1, 0))])
def test_planes_of_brightness_and_colour_are_read(encoding: str, order: tuple[int, int]) -> None:
    """Rows of the camera's driver are padded to 48 bytes."""
    bt601 = np.array([[0.257, 0.504, 0.098], [-0.148, -0.291, 0.439], [0.439, -0.368, -0.071]])
    y, u, v = np.round(bt601 @ (200, 110, 40) + (16, 128, 128)).astype(np.uint8)
    planes = np.zeros((45, 48), np.uint8)
    planes[:30, :40] = y
    planes[30:, :40] = np.tile(np.array([u, v])[list(order)], 20)
    back = rgb_of(planes.reshape(-1), encoding=encoding, height=30, width=40, step=48)
    assert back.shape == (30, 40, 3) and np.abs(back.astype(int) - (200, 110, 40)).max() <= 4
    with pytest.raises(ImageError, match="nv12 needs an even width and height"):
        rgb_of(planes.reshape(-1), encoding="nv12", height=29, width=40, step=48)


def test_of_sixteen_bits_the_upper_eight_count() -> None:
    grey = (np.arange(1200, dtype=np.uint16) * 50).reshape(30, 40)
    back = rgb_of(np.frombuffer(grey.tobytes(), np.uint8), encoding="16UC1", height=30, width=40, step=80)
    assert np.array_equal(back[..., 1], grey >> 8)


def test_grey_and_invalid_images() -> None:
    grey = np.ascontiguousarray(PICTURE[..., 0])
    back = rgb_of(grey.reshape(-1), encoding="mono8", height=30, width=40, step=40)
    assert all(np.array_equal(back[..., channel], grey) for channel in range(3))
    with pytest.raises(ImageError, match="encoding '32FC1'"):
        rgb_of(grey.reshape(-1), encoding="32FC1", height=30, width=40, step=40)
    with pytest.raises(ImageError, match="does not fit"):
        rgb_of(grey.reshape(-1), encoding="rgb8", height=30, width=40, step=120)
    with pytest.raises(ImageError, match="yuyv needs an even width"):
        rgb_of(np.zeros(4 * 10, np.uint8), encoding="yuyv", height=4, width=5, step=10)
    with pytest.raises(ImageError, match="damaged"):
        rgb_of_file(b"no picture")


def test_an_image_is_cut_to_two_to_one_at_its_top_or_its_sides() -> None:
    tall = np.zeros((120, 160, 3), np.uint8)
    tall[40:] = 200
    assert (fit_to_network(tall) == 200).all()
    assert (fit_to_network(tall, (0, 40)) == 0).all()
    wide = np.zeros((100, 400, 3), np.uint8)
    wide[:, 100:300] = 90
    assert (fit_to_network(wide) == 90).all()
    with pytest.raises(ImageError, match="expected 0 to 120"):
        fit_to_network(tall, (10, 121))


def test_density_and_distance_against_scipy(tub: Path) -> None:
    errors = RNG.normal(0.1, 0.2, 500)
    assert float((density(errors) * np.diff(EDGES)).sum()) == pytest.approx(1.0)
    moved = {"a": errors, "b": errors + 0.25}
    [(one, other, apart)] = distances(moved)
    assert (one, other) == ("a", "b") and apart == pytest.approx(0.25)
    answers = evaluate_recording(open_recording(tub, Reading()), brightness)
    summary = summarise([answers, answers])[0]
    both = pooled_errors([answers, answers])["tub"]
    assert summary.compared == 6 and summary.mean_absolute == pytest.approx(np.abs(both).mean())
    expected = wasserstein_distance(answers.answered, answers.recorded)
    assert summary.outputs_apart == pytest.approx(expected)


@pytest.mark.graph
def test_the_command_writes_table_picture_and_rows(bags: Path, tub: Path, tmp_path: Path) -> None:
    done = ds("bag", "drive", bags / "compressed", tub, "--driver", "dave2", "--out", tmp_path / "out", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert [(g["group"], g["images"], g["compared"]) for g in document["groups"]] == [("donkey", 41, 40), ("tub", 4, 3)]
    assert len(document["distances"]) == 1 and "4.png" in done.stderr
    with (tmp_path / "out" / "answers.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 44 and rows[40]["recorded"] == "" and rows[40]["answered"]
    picture = cv2.imread(document["picture"])
    assert picture is not None and picture.shape[1] == 1140
