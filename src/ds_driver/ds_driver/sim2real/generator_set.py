"""Finds a driver's generators, a file for each simulator: in a folder, shipped, or beside a network's weights."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from ds_driver.networks.pilot import DriverError
from ds_driver.networks.weights import SHIPPED
from ds_driver.sim2real.generator_file import LARGEST_FILE, StoredGenerator, load_generator
from ds_driver.sim2real.window import Sim2RealError
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH
from ds_sim.registry import SIMULATORS, label_of

FOLDER = "sim2real"
"""Folder of generators: that of the shipped sets, and the one beside a network's weights."""
NONE = "none"
"""In place of a set's name: no generator, whatever the network was trained on."""


class GeneratorSet:
    """Generators of several simulators, loaded when they are first needed.

    Args:
        name: for messages.
        files: label of a simulator -> file of its generator.
        digests: label of a simulator -> SHA-256 that its file must have; None for any.
    """

    def __init__(self, name: str, files: Mapping[str, Path], digests: Mapping[str, str] | None = None) -> None:
        self.name = name
        self.files = dict(sorted(files.items()))
        self._digests = digests
        self._loaded: dict[str, StoredGenerator] = {}

    def __contains__(self, simulator: str) -> bool:
        return label_of(simulator) in self.files

    def check(self, simulators: Iterable[str]) -> None:
        """Load the generators of simulators.

        Raises:
            DriverError: one is missing, damaged, or translates images of another simulator.
        """
        for simulator in simulators:
            self.generator(simulator)

    def generator(self, simulator: str) -> StoredGenerator:
        """Return the generator for a simulator's images.

        Raises:
            DriverError: it is missing, damaged, or translates images of another simulator.
        """
        label = label_of(simulator)
        if label not in self._loaded:
            if label not in self.files:
                known = f"those of {', '.join(self.files)}" if self.files else "none"
                raise DriverError(
                    f"{self.name} has no generator for images of {simulator}, it has {known}: train one with `ds "
                    f"sim2real train --sim {simulator}`, or leave out {simulator}"
                )
            path = self.files[label]
            try:
                generator = load_generator(path)
            except Sim2RealError as error:
                raise DriverError(str(error)) from None
            if generator.simulator != simulator:
                raise DriverError(f"{path} translates images of {generator.simulator}, not of {simulator}: rename it")
            if generator.window.bottom > IMAGE_HEIGHT or generator.window.right > IMAGE_WIDTH:
                raise DriverError(f"{path} has a crop, {generator.window}, beyond the image: train the generator again")
            if self._digests is not None and generator.sha256 != self._digests[label]:
                raise DriverError(f"{path} has changed: put back the generator that {self.name} was trained with")
            self._loaded[label] = generator
        return self._loaded[label]

    @property
    def sha256(self) -> str:
        """Digest of all files."""
        lines = (f"{label} {_sha256(path)}\n" for label, path in self.files.items())
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def shipped_sets() -> dict[str, Path]:
    """Return the shipped sets: name -> folder."""
    return {path.name: path for path in sorted((SHIPPED / FOLDER).glob("*")) if _files_in(path)}


def shipped_set_of(digests: Mapping[str, str]) -> str | None:
    """Return the shipped set that holds generators, simulator -> SHA-256; None if none holds all."""
    for name, folder in shipped_sets().items():
        files = _files_in(folder)
        if all(label in files and _sha256(files[label]) == d for label, d in _by_label(digests).items()):
            return name
    return None


def open_set(name: str) -> GeneratorSet:
    """Open a set of generators.

    Args:
        name: name of a shipped set, or a folder with a file `SIMULATOR.safetensors` for each simulator.

    Raises:
        DriverError: there is no such set.
    """
    sets = shipped_sets()
    folder = sets.get(name, Path(name))
    files = _files_in(folder)
    if not files:
        known = f"a shipped one ({', '.join(sets)}), or " if sets else ""
        raise DriverError(
            f"no generators in {name!r}: expected {known}a folder with files such as {next(iter(SIMULATORS))}"
            ".safetensors, from `ds sim2real assess --ship`"
        )
    return GeneratorSet(name, files)


def set_of_network(name: str, weights: Path, digests: Mapping[str, str]) -> GeneratorSet:
    """Find the generators that a network was trained with: beside its weights, or in a shipped set.

    Args:
        name: of the network, for messages.
        weights: its file.
        digests: simulator -> SHA-256 of its generator, from the file.

    Raises:
        DriverError: one is missing.
    """
    beside = weights.parent / FOLDER
    places = [beside, *sorted(path for path in beside.glob("*") if path.is_dir()), *shipped_sets().values()]
    found: dict[str, Path] = {}
    for simulator, digest in digests.items():
        label = label_of(simulator)
        candidates = (_files_in(place).get(label) for place in dict.fromkeys(places))
        match = next((path for path in candidates if path is not None and _sha256(path) == digest), None)
        if match is None:
            raise DriverError(
                f"{name} was trained on images of {simulator} that a generator translated, which is missing: copy it "
                f"to {beside}/{label}.safetensors"
            )
        found[label] = match
    return GeneratorSet(name, found, _by_label(digests))


def _by_label(digests: Mapping[str, str]) -> dict[str, str]:
    return {label_of(simulator): digest for simulator, digest in digests.items()}


def _files_in(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))} if folder.is_dir() else {}


def _sha256(path: Path) -> str:
    if path.stat().st_size > LARGEST_FILE:
        raise DriverError(f"{path} has more than {LARGEST_FILE // 2**20} MiB: expected a generator")
    return hashlib.sha256(path.read_bytes()).hexdigest()
