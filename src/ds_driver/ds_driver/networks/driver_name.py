# SPDX-License-Identifier: Apache-2.0
"""A driver's name, `NETWORK+GENERATORS@BACKEND`: parsed where text comes in, and carried as a value from there on."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from ds_base.extension import installed
from ds_driver.networks.architectures import NETWORKS
from ds_driver.networks.backends import BACKENDS, DEVICES, BackendError
from ds_driver.networks.pilot import DriverError
from ds_driver.networks.weights import APART, shipped_networks, shipped_sets
from ds_sim.registry import path_moved

DESCRIPTIONS = (".yaml", ".yml")
"""Suffixes of the description of a network file."""
WEIGHTS = ".safetensors"
"""Suffix of a file of weights of a built-in architecture."""
NODE = "ros@"
"""Before the name of a ROS node that its user starts."""
NO_GENERATORS = "none"
"""In place of a set of generators: the network sees plain images, whatever it was trained on."""


@dataclass(frozen=True)
class DriverName:
    """A driver's name, parsed; `str` gives the text back.

    Attributes:
        network: name of a shipped network or of an installed package's driver, a file of weights, the description of a
            network file, `module:Class`, or `ros@NAME` for a ROS node that its user starts.
        generators: set of generators that translate images for the network; "" where the name has none.
        ending: one of `ds_driver.networks.backends.BACKENDS`, or `cuda`; "" where the name has none, as `auto`.

    Examples:
        >>> DriverName.parse("dave2+indoor_track@openvino-bf16")
        DriverName(network='dave2', generators='indoor_track', ending='openvino-bf16')
        >>> str(DriverName.parse("my_net.yaml").on("torch", "cuda"))
        'my_net.yaml@cuda'
    """

    network: str
    generators: str = ""
    ending: str = ""

    @classmethod
    def parse(cls, text: str) -> DriverName:
        """Parse a name; whether there is such a driver is seen when it is loaded."""
        if text.startswith(NODE):
            return cls(text)
        name, at, ending = text.rpartition("@")
        if at and ending in (*BACKENDS, "cuda"):
            return cls(*_split_generators(name), ending)
        return cls(*_split_generators(text))

    @classmethod
    def of(cls, driver: DriverName | str) -> DriverName:
        """Parse a name unless it is parsed already."""
        return driver if isinstance(driver, DriverName) else cls.parse(driver)

    def __str__(self) -> str:
        generators = f"+{self.generators}" if self.generators else ""
        return f"{self.network}{generators}{'@' * bool(self.ending)}{self.ending}"

    @property
    def is_node(self) -> bool:
        """Whether it is a ROS node that its user starts, whatever it runs; its name is but a label."""
        return self.network.startswith(NODE)

    @property
    def has_files(self) -> bool:
        """Whether files decide how it drives; none do of the autopilot and of a ROS node."""
        return self != AUTOPILOT and not self.is_node

    @property
    def backend(self) -> str:
        """One of `ds_driver.networks.backends.BACKENDS`."""
        return "torch" if self.ending == "cuda" else self.ending or "auto"

    @property
    def device(self) -> str:
        """One of `ds_driver.networks.backends.DEVICES`."""
        return "cuda" if self.ending == "cuda" else "cpu"

    @property
    def suffix(self) -> str:
        """Backend suffix, such as `@onnx`; "" for the default."""
        return "" if self.backend == "auto" else f"@{self.ending}"

    @property
    def file_type(self) -> str:
        """Suffix of the network's file in lower case; "" if the name is not a file name."""
        return Path(self.network).suffix.lower()

    @property
    def description(self) -> Path | None:
        """Path of the description of its network file, the user's or a shipped one; None for other networks."""
        path = shipped_networks().get(self.network, Path(self.network))
        return path if path.suffix.lower() in DESCRIPTIONS else None

    @property
    def has_weights(self) -> bool:
        """Whether it is a network of this project's architectures, which every backend computes."""
        has_architecture = self.network in (*NETWORKS, *shipped_networks(), *APART) or self.file_type == WEIGHTS
        return has_architecture and self.description is None

    @property
    def python_class(self) -> str:
        """`module:Class` of a network that is a Python class, the user's or of an installed package; else ""."""
        if entry := installed("drivers").get(self.network):
            return entry.value
        return self.network if ":" in self.network and self.file_type not in (WEIGHTS, *DESCRIPTIONS) else ""

    def on(self, backend: str = "auto", device: str = "cpu") -> DriverName:
        """Choose what computes; the defaults leave the name as it is.

        Raises:
            BackendError: the backend or the device is unknown, or they cannot be combined.
        """
        if backend not in BACKENDS:
            raise BackendError(f"unknown backend {backend!r}: expected one of {', '.join(BACKENDS)}")
        if device not in DEVICES:
            raise BackendError(f"unknown device {device!r}: expected one of {', '.join(DEVICES)}")
        if device == "cuda" and backend not in ("auto", "torch"):
            raise BackendError(f"backend {backend} runs on the CPU only: leave out --device cuda")
        if device == "cuda":
            return replace(self, ending="cuda")
        return self if backend == "auto" else replace(self, ending=backend)

    def moved(self, start: Path, end: Path) -> DriverName:
        """The name whose paths, relative to one folder, are made relative to another."""
        network, generators = self.network, self.generators
        if self.file_type in (WEIGHTS, *DESCRIPTIONS):
            network = path_moved(network, start, end)
        if generators and generators not in (NO_GENERATORS, *shipped_sets()):
            generators = path_moved(generators, start, end)
        return replace(self, network=network, generators=generators)

    def seeing(self, generators: str) -> DriverName:
        """Let a set of generators translate its images; "" leaves the name as it is."""
        return replace(self, generators=generators) if generators else self


def _split_generators(name: str) -> tuple[str, str]:
    for place in (index for index, character in enumerate(name) if character == "+"):
        network = name[:place]
        is_file = Path(network).suffix.lower() in (WEIGHTS, *DESCRIPTIONS)
        if is_file or network in (*NETWORKS, *shipped_networks()) or (":" in network and place > 1):
            return network, name[place + 1 :]
    return name, ""


AUTOPILOT = DriverName("autopilot")
"""The autopilot, in place of a network."""


def received_driver(driver: DriverName, *, confirmed: Collection[str] = ()) -> DriverName:
    """Check and return a driver that a received file names, before anything is loaded.

    The autopilot, shipped networks, safetensors weights, and described ONNX or TensorFlow Lite files run no code of
    their own. A Python class runs its module, and a TorchScript file is a program that can write files: such a name is
    among the `confirmed` ones that the user gave with `--trust` or in a configuration.

    Raises:
        DriverError: it would run unconfirmed code, or has no readable description.
    """
    from ds_driver.networks.description import file_of, read_description
    from ds_driver.networks.network_file import KINDS

    text, name, suffix = str(driver), driver.network, driver.file_type
    harmless = driver == AUTOPILOT or name in shipped_networks() or name in installed("drivers") or suffix == WEIGHTS
    if harmless or text in confirmed or name in confirmed:
        return driver
    if suffix in DESCRIPTIONS:
        path = Path(name)
        if KINDS[file_of(path, read_description(path)).suffix.lower()] != "torchscript":
            return driver
        what = "a TorchScript file, which is a program,"
    elif ":" in name:
        what = "Python code that is not shipped,"
    else:
        return driver  # an architecture without weights, or not loadable at all
    shown = repr(text) if len(text) <= 100 else f"{text[:100]!r}..."
    raise DriverError(
        f"driver {shown} is {what} and a received file must not run code: if you trust it, name it yourself with "
        f"--trust {shown}"
    )
