# SPDX-License-Identifier: Apache-2.0
"""Translates data sets, bags and tubs: the same format out, resumable, byte-deterministic."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_bags.copying import rewrite_bag
from ds_bags.donkey_tub import MAX_FILE, is_tub, read_tub
from ds_bags.layout import TRANSLATED
from ds_bags.reader import COMPRESSED, IMAGE, BagReader
from ds_base.bounded_file import read_json, read_regular
from ds_base.bounded_tables import read_parquet
from ds_base.folder_files import write_json, write_whole
from ds_base.processes import map_in_processes
from ds_base.progress import Progress
from ds_driver.data.dataset import GENERATOR, IMPORTED, decode, keep_import, read_drive, write_drive, write_manifest
from ds_driver.networks.images import ImageError, read_rgb, rgb_of_message
from ds_driver.sim2real.generator import Sim2RealError, load_generator
from ds_driver.sim2real.image_translation import Translator
from ds_sim.camera.encodings import jpeg

MARK = TRANSLATED
"""Key of the generator in `imported.json` and in a bag's facts, and stem of the file that marks a translated tub."""
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


def translate(
    source: Path, out: Path, translator: Translator, progress: Progress, *, workers: int | None = None
) -> int:
    """Translate a data set, bag or tub of simulated drives; what is there already is kept, so a stopped one continues.

    Returns the number of translated drives of a data set, for which `workers` processes work, as many as there are
    processors if None, and with 1 only this one; or of images of a bag or tub. `progress` counts the same.
    """
    if source.resolve() == out.resolve():
        raise Sim2RealError(f"{out} is the folder to read from: choose another --out")
    if (source / "metadata.yaml").exists():
        return _bag(source, out, translator, progress)
    # A data set has a manifest.json, too.
    is_data_set = next(source.glob("*/*.parquet"), None) is not None
    if is_tub(source) and not is_data_set:
        return _tub(source, out, translator, progress)
    return _data_set(source, out, translator, progress, workers)


def _data_set(folder: Path, out: Path, translator: Translator, progress: Progress, workers: int | None) -> int:
    """Translate the drives of the generator's simulator; as they are cropped already, they are marked as imported."""
    simulator = translator.generator.simulator
    files = sorted((folder / simulator).glob("*.parquet"))
    if not files:
        names = sorted({path.parent.name for path in folder.glob("*/*.parquet")})
        has = f"it has those of {', '.join(names)}" if names else "it has none at all"
        raise Sim2RealError(f"{folder} has no drives of {simulator}, whose images the generator translates: {has}")
    target = out / simulator
    _claim(target / IMPORTED, translator)
    keep_import(out, simulator, {MARK: translator.generator.sha256})
    write_whole(target / GENERATOR, translator.generator.content)
    progress.start(len(files))
    work = partial(_translate_drive, translator.backend, target)
    for file in map(work, files) if workers == 1 else map_in_processes(work, files, workers=workers):
        progress.advance(line=f"{simulator}: {file.stem}")
    if (folder / "manifest.json").is_file():
        write_manifest(out, _facts(folder / "manifest.json"))
    return len(files)


def _translate_drive(backend: str, out: Path, file: Path) -> Path:
    if not (out / file.name).exists():
        translator = _translator(out / GENERATOR, backend)
        read_drive(file)
        rows: list[dict[str, Any]] = read_parquet(file).to_pylist()
        for row in rows:
            row["image"] = jpeg(translator.translate(decode(row["image"])))
        write_drive(out / file.name, rows)
    return file


@lru_cache(maxsize=1)
def _translator(generator: Path, backend: str) -> Translator:
    return Translator(load_generator(generator), backend)


def _facts(manifest: Path) -> dict[str, Any]:
    """How a data set was collected, without its counts, as not all of it may be translated."""
    try:
        facts = read_json(manifest)
        return {name: value for name, value in facts.items() if name not in ("images", "steering_bins", "steering")}
    except (ValueError, AttributeError):
        raise Sim2RealError(f"{manifest} is damaged: collect the data set again, the drives are kept") from None


