# SPDX-License-Identifier: Apache-2.0
"""Pseudo-real images: networks as published, training that resumes, lines that are found, crops, translations."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from made_networks import TINY, write_generator, write_recorded
from numpy.typing import NDArray
from progress_lines import ProgressLines

from ds_bags.layout import Level
from ds_bags.run_writer import write_bag
from ds_base.progress import SILENT
from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.data.dataset import crops_of, decode, drive_path, read_samples
from ds_driver.data.recordings import Reading, open_recording
from ds_driver.networks.backends import cpu_capabilities
from ds_driver.networks.images import Crop
from ds_driver.networks.onnx_export import OnnxGraph, generator_to_onnx
from ds_driver.networks.pilot import DriverError
from ds_driver.sim2real.generator import GeneratorShape, Sim2RealError, Window, generator_input, load_generator
from ds_driver.sim2real.image_translation import Translator, open_set
from ds_driver.sim2real.lane_pairs import HEIGHTS, NEIGHBOURS, LanePairs, align_lane, lane_shapes, pair_lanes
from ds_driver.sim2real.lane_view import BOUND, Match, find_lines, lane_difference, match_windows, measure_lane
from ds_driver.sim2real.networks import Discriminator, Generator, ImagePool, InstanceNorm, to_batch, to_images
from ds_driver.sim2real.preparation import (
    FRAMES,
    Domains,
    check_roads_are_new,
    make_domains,
    network_window,
    prepare_domains,
    read_photographs,
    read_sources,
    sim2real_roads,
    simulated_frames,
    split,
)
from ds_driver.sim2real.settings import PRESETS, Sim2RealSettings
from ds_driver.sim2real.trainer import EPOCHS, learning_rate_share, train
from ds_driver.sim2real.translation import translate
from ds_driver.training import CHECKPOINT, TrainingError
from ds_road import generate
from ds_sim.camera.encodings import jpeg
from ds_sim.camera.lens import project
from ds_sim.registry import BULLET, SOFTBODY, make_simulator
from ds_sim.simulator import Command, Observation

SETTINGS = Sim2RealSettings(
    shape=TINY, discriminator_filters=2, epochs=2, steps=2, pool=1, roads=2, threads=1, device="cpu"
)
WHOLE = Window(0, 160, 0, 320)


def lane_image(yellow: float, white: float, horizon: float) -> NDArray[np.uint8]:
    """Draw a straight lane on grass: columns of its lines at the bottom, and the row where they meet."""
    image = np.full((120, 160, 3), (60, 130, 50), np.uint8)
    road, lines = (-160.0, white + 3, (80, 80, 80)), ((yellow, (225, 190, 40)), (white, (235, 235, 235)))
    for left, right, colour in (road, *((middle - 5, middle + 5, paint) for middle, paint in lines)):
        corners = np.array([[80.0, horizon], [left, 120.0], [right, 120.0]])
        cv2.fillPoly(image, [corners.round().astype(np.int32)], colour)
    return image


def lanes(yellow: float, white: float, horizon: float, count: int = 8) -> NDArray[np.uint8]:
    return np.stack([lane_image(yellow + i % 3 - 1, white + i % 3 - 1, horizon) for i in range(count)])


def domains(rng: np.random.Generator) -> Domains:
    images = rng.integers(0, 256, (4, 5, *TINY.size, 3), dtype=np.uint8)
    places = np.repeat(np.array([[0.1, 0.9]]), len(HEIGHTS), axis=1) + rng.uniform(-0.05, 0.05, (5, 2 * len(HEIGHTS)))
    return Domains(
        simulated=images[0],
        real=images[1],
        pairs=LanePairs(
            simulated=np.arange(5),
            photographs=rng.integers(0, 5, (5, 3)),
            simulated_lanes=places,
            photographed_lanes=places[::-1],
            apart=0.0,
        ),
        shown_simulated=images[2][:1],
        shown_real=images[3][:1],
        simulator="bullet",
        match=Match(simulated=WHOLE, real=WHOLE, kept=1.0, difference=0.0),
    )


def small(of: Translator, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Translate an image of the generator's size."""
    return of._runner.compute(image[None])[0][0]


def test_the_networks_of_the_paper_have_its_numbers_of_parameters() -> None:
    """Counted on the authors' checkpoints: 9 blocks of 64 filters, and a 70 x 70 PatchGAN."""
    preset = PRESETS["paper"]
    generator, discriminator = Generator(preset.shape), Discriminator(preset.discriminator_filters)
    assert sum(p.numel() for p in generator.parameters()) == 11_378_179
    assert sum(p.numel() for p in discriminator.parameters()) == 2_764_737


