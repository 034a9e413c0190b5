"""Translates camera images with a generator, for training data and for driving alike: the same bits in both."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ds_driver.networks.backends import Runner, onnx_runner, openvino_runner
from ds_driver.sim2real.generator_file import StoredGenerator
from ds_driver.sim2real.generator_onnx import generator_to_onnx
from ds_driver.sim2real.window import Sim2RealError, prepare, resize
from ds_sim.camera.spec import IMAGE_HEIGHT, IMAGE_WIDTH

BACKENDS = ("onnx", "openvino", "openvino-bf16", "torch")


class Translator:
    """Translates images, without state: an image has the same bits alone and in any batch.

    Args:
        generator: a stored generator.
        backend: one of `BACKENDS`; results differ between them by a grey level or so.
        device: `cpu`, or `cuda` with PyTorch.

    Raises:
        Sim2RealError: the backend is unknown.
        ds_driver.networks.backends.BackendError: the backend is not installed.
    """

    def __init__(self, generator: StoredGenerator, backend: str = "onnx", device: str = "cpu") -> None:
        if backend not in BACKENDS:
            raise Sim2RealError(f"unknown backend {backend!r}: expected one of {', '.join(BACKENDS)}")
        self.generator = generator
        self.backend = backend
        self._runner = _runner(generator, backend, device)

    def prepared(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Cut out and resize what the generator sees of a camera image: (rows, columns, 3) uint8 RGB of its size."""
        return prepare(image, self.generator.window, self.generator.shape.size)

    def small(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Translate a prepared image, in the generator's size."""
        return self._runner.compute(image[None])[0][0].astype(np.uint8)

    def translate(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Translate a camera image.

        Args:
            image: (160, 320, 3) uint8 RGB.

        Returns:
            The generator's window of it, translated, as a whole image of (160, 320, 3): it is not to be cropped again.

        Raises:
            Sim2RealError: the image has another size than the camera of the generator's simulator.
        """
        return self.translate_all([image])[0]

    def translate_all(self, images: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
        """Translate camera images, as many at once as the backend takes; see `translate`."""
        for image in images:
            if image.shape != (IMAGE_HEIGHT, IMAGE_WIDTH, 3):
                raise Sim2RealError(
                    f"image of shape {image.shape}, expected ({IMAGE_HEIGHT}, {IMAGE_WIDTH}, 3): the generator "
                    "translates camera images of simulators"
                )
        prepared, size = [self.prepared(image) for image in images], self._runner.largest_batch
        parts = (np.stack(prepared[begin : begin + size]) for begin in range(0, len(prepared), size))
        translated = (image for part in parts for image in self._runner.compute(part)[0].astype(np.uint8))
        return [resize(image, (IMAGE_HEIGHT, IMAGE_WIDTH)) for image in translated]


def _runner(generator: StoredGenerator, backend: str, device: str) -> Runner:
    if backend == "torch":
        return _torch_runner(generator, device)
    content = generator_to_onnx(generator)
    if backend == "onnx":
        return onnx_runner(content, "the generator")
    return openvino_runner(content, "the generator", bf16=backend == "openvino-bf16", batches=True)


def _torch_runner(generator: StoredGenerator, device: str) -> Runner:
    """Run a generator with PyTorch, which takes 2 s and 200 MB to import and is therefore imported on demand."""
    import torch

    from ds_driver.networks.torch_networks import torch_device, torch_runner
    from ds_driver.sim2real.networks import Generator, to_batch, to_images

    where = torch_device(device)
    network = Generator(generator.shape)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in generator.tensors.items()})
    network = network.eval().to(memory_format=torch.channels_last).to(where)  # type: ignore[call-overload]
    return torch_runner(lambda images: to_images(network(to_batch(images))), where)
