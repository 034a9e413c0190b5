"""Runs networks with PyTorch, on one thread or on a GPU."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from io import BytesIO
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ds_driver.networks.backends import BackendError, Runner, last_line, shape_and_type


def torch_device(name: str) -> torch.device:
    """Return the PyTorch device of a name.

    Raises:
        BackendError: a GPU is requested and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise BackendError("PyTorch finds no usable GPU: leave out --device cuda, or install PyTorch for CUDA")
    return torch.device(name)


def torch_runner(network: Callable[[torch.Tensor], Any], device: torch.device) -> Runner:
    """Run a network with PyTorch.

    Args:
        network: maps one tensor to a tensor or a sequence of tensors; already on the device.
        device: device of the network.
    """
    torch.set_num_threads(1)

    @torch.inference_mode()
    def compute(batch: NDArray[Any]) -> list[NDArray[np.float32]]:
        try:
            found = network(torch.from_numpy(batch).to(device))
        except Exception as error:  # TorchScript raises whatever its program raises: IndexError, KeyError, ...
            raise BackendError(f"the network rejects {shape_and_type(batch)}: {last_line(error)}") from None
        parts: Sequence[Any] = found if isinstance(found, (tuple, list)) else [found]
        if not parts or not all(isinstance(part, torch.Tensor) for part in parts):
            raise BackendError(f"the network returns {type(found).__name__}: expected a tensor or a tuple of them")
        return [part.float().cpu().numpy() for part in parts]

    return Runner(compute)


def torchscript_runner(content: bytes, device: torch.device, where: str) -> Runner:
    """Run a TorchScript file with PyTorch.

    Args:
        content: content of the file.
        device: device to run on.
        where: name of the file, for messages.

    Raises:
        BackendError: the file is not TorchScript.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch still reads TorchScript, which it deprecates
        try:
            network = torch.jit.load(BytesIO(content), map_location=device).eval()
        except Exception as error:  # damaged archives make the reader raise arbitrary errors
            raise BackendError(
                f"{where} is not TorchScript ({last_line(error)}): save it with torch.jit.trace(network, image).save"
            ) from None
    return torch_runner(network, device)
