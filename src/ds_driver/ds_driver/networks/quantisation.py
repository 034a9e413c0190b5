# SPDX-License-Identifier: Apache-2.0
"""Quantises the convolutions of an ONNX graph to 8 bits after training (Jacob et al. 2018)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from ds_base.installation import CPUINFO, processor_flags
from ds_driver.networks.backends import BackendError, last_line, onnx_runner

Samples = Callable[[], Sequence[NDArray[Any]]]
"""Makes inputs of a network, with a batch of one."""
OPSET = 13
"""First ONNX opset in which each output of a layer has a scale of its own."""
_INSTRUCTIONS = frozenset(("avx512_vnni", "avx_vnni", "amx_int8"))
"""Flags of processors that sum products of 8 bits exactly; others saturate at 16 bits."""


def has_vnni(cpuinfo: Path = CPUINFO) -> bool:
    """Return whether 8 bits gain time on this processor, and give right sums."""
    return not processor_flags(cpuinfo).isdisjoint(_INSTRUCTIONS)


def for_backend(backend: str, content: bytes, where: str, samples: Samples) -> bytes:
    """Return an ONNX graph as a backend takes it: `quantised`, or as it is."""
    return quantised(content, where, samples) if backend == "openvino-int8" else content


def quantised(content: bytes, where: str, samples: Samples) -> bytes:
    """Quantise weights, and inputs of convolutions by their ranges over all samples; the rest is as it was.

    Args:
        content: ONNX graph with one input.
        where: name of the file, for messages.
        samples: makes the inputs.

    Raises:
        BackendError: the processor has no VNNI, or the graph has no convolution or cannot be quantised.
    """
    if not has_vnni():
        raise BackendError("this processor has no VNNI (AVX512_VNNI, AVX_VNNI or AMX): use the backend openvino")
    # These take 0.1 s and 16 MB to import.
    from onnxruntime.quantization import CalibrationMethod, QuantType
    from onnxruntime.quantization.calibrate import TensorsData
    from onnxruntime.quantization.qdq_quantizer import QDQQuantizer

    model = onnx.load_from_string(content)
    inputs = sorted({node.input[0] for node in model.graph.node if node.op_type == "Conv"})
    opset = next((used.version for used in model.opset_import if used.domain in ("", "ai.onnx")), 0)
    if not inputs or opset < OPSET:
        problem = f"has opset {opset}, expected {OPSET} or later" if inputs else "has no convolution"
        raise BackendError(f"{where} cannot be quantised, it {problem}: use another backend")
    ranges = _ranges(model, inputs, where, samples())
    try:
        quantiser = QDQQuantizer(
            model,
            per_channel=True,
            reduce_range=False,
            weight_qType=QuantType.QInt8,
            activation_qType=QuantType.QUInt8,
            tensors_range=TensorsData(CalibrationMethod.MinMax, ranges),
            nodes_to_quantize=[],
            nodes_to_exclude=[],
            op_types_to_quantize=["Conv"],
            # Outputs stay as they are, so that a convolution and its activation remain one kernel.
            extra_options={"OpTypesToExcludeOutputQuantization": ["Conv"], "QuantizeBias": False},
        )
        result: bytes = quantiser.quantize_model().SerializeToString()
    except Exception as error:  # graphs of others can raise anything
        raise BackendError(f"{where} cannot be quantised ({last_line(error)}): use another backend") from None
    return result


def _ranges(
    model: onnx.ModelProto, tensors: list[str], where: str, samples: Sequence[NDArray[Any]]
) -> dict[str, tuple[np.float32, np.float32]]:
    """Compute with one thread, as the library would not: the bits of the ranges are those of every drive."""
    asked = onnx.ModelProto()
    asked.CopyFrom(model)
    del asked.graph.output[:]
    asked.graph.output.extend(onnx.ValueInfoProto(name=name) for name in tensors)
    runner = onnx_runner(asked.SerializeToString(), where)
    seen = [[(part.min(), part.max()) for part in runner.compute(sample)] for sample in samples]
    extremes = np.array(seen, np.float32)
    return {n: (extremes[:, i, 0].min(), extremes[:, i, 1].max()) for i, n in enumerate(tensors)}
