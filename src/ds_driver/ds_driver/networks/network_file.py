# SPDX-License-Identifier: Apache-2.0
"""Loads network files of known formats, and recognises others by their content, without running it."""

from __future__ import annotations

import io
import pickletools
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

from ds_base.bounded_file import FileError, read_regular
from ds_base.installation import ds_command
from ds_base.words import listed
from ds_driver.networks.backends import BackendError, Runner, check_onnx, default_backend, onnx_runner, openvino_runner
from ds_driver.networks.pilot import DriverError

NETWORK_MEMORY = 4 * 2**30
"""Bytes that a network may map, as a graph of three nodes can ask for terabytes; chosen: 40 times the largest one."""
KINDS = {
    ".onnx": "onnx",
    ".pt": "torchscript",
    ".ts": "torchscript",
    ".torchscript": "torchscript",
    ".tflite": "tflite",
}
"""File suffix -> format."""
_FORMATS = {"torchscript": "TorchScript", "tflite": "TensorFlow Lite"}
_BACKENDS_OF = {
    "onnx": ("onnx", "openvino", "openvino-bf16"),
    "torchscript": ("torch", "openvino", "openvino-bf16"),
    "tflite": ("openvino", "openvino-bf16"),
}
"""Format -> backends that can run it; `auto` is the first one, for ONNX `default_backend` where it can run the file."""
LARGEST_FILE = 2**29
"""Bytes of a network file; chosen: five times the largest shipped network."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
_PICKLE = re.compile(rb"\x80[\x02-\x05]")
_OLD_CHECKPOINT = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."
"""First of the pickles in a checkpoint that PyTorch wrote before 1.6."""
_FLEX = re.compile(rb"Flex[A-Z][A-Za-z0-9]{2,60}(?=\0)")
"""TensorFlow's own operations in a TensorFlow Lite file."""
_PARTS_OF_WEIGHTS = re.compile(r"(collections|torch|torch\._utils|torch\._tensor|torch\.storage|numpy\S*|_codecs)$")
"""Modules of the classes that a checkpoint of weights alone names."""
_GLOBAL = re.compile(r"[\w.]+ [\w.]+$")
_SUFFIXES = (".pth", ".ckpt", ".h5", ".hdf5", ".keras", ".pb", ".bin", ".pkl")
"""Suffixes by which a file that its content does not name may be meant as a network."""


def backends_for(file: Path, backend: str = "auto") -> tuple[str, ...]:
    """Back ends to try for a network file, in order; a BackendError if this one cannot run it."""
    kind = KINDS[file.suffix.lower()]
    possible = _BACKENDS_OF[kind]
    if backend == "auto":
        # ONNX Runtime knows every operator of ONNX, OpenVINO most of them.
        return tuple(dict.fromkeys((default_backend(), "onnx"))) if kind == "onnx" else possible[:1]
    if backend not in possible:
        raise BackendError(f"backend {backend} cannot run {file.name}: expected {listed(possible, 'or')}")
    return (backend,)