def _bag(folder: Path, out: Path, translator: Translator, progress: Progress) -> int:
    """Translate the images of a bag, without its camera information, which is of the whole image."""
    with BagReader(folder) as bag:
        simulator = bag.facts.get("simulator", "")
        total = sum(c.msgcount for c in bag.connections if c.msgtype in (IMAGE, COMPRESSED))
        done_before = bag.facts.get(MARK) or any(f"/{TRANSLATED}/" in c.topic for c in bag.connections)
    if not simulator or not total:
        raise Sim2RealError(f"{folder} is no bag of this project with images: record with --level compressed or raw")
    if done_before:
        raise Sim2RealError(f"{folder} is translated already: give one of a driver that sees plain images")
    if translator.generator.simulator != simulator:
        raise Sim2RealError(
            f"the generator translates images of {translator.generator.simulator}, these are of {simulator}: choose "
            f"the generator of {simulator}, or train one"
        )
    if out.exists():
        with BagReader(out) as bag:
            mark_text = bag.facts.get(MARK)
        if mark_text != translator.generator.sha256:
            raise Sim2RealError(f"{out} is no translation by this generator: choose another --out")
        return total
    done = 0
    progress.start(total)

    def translated(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        nonlocal done
        done += 1
        progress.advance(line=_images_of(folder, done, total))
        return translator.translate(pixels)

    def image(message: Any) -> Any:
        pixels = translated(rgb_of_message(message))
        rows, columns = pixels.shape[:2]
        shape = {"height": rows, "width": columns, "step": 3 * columns}
        return replace(message, encoding="rgb8", data=pixels.reshape(-1), **shape)

    def compressed(message: Any) -> Any:
        return replace(message, format="jpeg", data=np.frombuffer(jpeg(translated(rgb_of_message(message))), np.uint8))

    facts = {MARK: translator.generator.sha256}
    return rewrite_bag(folder, out, {IMAGE: image, COMPRESSED: compressed}, facts, without=[CAMERA_INFO])


def _tub(folder: Path, out: Path, translator: Translator, progress: Progress) -> int:
    """Translate the images of a tub that a simulator's camera recorded; catalogues are copied as they are."""
    tub = read_tub(folder)
    images = [file for _, file in tub.pictures]
    if not images:
        raise Sim2RealError(f"{folder} is a tub without images: nothing to translate")
    mark = out / f"{MARK}.json"
    _claim(mark, translator)
    write_json(mark, {MARK: translator.generator.sha256})
    progress.start(len(images))
    for done, image in enumerate(images, start=1):
        target = out / "images" / image.name
        if not target.exists():
            try:
                pixels = read_rgb(image)
            except ImageError as error:
                raise Sim2RealError(f"{image}: {error}: copy the tub again") from None
            write_whole(target, jpeg(translator.translate(pixels)))
        progress.advance(line=_images_of(folder, done, len(images)))
    # Last, so that an unfinished folder is no tub.
    for file in (*tub.files, folder / "manifest.json"):
        write_whole(out / file.name, read_regular(file, MAX_FILE))
    return len(images)


def _images_of(folder: Path, done: int, total: int) -> str:
    """A line after each hundred images, and after the last."""
    return f"{folder.name}: images" if done % 100 == 0 or done == total else ""


def _claim(mark: Path, translator: Translator) -> None:
    """Refuse a folder with the translations of another generator, or with anything else."""
    if not mark.exists():
        if any(path.suffix == ".parquet" for path in mark.parent.glob("*")):
            raise Sim2RealError(f"{mark.parent} holds drives that are no translations: choose another --out")
        return
    try:
        mark_text = read_json(mark).get(MARK)
    except (ValueError, AttributeError):
        mark_text = None
    if mark_text != translator.generator.sha256:
        raise Sim2RealError(f"{mark.parent} holds translations by another generator: choose another --out")
