# SPDX-License-Identifier: Apache-2.0
"""The Donkey protocol: framing, one telemetry per control, runs equal to the simulator's own, misbehaving clients."""

from __future__ import annotations

import asyncio
import base64
import json
import logging
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ds_base.processes import python_environment
from ds_base.progress import LOGGER, lines_to
from ds_driver import drive_road, make_driver
from ds_road import Road, generate, road_to_json
from ds_sim import Scenario, SimulatorName, make_simulator
from ds_sim.donkey_protocol.messages import (
    LARGEST_MESSAGE,
    ImageFormat,
    MessageSplitter,
    ProtocolError,
    command_of,
    image_format_of,
)
from ds_sim.donkey_protocol.server import Conversation, DonkeyServer
from ds_sim.simulator import Outcome
from ds_sim.testing import STRAIGHT

ROAD = generate(np.random.default_rng(21), max_angle=120)
OWN_PIXELS = {"msg_type": "cam_config", "img_w": "320", "img_h": "160", "img_d": "3", "img_enc": "PNG", "fov": "0"}


class Client:
    """Sends messages as gym-donkeycar does, without anything between them, and reads lines."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=30)
        self.lines = self.socket.makefile("rb")
        self.greeting = self.read()

    def send(self, *messages: dict[str, Any]) -> None:
        self.socket.sendall(b"".join(json.dumps(m).encode() for m in messages))

    def read(self) -> dict[str, Any]:
        line = self.lines.readline()
        if not line:
            raise EOFError
        message: dict[str, Any] = json.loads(line)
        return message

    def load(self) -> dict[str, Any]:
        self.send({"msg_type": "load_scene", "scene_name": "generated_road"})
        assert self.read() == {"msg_type": "car_loaded"}
        return self.read()

    def control(self, steering: float, throttle: float, brake: float = 0.0) -> dict[str, Any]:
        self.send(control(steering, throttle, brake))
        return self.read()

    def close(self) -> None:
        self.lines.close()
        self.socket.close()


def control(steering: float, throttle: float, brake: float = 0.0) -> dict[str, Any]:
    return {"msg_type": "control", "steering": str(steering), "throttle": str(throttle), "brake": str(brake)}


def pixels(message: dict[str, Any]) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(message["image"]), np.uint8)
    return cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


@contextmanager
def served(*roads: Road, sim: str = "bullet", **options: Any) -> Iterator[tuple[int, list[str]]]:
    """A server in a thread: its port, and the lines that it reports."""
    lines: list[str] = []
    ready = threading.Event()
    found: list[Any] = []

    async def main() -> None:
        found.extend((asyncio.get_running_loop(), asyncio.current_task()))
        tests = [Scenario(road, seed=5) for road in roads or (ROAD,)]

        def listening(port: int) -> None:
            found.append(port)
            ready.set()

        with suppress(asyncio.CancelledError):
            await DonkeyServer(SimulatorName(sim), tests, **{"greeting_delay": 0.0, **options}).serve(
                "127.0.0.1", 0, listening
            )

    thread = threading.Thread(target=asyncio.run, args=(main(),))
    thread.start()
    try:
        assert ready.wait(60)
        with lines_to(lines.append):
            yield found[2], lines
    finally:
        found[0].call_soon_threadsafe(found[1].cancel)
        thread.join(30)
        assert not thread.is_alive()


texts = st.text(alphabet='{}"\\ é', max_size=6)


@settings(deadline=None)  # a busy machine is slow
@given(st.lists(texts, max_size=3), st.sampled_from(["", "\n", " \r\n"]), st.lists(st.integers(1, 30), max_size=8))
def test_messages_come_out_whole_however_they_are_cut(values: list[str], separator: str, lengths: list[int]) -> None:
    sent = [{"msg_type": "control", "value": value, "inner": {value: [value]}} for value in values]
    stream = "".join(json.dumps(message, ensure_ascii=False) + separator for message in sent).encode()
    splitter, got = MessageSplitter(), []
    for length in lengths:
        got += splitter.feed(stream[:length])
        stream = stream[length:]
    assert got + splitter.feed(stream) == sent


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"GET / HTTP/1.1\r\n", "begins with 'G'"),
        (b"[1]", "begins with '\\['"),
        (b'{"msg_type": "a"}}', "begins with '}'"),
        (b"{}", "no msg_type"),
        (b'{"msg_type": 3}', "no msg_type"),
        (b'{"msg_type": }', "not JSON"),
        (b'{"msg_type": "\xff"}', "not JSON"),
        (b"{" * 5000 + b"}" * 5000, "not JSON"),
        (b'{"a": "' + b"x" * LARGEST_MESSAGE, "more than 65536 bytes"),
    ],
)
def test_what_is_no_message_is_refused_in_one_line(data: bytes, words: str) -> None:
    with pytest.raises(ProtocolError, match=words) as problem:
        MessageSplitter().feed(data)
    assert "\n" not in str(problem.value)


def test_controls_are_clipped_and_the_brake_takes_the_throttle() -> None:
    assert (command_of(control(-3.0, 2.0))[0].steering, command_of(control(-3.0, 2.0))[0].throttle) == (-1.0, 1.0)
    assert command_of({"msg_type": "control", "steering": 0.25, "throttle": -1})[0].throttle == 0.0  # numbers, no brake
    command, brake = command_of(control(0.0, 0.7, 0.2))
    assert (command.throttle, brake) == (0.0, 0.2)
    values: list[Any] = ["nan", "inf", "", "left", None, True, [], "9" * 400]
    for value in values:
        with pytest.raises(ProtocolError, match="control: steering is .*, expected a number"):
            command_of({"msg_type": "control", "steering": value, "throttle": "0"})


def test_zeros_keep_the_image_format() -> None:
    zeros = {"msg_type": "cam_config", "img_w": "0", "img_h": "0", "img_d": "0", "img_enc": "0"}
    kept = ImageFormat(width=64, height=32, encoding="PNG", grey=True)
    assert image_format_of(zeros, kept) == kept
    for field, value in (("img_w", "5000"), ("img_h", "1.5"), ("img_d", "2"), ("img_enc", "GIF"), ("img_w", "-1")):
        with pytest.raises(ProtocolError, match=f"{field} is"):
            image_format_of({"msg_type": "cam_config", field: value}, kept)


def test_a_client_drives_the_simulators_own_run_bit_by_bit(tmp_path: Path) -> None:
    car = tmp_path / "car.yaml"
    car.write_text("format: ds_twin_donkey parameters 1\nparameters: {friction: {value: 0.8}}\n")
    simulator = make_simulator(f"donkey@{car}")
    run = drive_road(simulator, make_driver("autopilot", simulator.spec), ROAD, 5)
    frame = simulator.load(ROAD, seed=5)
    with served(sim=f"donkey@{car}") as (port, lines):
        client = Client(port)
        assert client.greeting["msg_type"] == "scene_selection_ready"
        client.send({"msg_type": "get_scene_names"}, {"msg_type": "get_protocol_version"})
        assert client.read()["scene_names"] == ["generated_road"] and client.read()["version"] == "2"
        first = client.load()
        assert pixels(first).shape == (120, 160, 3) and first["hit"] == "none"
        client.send(OWN_PIXELS)
        assert np.array_equal(pixels(client.control(0.0, 0.5, 1.0)), frame.image)  # held by the brake
        for index, command in enumerate(run.commands):
            seen, expected = client.control(command.steering, command.throttle), run.observations[index + 1]
            assert seen["time"] == expected.time and seen["cte"] == expected.lane.lateral_position
            if index < 40:
                assert np.array_equal(pixels(seen), simulator.step(command).image)
            elif index == 40:  # the other images need not be
                client.send({**OWN_PIXELS, "img_w": "32", "img_h": "16"})
        assert run.outcome is Outcome.COMPLETED and seen["hit"] == "completed"
        assert client.control(1.0, 1.0) == seen  # the run is over
        client.close()
    simulator.close()
    assert f"client 1: {ROAD.road_id}: COMPLETED after {run.steps} frames" in lines


def test_axes_are_unitys() -> None:
    """Positions move along the yaw, clockwise from z; the velocity is the vehicle's own; right is positive."""
    with served(STRAIGHT) as (port, _):
        client = Client(port)
        seen = before = client.load()
        for _ in range(60):
            before, seen = seen, client.control(0.2, 0.6)
        moved = np.array([seen[k] - before[k] for k in ("pos_x", "pos_z")]) * 20.0
        yaw = np.radians(seen["yaw"])
        forward, right = np.array([np.sin(yaw), np.cos(yaw)]), np.array([np.cos(yaw), -np.sin(yaw)])
        assert 5.0 < seen["yaw"] < 90.0 and seen["cte"] > 0.1  # the road runs along z; steered to the right
        assert moved @ forward == pytest.approx(seen["vel_z"], rel=0.05)
        assert moved @ right == pytest.approx(seen["vel_x"], abs=0.2)
        client.close()