@pytest.mark.parametrize(("depth", "side"), [(3, 70), (2, 34)])
def test_a_discriminator_judges_patches(depth: int, side: int) -> None:
    judge = Discriminator(2, depth).eval()
    # Without normalisation, which mixes all patches of an image.
    judge.layers = torch.nn.Sequential(*(layer for layer in judge.layers if not isinstance(layer, InstanceNorm)))
    image = torch.rand(1, 3, 160, 160, requires_grad=True)
    verdicts = judge(image)
    verdicts[0, 0, verdicts.shape[2] // 2, verdicts.shape[3] // 2].backward()
    assert image.grad is not None
    for axis in (2, 3):
        seen = image.grad.abs().sum(dim=(1, 5 - axis)).squeeze().nonzero()
        assert int(seen.max() - seen.min()) + 1 == side


def test_a_stored_generator_computes_in_onnx_what_pytorch_computes(tmp_path: Path) -> None:
    stored = write_generator(tmp_path / "g.safetensors")
    network = Generator(TINY)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in stored.tensors.items()})
    image = np.random.default_rng(1).integers(0, 256, (*TINY.size, 3), dtype=np.uint8)
    expected = to_images(network(to_batch(torch.from_numpy(image[None]))).detach())[0].numpy()
    found = small(Translator(stored), image)
    assert found.shape == expected.shape and np.abs(found.astype(int) - expected).max() <= 1
    assert np.ptp(found) > 0


