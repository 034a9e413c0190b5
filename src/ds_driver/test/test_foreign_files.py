# SPDX-License-Identifier: Apache-2.0
"""Files of strangers: what is of another format is named, nothing in them runs, and their memory is bounded."""

from __future__ import annotations

import pickle
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from made_networks import write_graph
from onnx import TensorProto, helper, numpy_helper

from ds_driver.networks.described_network import DescribedNetworkPilot
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
KERAS = zipped("metadata.json", "config.json", "model.weights.h5")


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
        ("n.keras", KERAS, r"n\.keras is a whole Keras model: .*export\('n\.onnx', format='onnx'\)"),
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


def described(folder: Path, nodes: list[onnx.NodeProto], constants: list[onnx.TensorProto]) -> Path:
    write_graph(folder / "network.onnx", nodes, {"image": [1, 3, 160, 320]}, {"out": None}, constants)
    (folder / "network.yaml").write_text("file: network.onnx\ninput: {size: [160, 320]}\n")
    return folder / "network.yaml"


def test_a_constant_of_gigabytes_is_refused(tmp_path: Path) -> None:
    shape = numpy_helper.from_array(np.array([3_000_000_000], np.int64), "shape")
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["constant"]),
        helper.make_node("ReduceMean", ["constant"], ["mean"], keepdims=0),
        helper.make_node("ReduceMean", ["image"], ["value"], keepdims=0),
        helper.make_node("Add", ["mean", "value"], ["out"]),
    ]
    before = resource.getrlimit(resource.RLIMIT_AS)
    with pytest.raises(DriverError) as refused:
        DescribedNetworkPilot(described(tmp_path, nodes, [shape]))
    assert "\n" not in str(refused.value) and resource.getrlimit(resource.RLIMIT_AS) == before


def test_external_data_is_refused_also_within_a_subgraph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weight.bin").write_bytes(bytes(4))
    weight = TensorProto(name="weight", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL)
    weight.external_data.add(key="location", value="weight.bin")
    mean = helper.make_node("ReduceMean", ["image"], ["value"], keepdims=0)
    product = [mean, helper.make_node("Mul", ["value", "weight"], ["out"])]
    inner = helper.make_graph(
        [helper.make_node("Constant", [], ["inside"], value=weight)],
        "inner",
        [],
        [helper.make_tensor_value_info("inside", TensorProto.FLOAT, [1])],
    )
    choice = [
        helper.make_node("Constant", [], ["yes"], value=numpy_helper.from_array(np.array(True))),
        helper.make_node("If", ["yes"], ["out"], then_branch=inner, else_branch=inner),
    ]
    for nodes, constants in ((product, [weight]), (choice, [])):
        with pytest.raises(DriverError, match="keeps its weights in other files"):
            DescribedNetworkPilot(described(tmp_path, nodes, constants))


def test_a_torchscript_program_that_fails_is_refused_in_one_line(tmp_path: Path) -> None:
    class Fails(torch.nn.Module):
        def forward(self, image: torch.Tensor) -> torch.Tensor:
            steering = [1.0]
            return image.mean() * steering[5]

    torch.jit.script(Fails()).save(str(tmp_path / "network.pt"))
    (tmp_path / "network.yaml").write_text("file: network.pt\ninput: {size: [160, 320]}\n")
    with pytest.raises(DriverError, match=r"fails on a black image: .*index out of range"):
        DescribedNetworkPilot(tmp_path / "network.yaml")