def test_a_reset_before_the_car_moved_keeps_the_road_and_later_ones_go_on() -> None:
    simulator = make_simulator("bullet")
    talk = Conversation(simulator, [Scenario(ROAD, seed=0), Scenario(STRAIGHT, seed=0)])
    start = talk.answer({"msg_type": "load_scene", "scene_name": "generated_road"})[1]
    drive, reset, hold = control(0.0, 1.0), {"msg_type": "reset_car"}, control(0.0, 0.0, 1.0)
    assert talk.answer(reset) == [] and talk.answer(hold)[0] == start
    talk.answer(drive)
    assert talk.answer(reset) == []
    (second,) = talk.answer(hold)
    assert (second["pos_x"], second["pos_z"]) == pytest.approx((127.0, 25.0), abs=0.1) and second["time"] == 0.0
    talk.answer(drive)
    talk.answer(reset)
    assert talk.answer(hold)[0] == start
    assert talk.answer({"msg_type": "exit_scene"})[0]["msg_type"] == "scene_selection_ready"
    with pytest.raises(ProtocolError, match="control before a scene"):
        talk.answer(drive)
    with pytest.raises(ProtocolError, match="there is no scene 'warehouse': expected generated_road"):
        talk.answer({"msg_type": "load_scene", "scene_name": "warehouse"})
    simulator.close()