def runner_of(file: Path, chosen: str, device: str = "cpu") -> Runner:
    """Load a network file with one of `backends_for` it, whatever its description says; see `DescribedNetworkPilot`."""
    kind = KINDS[file.suffix.lower()]
    try:
        content = read_regular(file, LARGEST_FILE)
    except (FileError, OSError) as error:
        raise DriverError(f"{file} cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if problem := foreign(content, file):
        raise DriverError(problem)
    really = "tflite" if content[4:8] == b"TFL3" else "torchscript" if content.startswith(b"PK") else kind
    if really != kind:
        suffix = next(suffix for suffix, one in KINDS.items() if one == really)
        raise DriverError(f"{file} is a {_FORMATS[really]} file: rename it to {file.with_suffix(suffix).name}")
    if kind == "onnx":
        check_onnx(content, file.name)
    if chosen.startswith("openvino"):
        return openvino_runner(content, file.name, chosen, kind=kind)
    if chosen == "onnx":
        return onnx_runner(content, file.name)
    from ds_driver.networks.torch_networks import torch_device, torchscript_runner

    return torchscript_runner(content, torch_device(device), file.name)


def refuse_foreign(file: Path) -> None:
    """Refuse, by a DriverError, a file that has to be converted first; a missing one and one that can run pass."""
    if file.is_dir() and (file / "saved_model.pb").is_file():
        raise DriverError(_to_onnx(file, "is a SavedModel of TensorFlow", f"--saved-model {file}"))
    if not file.is_file():
        return
    try:
        content = read_regular(file, LARGEST_FILE)
    except (FileError, OSError):
        return  # whoever loads it says so
    if problem := foreign(content, file):
        raise DriverError(problem)


def foreign(content: bytes, file: Path) -> str | None:
    """Say what the content of a file is and how to convert it; None if it may run, or is unknown."""
    if content.startswith(_HDF5):
        if b"model_config" in content:
            return _to_onnx(file, "is a whole Keras model in HDF5", f"--keras {file}")
        return (
            f"{file} holds weights alone in Keras's HDF5 format: in the program that defines the model, load them with "
            f'model.load_weights("{file.name}"), model.save("{file.stem}.keras"), and '
            f"`{ds_command('check', f'{file.stem}.keras')}` says how to go on"
        )
    if content[4:8] == b"TFL3":
        if operations := sorted({one.group().decode() for one in _FLEX.finditer(content)}):
            named = ", ".join(operations[:3]) + (", ..." if len(operations) > 3 else "")
            what = f"is a TensorFlow Lite file with operations that only TensorFlow runs ({named})"
            return _to_onnx(file, what, "--keras MODEL.h5", "the model that it was made from")
    elif content.startswith(b"PK\x03\x04"):
        return _zipped(content, file)
    elif _PICKLE.match(content):
        if content.startswith(_OLD_CHECKPOINT):
            return _checkpoint(content, file)
        return f"{file} is a Python pickle, which is a program: export the network in it to ONNX{_export(file)}"
    elif file.suffix.lower() in (".engine", ".trt"):
        return f"{file} is a TensorRT engine, built for one GPU: check the .onnx file that it was built from"
    elif file.suffix.lower() in _SUFFIXES:
        return f"{file} is no network file of a format that is known here: export the network to ONNX{_export(file)}"
    return None


def _zipped(content: bytes, file: Path) -> str | None:
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        names = archive.namelist()
        pickled = next((one for one in names if one.rpartition("/")[2] == "data.pkl"), None)
        if any(one.rpartition("/")[2] == "constants.pkl" or "/code/" in one for one in names):
            return None  # TorchScript
        if pickled is not None:
            return _checkpoint(archive.read(pickled), file)
    except (zipfile.BadZipFile, OSError, NotImplementedError, RuntimeError, EOFError, ValueError):
        cut = "is a zip archive, as PyTorch and Keras write them, whose end is missing or damaged"
        return f"{file} {cut}: copy it again, and if that changes nothing export the network to ONNX{_export(file)}"
    if "model.weights.h5" in names and "config.json" in names:
        program = f"import keras; keras.models.load_model('{file}').export('{file.stem}.onnx', format='onnx')"
        return (
            f"{file} is a whole Keras model: convert it where TensorFlow and Keras 3.8 or later are, with "
            f'`python -c "{program}"`, then `{ds_command("check", f"{file.stem}.onnx")}`'
        )
    return f"{file} is a zip archive without a network that is known here: unpack it, and check what is inside"


def _checkpoint(pickles: bytes, file: Path) -> str:
    """Say whether PyTorch's pickles name a network's class, or numbers alone."""
    others = [one for one in _classes(pickles) if not _PARTS_OF_WEIGHTS.match(one.partition(" ")[0])]
    if others:
        module, _, name = others[0].partition(" ")
        return (
            f"{file} is a whole PyTorch model or more than its weights (it names {name} of {module}), which only the "
            f"program that defines that class can load: there, torch.load it and export it{_export(file)}"
        )
    how = "in the program that defines the network, load them and export it"
    return f"{file} holds PyTorch weights alone: {how}{_export(file)}"


def _classes(pickles: bytes) -> Iterator[str]:
    """Yield the `module name` pairs that pickles refer to, without running them."""
    stream, texts = io.BytesIO(pickles), ["", ""]
    try:
        while stream.tell() < len(pickles):
            for code, argument, _ in pickletools.genops(stream):
                if code.name == "GLOBAL" and _GLOBAL.match(str(argument)):
                    yield str(argument)
                elif code.name == "STACK_GLOBAL":
                    yield " ".join(texts[-2:])
                elif isinstance(argument, str):
                    texts.append(argument)
    except Exception:  # tensors follow the pickles of an old checkpoint
        return


def _to_onnx(file: Path, what: str, source: str, model: str = "it") -> str:
    return (
        f"{file} {what}: convert {model} to ONNX where TensorFlow is, with `python -m tf2onnx.convert {source} "
        f"--output {file.stem}.onnx`, then `{ds_command('check', f'{file.stem}.onnx')}`"
    )


def _export(file: Path) -> str:
    return (
        f' with torch.onnx.export(network.eval(), (torch.zeros(1, 3, ROWS, COLUMNS),), "{file.stem}.onnx", '
        f"dynamo=False), then `{ds_command('check', f'{file.stem}.onnx')}`"
    )