@pytest.mark.parametrize("backend", ["onnx", "openvino", "openvino-bf16"])
def test_four_pixels_at_once_have_the_bits_of_a_plain_convolution(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if backend != "onnx":
        openvino = pytest.importorskip("openvino")
        if backend == "openvino-bf16" and "BF16" not in cpu_capabilities(openvino.Core()):
            pytest.skip("processor without bfloat16")
    generator = open_set("indoor_track").generator("bullet")
    images = np.random.default_rng(1).integers(0, 256, (2, *generator.shape.size, 3), dtype=np.uint8)
    images[0] = cv2.GaussianBlur(images[0], (0, 0), 4)
    at_once, graph = Translator(generator, backend), generator_to_onnx(generator)
    monkeypatch.setattr(OnnxGraph, "convolution_by_squares", OnnxGraph.convolution)
    plain = Translator(generator, backend)
    assert b"DepthToSpace" in graph and b"DepthToSpace" not in generator_to_onnx(generator)
    for image in images:
        assert np.array_equal(small(at_once, image), small(plain, image)) and np.ptp(small(plain, image)) > 0


def test_a_pool_returns_earlier_images_half_of_the_time() -> None:
    pool, rng = ImagePool(10), np.random.default_rng(1)
    returned = [float(pool.query(torch.full((1, 1, 1, 1), float(i)), rng)) for i in range(1000)]
    assert returned[:10] == list(range(10)) and len(pool.images) == 10
    own = sum(value == i for i, value in enumerate(returned[10:], start=10))
    assert 430 < own < 560 and all(value <= i for i, value in enumerate(returned))


def test_the_learning_rate_is_constant_and_then_falls_to_nothing() -> None:
    shares = [learning_rate_share(epoch, 20) for epoch in range(1, 21)]
    assert shares[:10] == [1.0] * 10
    assert np.diff(shares[9:]) == pytest.approx(-1 / 11) and shares[-1] == pytest.approx(1 / 11)


def test_a_stopped_training_ends_as_an_undisturbed_one_and_stores_what_was_trained(tmp_path: Path) -> None:
    data = domains(np.random.default_rng(3))
    for name in ("whole", "stopped"):
        (tmp_path / name).mkdir()
    train(data, SETTINGS, tmp_path / "whole", SILENT)
    trained = torch.load(tmp_path / "whole" / CHECKPOINT, weights_only=True)["networks"][0]
    stored = load_generator(tmp_path / "whole" / EPOCHS / "epoch_002.safetensors").tensors
    assert stored.keys() == trained.keys()
    for name, value in trained.items():
        assert np.array_equal(stored[name], value.to(torch.float16).float().numpy()), name

    class Stopping(ProgressLines):
        def describe(self, line: str) -> None:
            if self.done == 4:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(data, SETTINGS, tmp_path / "stopped", Stopping())
    told = ProgressLines()
    train(data, SETTINGS, tmp_path / "stopped", told)
    assert told.total == 4 and told.lines[0].startswith("steps; epoch 2/2")
    names = sorted(path.name for path in (tmp_path / "whole" / EPOCHS).iterdir())
    assert names == [f"epoch_00{i}.{kind}" for i in (1, 2) for kind in ("png", "safetensors")]
    for name in names:
        contents = [(tmp_path / folder / EPOCHS / name).read_bytes() for folder in ("whole", "stopped")]
        assert contents[0] == contents[1], name
    with pytest.raises(TrainingError, match="other settings or images"):
        train(data, replace(SETTINGS, seed=2), tmp_path / "whole", told)


def test_lines_are_found_and_a_picture_without_any_has_none() -> None:
    lines = find_lines(lane_image(40, 130, 20))
    assert lines.yellow[110, 34:47].any() and lines.white[110, 118:130].any()
    assert not lines.white[60:, 60:90].any() and not lines.yellow[:, 90:].any()
    plain = np.full((80, 160, 3), (40, 120, 200), np.uint8)
    assert not find_lines(plain).yellow.any() and not find_lines(plain).white.any()


@pytest.mark.parametrize("name", ["bullet", "donkey", "panda"])
def test_lines_are_found_where_the_lens_shows_them(name: str) -> None:
    """The finder goes by colour and width; the points are projected."""
    simulator, road = make_simulator(name), generate(np.random.default_rng(5))
    first = simulator.load(road, seed=1)
    simulator.close()
    window, lines = network_window(simulator.spec), find_lines(first.image)
    inset = 1.0 - simulator.spec.look.line_width / 2 / road.lane_width
    edge = road.points + (road.right_edge - road.points) * inset
    for mask, line in ((lines.yellow, road.points), (lines.white, edge)):
        pixels, depths = project(line, first.vehicle, simulator.spec.camera)
        columns, rows = pixels[np.isfinite(pixels[:, 0]) & (depths < 20.0)][::-1].T
        shifts = []
        for row in range(max(window.top, math.ceil(rows[0])), min(window.bottom, math.floor(rows[-1]))):
            expected = np.interp(row, rows, columns)
            near = np.flatnonzero(mask[row])
            near = near[np.abs(near - expected) < 0.06 * 320]
            if 10 < expected < 310:
                shifts.append(abs(near.mean() - expected) if near.size else np.inf)
        assert len(shifts) > 20 and np.isfinite(shifts).mean() > 0.9 and np.median(shifts) < 1.2


def test_both_domains_are_cropped_to_show_the_lane_alike() -> None:
    simulated = measure_lane(lanes(20, 140, 10), "images")
    real = measure_lane(lanes(45, 120, 25), "photographs")
    whole = Window(0, 120, 0, 160)
    assert simulated.seen_through(whole).yellow == pytest.approx(20 / 160, abs=0.02)
    assert lane_difference((simulated, real), (whole, whole)) > BOUND
    match = match_windows(simulated, whole, real)
    assert match.difference < BOUND / 2 and match.kept > 0.9
    # The lane of the photographs is narrower, so that they are cropped.
    assert match.real.right - match.real.left < 120


def test_an_image_is_paired_with_photographs_that_show_the_lane_alike() -> None:
    bottoms = [10.0, 20.0, 30.0, 40.0]
    grass = np.full((3, 120, 160, 3), (60, 130, 50), np.uint8)
    simulated = np.concatenate([*(lanes(bottom, bottom + 100, 20) for bottom in bottoms), grass])
    photographs = np.concatenate([lanes(bottom, bottom + 100, 20, 12) for bottom in [*bottoms, 60.0]])
    pairs = pair_lanes(simulated, photographs)
    assert pairs.simulated.tolist() == list(range(32)), "those without lines are left out"
    # Twelve photographs of each lane, in the order of the simulated ones; none has the last lane.
    assert np.array_equal(pairs.photographs // 12, np.repeat(np.repeat(range(4), 8)[:, None], NEIGHBOURS, axis=1))
    assert pairs.apart < 0.01 and pairs.warning is None
    other = pair_lanes(lanes(10, 110, 20, 24), lanes(50, 150, 20, 24))
    assert other.apart > 0.1 and "the generator will move lines" in str(other.warning)
    with pytest.raises(Sim2RealError, match="5 of 5 photographs show both lines"):
        pair_lanes(simulated, photographs[:5])


def test_a_photograph_is_aligned_to_the_lane_of_a_simulated_image() -> None:
    shown, wanted = lane_image(30, 120, 10), lane_image(18, 126, 24)
    of_shown, of_wanted = lane_shapes(np.stack((shown, wanted)))
    aligned = align_lane(shown, of_shown, of_wanted)
    assert np.abs(of_shown - of_wanted).max() > 0.05
    # The finder, which knows nothing of the alignment, sees both lines where the other image has them.
    assert np.abs(lane_shapes(aligned[None])[0] - of_wanted).max() < 0.025
    assert np.array_equal(align_lane(shown, of_shown, of_shown), shown), "one that fits stays as it is"


def test_a_training_draws_real_images_from_the_pairs(tmp_path: Path) -> None:
    data = domains(np.random.default_rng(3))
    changed = data.real.copy()
    changed[4] = 0
    pairs = replace(data.pairs, photographs=np.array([[i % 4] for i in range(5)]))
    results = []
    for name, real in (("one", data.real), ("other", changed)):
        (tmp_path / name).mkdir()
        results.append(train(replace(data, real=real, pairs=pairs), SETTINGS, tmp_path / name, SILENT))
    assert results[0] == results[1], "an image that nothing is paired with is never seen"


def test_photographs_of_nothing_like_a_road_are_refused() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (20, 60, 80, 3), dtype=np.uint8)
    with pytest.raises(Sim2RealError, match="nothing like a lane"):
        measure_lane(noise, "photographs")


def test_bad_photographs_are_named_in_one_line(tmp_path: Path) -> None:
    def refused(match: str) -> None:
        with pytest.raises(Sim2RealError, match=match) as caught:
            read_photographs(tmp_path, 100)
        assert "\n" not in str(caught.value)

    refused("no photographs, expected at least 20")
    image = jpeg(np.zeros((60, 80, 3), np.uint8))
    (tmp_path / "a00.jpg").write_bytes(image)
    refused("one photograph, expected at least 20")
    for i in range(1, 25):
        (tmp_path / f"a{i:02d}.jpg").write_bytes(image)
    found = read_photographs(tmp_path, 22)
    assert found.shape == (22, 60, 80, 3) and [len(part) for part in split(found)] == [18, 4]
    (tmp_path / "a07.jpg").write_bytes(jpeg(np.zeros((60, 90, 3), np.uint8)))
    refused("a07.jpg: photographs of 80 x 60 and 90 x 60 px")
    (tmp_path / "a07.jpg").write_bytes(image[:50])
    refused("a07.jpg: an image is damaged")
    with pytest.raises(Sim2RealError, match="does not exist"):
        read_photographs(tmp_path / "nowhere", 100)


def test_windows_and_sizes_that_do_not_fit_are_refused() -> None:
    image = np.random.default_rng(1).integers(0, 256, (160, 320, 3), dtype=np.uint8)
    assert np.array_equal(generator_input(image, Window(60, 140, 0, 160), (80, 160)), image[60:140, :160])
    with pytest.raises(Sim2RealError, match="another camera"):
        generator_input(image[:100], WHOLE, (80, 160))
    with pytest.raises(Sim2RealError, match="at least 8 rows"):
        Window(10, 12, 0, 100)


def test_roads_are_those_of_no_data_set(tmp_path: Path) -> None:
    roads = {road.road_id for road in sim2real_roads(SETTINGS)}
    assert len(roads) == 4
    check_roads_are_new(SETTINGS, [tmp_path])
    (tmp_path / "bullet").mkdir()
    (tmp_path / "bullet" / f"{min(roads)}-forward.parquet").touch()
    with pytest.raises(Sim2RealError, match="1 of the roads .*: collect it with another --seed"):
        check_roads_are_new(SETTINGS, [tmp_path])


def test_a_data_set_is_translated_once_and_with_the_bits_of_driving(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    data, out = tmp_path / "data", tmp_path / "out"
    images = rng.integers(0, 256, (2, 160, 320, 3), dtype=np.uint8)
    for name in ("bullet", "softbody"):
        write_recorded(data, name, images, [0.5, 0.5])
    translator = Translator(write_generator(tmp_path / "g.safetensors"))
    told = ProgressLines()
    assert translate(data, out, translator, told) == 1 and len(told.lines) == 1
    samples = read_samples(out)
    assert [sample.simulator for sample in samples] == ["bullet"] * 2 and samples[0].steering == 0.5
    assert samples[0].jpeg == jpeg(translator.translate(decode(jpeg(images[0]))))
    assert crops_of(out, ["bullet"]) == {"bullet": Crop()}
    file = drive_path(out, "bullet", "r", "forward")
    content, written = file.read_bytes(), file.stat().st_mtime_ns
    translate(data, out, translator, SILENT)
    assert file.stat().st_mtime_ns == written
    translate(data, tmp_path / "again", translator, SILENT, workers=1)
    assert drive_path(tmp_path / "again", "bullet", "r", "forward").read_bytes() == content
    other = Translator(write_generator(tmp_path / "other.safetensors", seed=2))
    with pytest.raises(Sim2RealError, match="another generator"):
        translate(data, out, other, SILENT)
    donkey = Translator(write_generator(tmp_path / "donkey.safetensors", "donkey"))
    with pytest.raises(Sim2RealError, match="has no drives of donkey"):
        translate(data, tmp_path / "x", donkey, SILENT)
    with pytest.raises(Sim2RealError, match="camera images of simulators"):
        translator.translate(np.zeros((120, 160, 3), np.uint8))


def test_a_bag_is_translated_with_the_bits_of_driving(tmp_path: Path) -> None:
    simulator = make_simulator("bullet")
    driver = make_driver("autopilot", simulator.spec)
    seen = []

    def record(observation: Observation) -> Command:
        seen.append(observation)
        if len(seen) == 3:
            raise DriverError("enough")
        return driver(observation)

    run = drive_road(simulator, record, generate(np.random.default_rng(5)), 1)
    levels: tuple[Level, ...] = ("raw", "compressed")
    translator = Translator(write_generator(tmp_path / "g.safetensors"))
    for level in levels:
        write_bag(tmp_path / level, "/ds1", BULLET, run, {}, level, seen)
        out = tmp_path / f"{level}_real"
        before = list(open_recording(tmp_path / level, Reading()).frames())
        assert translate(tmp_path / level, out, translator, SILENT) == len(before)
        recording = open_recording(out, Reading())
        after = list(recording.frames())
        assert recording.crop == Crop() and [f.steering for f in after] == [f.steering for f in before]
        for frame, plain in zip(after, before, strict=True):
            assert frame.image is not None and plain.image is not None
            expected = translator.translate(plain.image)
            if level == "compressed":
                expected = decode(jpeg(expected))
            assert np.array_equal(frame.image, expected)
        translate(tmp_path / level, tmp_path / level / "again" / out.name, translator, SILENT)
        copies = [file.read_bytes() for file in sorted(tmp_path.rglob(f"{level}_real.mcap"))]
        assert len(copies) == 2 and copies[0] == copies[1]
        with pytest.raises(Sim2RealError, match="translated already"):
            translate(out, tmp_path / "x", translator, SILENT)
    donkey = Translator(write_generator(tmp_path / "donkey.safetensors", "donkey"))
    with pytest.raises(Sim2RealError, match="translates images of donkey, these are of bullet"):
        translate(tmp_path / "raw", tmp_path / "x", donkey, SILENT)


def test_generators_that_are_damaged_or_of_another_simulator_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "g.safetensors"
    write_generator(path)
    content = path.read_bytes()
    for damaged in (content[:-40], b"", b"x" * 100, content.replace(b'filters\\": 2', b'filters\\": 3')):
        path.write_bytes(damaged)
        with pytest.raises(Sim2RealError) as caught:
            load_generator(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(Sim2RealError, match="no such generator"):
        load_generator(tmp_path / "missing.safetensors")


@pytest.mark.long
def test_from_photographs_to_a_set_of_generators(tmp_path: Path) -> None:
    """Images of another simulator stand for the photographs."""
    shape = GeneratorShape(filters=4, blocks=1, rows=80, columns=160)
    settings = replace(SETTINGS, shape=shape, discriminator_filters=4, roads=2, every=4, longest=80)
    told = ProgressLines()
    real = tmp_path / "photographs"
    real.mkdir()
    for index, image in enumerate(np.concatenate(simulated_frames(SOFTBODY, settings, tmp_path / "s.npz", told))):
        (real / f"{index:03d}.jpg").write_bytes(jpeg(image))
    out = tmp_path / "out"
    data = make_domains(BULLET, real, out, settings, told)
    assert data.match.difference < BOUND and not data.warnings
    training, held_out = simulated_frames(BULLET, settings, out / FRAMES, told)
    assert len(training) and len(held_out) and len(training) + len(held_out) == 80
    train(data, settings, out, told)
    with pytest.deprecated_call():
        again, _ = prepare_domains(read_sources(BULLET, real, out, settings, told), real, out)
    assert again.match == data.match and np.array_equal(again.shown_simulated, data.shown_simulated)
    (tmp_path / "set").mkdir()
    shutil.copy(out / EPOCHS / "epoch_002.safetensors", tmp_path / "set" / "bullet.safetensors")
    generator = open_set(str(tmp_path / "set")).generator("bullet")
    assert (generator.window, generator.real_window) == (data.match.simulated, data.match.real)