def test_images_are_scaled_and_grey_and_what_has_no_effect_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, LOGGER)
    simulator = make_simulator("bullet")
    talk = Conversation(simulator, [Scenario(ROAD, seed=0)])
    talk.answer({"msg_type": "load_scene", "scene_name": "generated_road"})
    for _ in range(2):
        talk.answer({**OWN_PIXELS, "img_w": "80", "img_h": "40", "img_d": "1", "fov": "50"})
        talk.answer({"msg_type": "lidar_config"})
        talk.answer({"msg_type": "car_config"})
    image = pixels(talk.answer(control(0.0, 0.0, 1.0))[0])
    expected = simulator.load(ROAD, seed=0).image.reshape(40, 4, 80, 4, 3).mean(axis=(1, 3)) @ [0.2126, 0.7152, 0.0722]
    assert image.shape == (40, 80, 3) and np.ptp(image, axis=2).max() == 0
    assert np.abs(image[..., 0] - expected).max() <= 1.0
    lines = caplog.messages
    assert len(lines) == 2 and "fov left as they are" in lines[0] and "'lidar_config' has no effect" in lines[1]
    simulator.close()


def test_misbehaving_clients_end_their_own_session_only() -> None:
    def drive(port: int, disturb: bool) -> list[str]:
        good = Client(port)
        good.load()
        images = []
        for step in range(30):
            if disturb and step == 5:
                malformed.send({"msg_type": "control", "steering": "nan", "throttle": "0"})
                assert "steering is 'nan'" in malformed.read()["message"]
                with pytest.raises((EOFError, ConnectionError)):
                    malformed.read()
            if disturb and step == 10:  # vanish with a reset instead of a farewell, in the middle of a message
                vanishing.socket.sendall(b'{"msg_type": "con')
                vanishing.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                vanishing.close()
            if disturb and step == 15:  # ask for hundreds of images and read none
                deaf.socket.settimeout(0.2)
                with pytest.raises(TimeoutError):
                    deaf.send(*[control(0.0, 0.1)] * 200_000)
            images.append(good.control(0.1, 0.5)["image"])
        good.close()
        return images

    with served() as (port, lines):
        malformed, vanishing, deaf = Client(port), Client(port), Client(port)
        for client in (malformed, vanishing, deaf):
            client.load()
        disturbed = drive(port, True)
        deaf.close()
        assert drive(port, False) == disturbed
    assert any("steering is 'nan'" in line for line in lines)


