# SPDX-License-Identifier: Apache-2.0
"""The driving networks in PyTorch: modules for training, their weights, and runners on one thread or on a GPU."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor, nn

from ds_base.folder_files import whole_file
from ds_driver.networks.architectures import (
    NETWORKS,
    Architecture,
    Conv,
    Dense,
    Dropout,
    Layer,
    MaxPool,
    UnknownNetworkError,
)
from ds_driver.networks.backends import BackendError, Runner, last_line, shape_and_type
from ds_driver.networks.weights import Weights, metadata_of


class DrivingNetwork(nn.Module):
    """Network of an `Architecture`, with random weights."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.features = nn.Sequential(*map(_module, architecture.features))
        self.steering = nn.Sequential(*map(_module, architecture.steering))
        if architecture.initialise_for_relu:
            for layer in self.features.modules():
                if isinstance(layer, nn.Conv2d):
                    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")

    def forward(self, image: Tensor) -> Tensor:
        """Predict steering for a batch of images."""
        result: Tensor = self.steering(self.features(image / 127.5 - 1.0))
        return result


class FastDropout(nn.Module):
    """Dropout as `architectures.Dropout` describes it, with random bits from NumPy, at a rate in steps of 1/65536.

    PyTorch draws one number a value on one thread, which took 38% of the time of Chauffeur's training on a processor;
    this takes a third of that. The generator is seeded from PyTorch's, so `torch.manual_seed` decides what is dropped.
    """

    def __init__(self, rate: float, *, rescale: bool) -> None:
        super().__init__()
        self.rate = rate
        self._scale = 1.0 / (1.0 - rate) if rescale else 1.0

    def forward(self, values: Tensor) -> Tensor:
        """Set each value to 0 with the given probability in training; return the values unchanged otherwise."""
        if not self.training:
            return values
        if values.device.type != "cpu" or values.dtype != torch.bfloat16:
            return nn.functional.dropout(values, self.rate).mul(self._scale * (1.0 - self.rate))
        factor = torch.tensor(self._scale, dtype=torch.bfloat16)
        pattern = int(factor.view(torch.int16).numpy().view(np.uint16))
        seed = int(torch.randint(2**62, (1,)))
        words = np.random.SFC64(seed).random_raw(-(-values.numel() // 4)).view(np.uint16)[: values.numel()]
        kept = (words >= round(self.rate * 65536)).view(np.uint8)
        mask = torch.from_numpy(np.multiply(kept, pattern, dtype=np.uint16).view(np.int16)).view(torch.bfloat16)
        if values.dim() == 4 and values.is_contiguous(memory_format=torch.channels_last):
            count, channels, rows, columns = values.shape
            return values * mask.view(count, rows, columns, channels).permute(0, 3, 1, 2)
        return values * mask.view(values.shape)


def disable_dropout(network: nn.Module) -> None:
    """Stop a network's dropout until `network.train()` is called again."""
    for layer in network.modules():
        if isinstance(layer, FastDropout):
            layer.eval()


def make_network(name: str) -> nn.Module:
    """Create an untrained network.

    Raises:
        UnknownNetworkError: no network has this name.
    """
    if name not in NETWORKS:
        raise UnknownNetworkError(f"unknown network {name!r}: expected one of {', '.join(NETWORKS)}, or a weights file")
    return DrivingNetwork(NETWORKS[name])


def module_of(weights: Weights) -> nn.Module:
    """Make the network of some weights; in evaluation mode, float32."""
    network = DrivingNetwork(weights.architecture)
    network.load_state_dict({name: torch.from_numpy(tensor) for name, tensor in weights.tensors.items()})
    return network.eval()


def save_weights(
    network: nn.Module, path: Path, *, architecture: str, generators: dict[str, str] | None = None
) -> None:
    """Write a network's weights as float16, which halves the file; `load_weights` returns float32."""
    tensors = {name: value.detach().to(torch.float16).contiguous() for name, value in network.state_dict().items()}
    with whole_file(path) as partial:
        save_file(tensors, partial, metadata=metadata_of(architecture, generators or {}))


def _module(layer: Layer) -> nn.Module:
    if isinstance(layer, Conv):
        before, after = layer.padding
        if before == after:
            return nn.Conv2d(layer.inputs, layer.filters, layer.kernel, stride=layer.stride, padding=before)
        convolution = nn.Conv2d(layer.inputs, layer.filters, layer.kernel, stride=layer.stride)
        return nn.Sequential(nn.ZeroPad2d((before, after, before, after)), convolution)
    if isinstance(layer, Dense):
        return nn.Linear(layer.inputs, layer.outputs)
    if isinstance(layer, MaxPool):
        return nn.MaxPool2d(layer.size)
    if isinstance(layer, Dropout):
        return FastDropout(layer.rate, rescale=layer.rescale)
    return {"Elu": nn.ELU, "Relu": nn.ReLU, "Flatten": nn.Flatten}[layer.kind]()


def torch_device(name: str) -> torch.device:
    """Return the PyTorch device of a name; a BackendError if a GPU is requested and there is none."""
    if name == "cuda" and not torch.cuda.is_available():
        raise BackendError("PyTorch finds no usable GPU: leave out --device cuda, or install PyTorch for CUDA")
    return torch.device(name)


def torch_runner(network: Callable[..., Any], device: torch.device) -> Runner:
    """Run a network that maps tensors to a tensor or a sequence of tensors, and is on the device already."""
    torch.set_num_threads(1)

    @torch.inference_mode()
    def compute(*inputs: NDArray[Any]) -> list[NDArray[np.float32]]:
        try:
            outputs = network(*(torch.from_numpy(one).to(device) for one in inputs))
        except Exception as error:  # TorchScript raises whatever its program raises: IndexError, KeyError, ...
            raise BackendError(f"the network rejects {shape_and_type(*inputs)}: {last_line(error)}") from None
        parts: Sequence[Any] = outputs if isinstance(outputs, (tuple, list)) else [outputs]
        if not parts or not all(isinstance(part, torch.Tensor) for part in parts):
            raise BackendError(f"the network returns {type(outputs).__name__}: expected a tensor or a tuple of them")
        return [part.float().cpu().numpy() for part in parts]

    return Runner(compute)


def replayed(network: Callable[[Tensor], Tensor], device: torch.device) -> Callable[[Tensor], Tensor]:
    """Record the kernels of a network that does the same for every input of a shape, and replay them.

    Launching each anew takes longer than they do. On a processor the network is returned as it is.
    """
    if device.type != "cuda":
        return network
    recorded: dict[torch.Size, tuple[Tensor, torch.cuda.CUDAGraph, Tensor]] = {}

    def replay(batch: Tensor) -> Tensor:
        if batch.shape not in recorded:
            held, graph, side = batch.clone(), torch.cuda.CUDAGraph(), torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):  # libraries choose their kernels and memory before anything is recorded
                for _ in range(3):
                    network(held)
            torch.cuda.current_stream().wait_stream(side)
            with torch.cuda.graph(graph):
                outputs = network(held)
            recorded[batch.shape] = held, graph, outputs
        held, graph, outputs = recorded[batch.shape]
        held.copy_(batch)
        graph.replay()
        return outputs

    return replay


def network_runner(weights: Weights, device: str) -> Runner:
    """Run one of the paper's networks on images from `ds_driver.networks.images.prepare`."""
    where = torch_device(device)
    network = module_of(weights).to(memory_format=torch.channels_last).to(where)  # type: ignore[call-overload]
    return torch_runner(replayed(lambda batch: network(batch.permute(0, 3, 1, 2).float()), where), where)


def torchscript_runner(content: bytes, device: torch.device, where: str) -> Runner:
    """Run a TorchScript file with PyTorch; a BackendError if it is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch still reads TorchScript, which it deprecates
        try:
            network = torch.jit.load(BytesIO(content), map_location=device).eval()
        except Exception as error:  # damaged archives make the reader raise arbitrary errors
            raise BackendError(
                f"{where} cannot be read as TorchScript ({last_line(error)}): save it again with "
                "torch.jit.trace(network, image).save"
            ) from None
    return torch_runner(network, device)
