# SPDX-License-Identifier: Apache-2.0
"""Received network files: memory is bounded, and no other file is read."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.pilot import DriverError


def write(folder: Path, nodes: list[onnx.NodeProto], constants: list[onnx.TensorProto]) -> Path:
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 160, 320])],
        [helper.make_tensor_value_info("out", TensorProto.FLOAT, None)],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    (folder / "network.onnx").write_bytes(model.SerializeToString())
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
        DescribedNetworkPilot(write(tmp_path, nodes, [shape]))
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
            DescribedNetworkPilot(write(tmp_path, nodes, constants))


def test_a_torchscript_program_that_fails_is_refused_in_one_line(tmp_path: Path) -> None:
    class Fails(torch.nn.Module):
        def forward(self, image: torch.Tensor) -> torch.Tensor:
            steering = [1.0]
            return image.mean() * steering[5]

    torch.jit.script(Fails()).save(str(tmp_path / "network.pt"))
    (tmp_path / "network.yaml").write_text("file: network.pt\ninput: {size: [160, 320]}\n")
    with pytest.raises(DriverError, match=r"fails on a black image: .*index out of range"):
        DescribedNetworkPilot(tmp_path / "network.yaml")