def test_one_client_too_many_is_refused_and_a_silent_one_makes_room() -> None:
    with served(most_clients=1, patience=1.0) as (port, _):
        silent, second = Client(port), Client(port)
        assert second.greeting == {"msg_type": "error", "message": "refused, as 1 clients are connected"}
        assert silent.read()["message"] == "silent for 1 s"
        assert Client(port).load()["msg_type"] == "telemetry"


def test_a_client_that_drips_bytes_is_disconnected_like_a_silent_one() -> None:
    with served(most_clients=1, patience=1.0) as (port, _):
        slow = Client(port)

        def drip() -> None:
            for byte in b'{"msg_type": "control", "note": "' + b"x" * 200:
                slow.socket.sendall(bytes([byte]))
                time.sleep(0.1)

        with pytest.raises(ConnectionError):
            drip()
        assert Client(port).load()["msg_type"] == "telemetry"


def test_slow_clients_give_their_places_to_a_new_one() -> None:
    with served(most_clients=2, yields_after=1.0) as (port, lines):
        slow, busy = Client(port), Client(port)
        busy.load()
        for _ in range(12):
            time.sleep(0.1)
            slow.socket.sendall(b" ")
            busy.control(0.0, 0.1)
        assert Client(port).load()["msg_type"] == "telemetry"
        assert slow.read() == {"msg_type": "error", "message": "a new client takes the place"}
        assert busy.control(0.0, 0.1)["msg_type"] == "telemetry"
    assert not any("failed" in line for line in lines)


def serve(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "ds_cli.main", "serve", "donkey", *arguments]
    environment = python_environment()
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def test_the_command_serves_until_stopped_and_refuses_a_port_in_use(tmp_path: Path) -> None:
    roads = tmp_path / "roads.json"
    roads.write_text(json.dumps([road_to_json(STRAIGHT)]))
    server = serve("--sim", "softbody", "--port", "0", "--road", str(roads))
    assert server.stdout is not None
    line = server.stdout.readline()
    assert line.startswith("serving softbody on 127.0.0.1:")
    port = line.rpartition(":")[2].strip()
    client = Client(int(port))
    assert client.load()["pos_x"] == pytest.approx(127.0, abs=0.1)
    other = serve("--port", port)
    assert other.communicate(timeout=60)[1].strip() == (
        f"error: port {port} of 127.0.0.1 is in use: choose another with --port, or 0 for any free one"
    )
    assert other.returncode == 2
    server.send_signal(signal.SIGTERM)
    _, log = server.communicate(timeout=30)
    assert server.returncode == 143 and log.splitlines() == [
        "next: ds drive --sim softbody --driver autopilot",
        "client 1: connected",
        "client 1: disconnected: the server stops",
        "stopped",
    ]
