# SPDX-License-Identifier: Apache-2.0
"""Files of other formats: the first line says what they are and how to convert them, and nothing in them runs."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from ds_driver.networks.network_driver import NetworkDriver
from ds_driver.networks.network_file import refuse_foreign, runner_of
from ds_driver.networks.pilot import DriverError


class Bomb:
    """Leaves a file behind if it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, ("ran", "w"))


def zipped(*members: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w") as archive:
            for member in members:
                archive.writestr(member, b"{}")

    return write


def written(content: bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_bytes(content)

    return write


def tflite(operations: bytes) -> Callable[[Path], None]:
    """Write the beginning of a TensorFlow Lite file and names of operations, as its flatbuffer holds them."""
    return written(b"\x1c\0\0\0TFL3" + bytes(40) + operations + bytes(40))


def saved(network: Any, *, old: bool = False) -> Callable[[Path], None]:
    return lambda path: torch.save(network, path, _use_new_zipfile_serialization=not old)


LINEAR = torch.nn.Linear(3, 1)
HDF5 = b"\x89HDF\r\n\x1a\n"


@pytest.mark.parametrize(
    ("name", "write", "said"),
    [
        (
            "n.pt",
            saved(LINEAR),
            r"whole PyTorch model.*names Linear of torch\.nn\.modules\.linear.*torch\.onnx\.export",
        ),
        ("n.pth", saved(LINEAR, old=True), r"whole PyTorch model.*names Linear of torch\.nn.*ds check n\.onnx"),
        ("n.pth", saved(LINEAR.state_dict()), r"holds PyTorch weights alone: .*torch\.onnx\.export.*ds check n\.onnx"),
        ("n.pt", saved({"model": LINEAR.state_dict(), "epoch": 3}), "holds PyTorch weights alone"),
        ("n.ckpt", saved(LINEAR.state_dict(), old=True), "holds PyTorch weights alone"),
        ("n.pt", saved(Bomb()), r"whole PyTorch model.*names open of"),
        ("n.h5", written(HDF5 + b"..model_config.."), r"whole Keras model.*--keras \S*n\.h5 --output n"),
        ("n.h5", written(HDF5), r"weights alone in Keras's HDF5.*load_weights"),
        ("n.onnx", written(HDF5 + b"model_config"), "n.onnx is a whole Keras model in HDF5"),
        (
            "n.keras",
            zipped("metadata.json", "config.json", "model.weights.h5"),
            r"n\.keras is a whole Keras model: .*export\('n\.onnx', format='onnx'\)",
        ),
        ("n.tflite", tflite(b"FlexConv3D\0FlexRelu\0"), r"only TensorFlow runs \(FlexConv3D, FlexRelu\).*tf2onnx"),
        ("n.pkl", written(pickle.dumps(Bomb())), "is a Python pickle, which is a program"),
        ("n.trt", written(b"ftrt"), "TensorRT engine, built for one GPU"),
        ("n.pt", written(b"PK\x03\x04" + bytes(50)), "whose end is missing or damaged: copy it again"),
    ],
)
def test_the_first_line_says_what_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, write: Callable[[Path], None], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / name)
    (tmp_path / "n.yaml").write_text(f"file: {name}\ninput: {{size: [8, 16]}}")
    for driver in (name, "n.yaml"):
        with pytest.raises(DriverError, match=said) as refused:
            NetworkDriver(driver)
        text = str(refused.value)
        assert text.startswith(name) and "\n" not in text and "whole ONNX" not in text
    assert not Path("ran").exists()


def test_a_saved_model_is_a_folder(tmp_path: Path) -> None:
    (tmp_path / "pilot.savedmodel").mkdir()
    (tmp_path / "pilot.savedmodel/saved_model.pb").touch()
    with pytest.raises(DriverError, match=r"is a SavedModel of TensorFlow: .*--saved-model \S+ --output pilot\.onnx"):
        refuse_foreign(tmp_path / "pilot.savedmodel")


def test_what_runs_is_not_refused_and_a_wrong_name_is_told(tmp_path: Path) -> None:
    torch.jit.trace(LINEAR, torch.zeros(1, 3)).save(tmp_path / "n.pt")  # type: ignore[no-untyped-call]
    tflite(b"CONV_2D\0")(tmp_path / "n.tflite")
    for name in ("n.pt", "n.tflite", "gone.pt"):
        refuse_foreign(tmp_path / name)
    (tmp_path / "n.onnx").write_bytes((tmp_path / "n.pt").read_bytes())
    with pytest.raises(DriverError, match=r"n\.onnx is a TorchScript file: rename it to n\.pt"):
        runner_of(tmp_path / "n.onnx", "onnx")
