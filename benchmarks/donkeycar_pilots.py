# SPDX-License-Identifier: Apache-2.0
"""Makes one network of every kind of pilot of Donkey Car 5.3.0, with its own package, and its answers to frames.

Runs in an environment of its own, as TensorFlow is for making files only:

    pip install donkeycar==5.3.0 tensorflow-cpu==2.15.1 tf2onnx==1.16.1 opencv-python-headless==4.9.0.80 matplotlib
    python benchmarks/donkeycar_pilots.py pilots.zip

The zip holds, for each kind, `KIND.onnx` and `KIND.npy`: (frames, 2) angle and
throttle of the pilot's `run` over the frames of `frames.npy`, (n, 5, 10, 3) RGB blocks of 32 x 32 pixels, each brought
to the pilot's size by `cv2.resize`. Weights are random, rounded so that the zip is small. `latent` is missing: its
`run` fails in that version. src/ds_studies/test/test_network_check.py compares.
"""

from __future__ import annotations

import io
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE = (80, 96)
"""Rows and columns of most pilots; chosen: about the smallest that they take."""
FRAMES = 8
LEVELS = 4
"""Weights are multiples of their largest over this."""
CONSTANT = {"behavior": [1.0, 0.0], "imu": [0.0] * 6}
"""Kind -> what its other input gets."""


def frames() -> NDArray[np.uint8]:
    """Draw blocks of frames, each a mixture of the one before and of new ones."""
    rng, blocks = np.random.default_rng(5), []
    last = np.zeros((5, 10, 3))
    for _ in range(FRAMES):
        last = 0.3 * last + 0.7 * rng.uniform(0, 255, last.shape)
        blocks.append(last.astype(np.uint8))
    return np.stack(blocks)


def pilots() -> dict[str, Callable[[Any], Any]]:
    """Return what makes a pilot of each kind from an interpreter."""
    from donkeycar.parts import keras as donkey  # type: ignore[import-not-found]

    shape = (*SIZE, 3)
    return {
        "linear": lambda i: donkey.KerasLinear(i, shape),
        "categorical": lambda i: donkey.KerasCategorical(i, shape),
        "inferred": lambda i: donkey.KerasInferred(i, shape),
        "memory": lambda i: donkey.KerasMemory(i, shape, mem_length=3),
        "behavior": lambda i: donkey.KerasBehavioral(i, shape),
        "imu": lambda i: donkey.KerasIMU(i, shape),
        "localizer": lambda i: donkey.KerasLocalizer(i, shape),
        "rnn": lambda i: donkey.KerasLSTM(i, shape, seq_length=3),
        "3d": lambda i: donkey.Keras3D_CNN(i, (48, 48, 3), seq_length=5),
    }


def rounded(weights: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Round random weights to few levels, and give biases, which Keras starts at 0, some."""
    if weights.ndim == 1:
        weights = rng.uniform(0.02, 0.1, weights.shape).astype(np.float32)
    step = np.abs(weights).max() / LEVELS
    stronger = 2.0 if weights.ndim == 2 else 1.0  # otherwise all frames fall into the same bin
    return (np.rint(weights / step) * step * stronger).astype(np.float32)


def main(out: Path) -> None:
    """Make all pilots and write them."""
    import tensorflow as tf  # type: ignore[import-not-found]
    import tf2onnx  # type: ignore[import-not-found]
    from donkeycar.parts.interpreter import KerasInterpreter  # type: ignore[import-not-found]

    blocks = frames()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_LZMA) as packed, tempfile.TemporaryDirectory() as folder:

        def keep(name: str, array: NDArray[Any]) -> None:
            held = io.BytesIO()
            np.save(held, array)
            packed.writestr(name, held.getvalue())

        keep("frames.npy", blocks)
        for kind, make in pilots().items():
            tf.keras.backend.clear_session()
            tf.keras.utils.set_random_seed(7)
            rng = np.random.default_rng(7)
            pilot = make(KerasInterpreter())
            model = pilot.interpreter.model
            model.set_weights([rounded(one, rng) for one in model.get_weights()])
            answers = []
            for frame in blocks:
                whole = np.kron(frame, np.ones((32, 32, 1), np.uint8))
                small = cv2.resize(whole, pilot.input_shape[1::-1], interpolation=cv2.INTER_LINEAR)
                answer = pilot.run(small, *([CONSTANT[kind]] if kind in CONSTANT else []))
                answers.append([float(np.squeeze(one)) for one in answer[:2]])
            keep(f"{kind}.npy", np.array(answers))
            tf2onnx.convert.from_keras(model, opset=13, output_path=f"{folder}/{kind}.onnx")
            packed.write(f"{folder}/{kind}.onnx", f"{kind}.onnx")
            print(kind, np.round(answers, 4).tolist())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
