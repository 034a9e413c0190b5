# SPDX-License-Identifier: Apache-2.0
"""Panda3D's engine, headless on Mesa's software renderer: one for each process, shared by all scenes."""

from __future__ import annotations

import ctypes
import importlib
import os
import threading
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ds_sim.camera.mesa import ENVIRONMENT, INSTALL, software_rendering
from ds_sim.simulator import SimulatorError
from ds_sim_panda.scene.parameters import SAMPLES

CONFIGURATION = """
load-display p3headlessgl
audio-library-name null
notify-level error
garbage-collect-states #f
textures-power-2 none
texture-anisotropic-degree 1
gl-check-errors #f
"""
_lock = threading.RLock()


@cache
def panda() -> Any:
    """Import Panda3D's classes; ImportError if it is not installed."""
    try:
        core = importlib.import_module("panda3d.core")
    except ImportError as error:
        raise ImportError(f"the panda simulator needs Panda3D ({error}): pip install panda3d") from None
    core.load_prc_file_data("ds_sim_panda", CONFIGURATION)
    return core


def graphics() -> Graphics:
    """Graphics of this process; SimulatorError if EGL or Mesa's software renderer is missing."""
    with _lock:
        return _made()


class Graphics:
    """Draws scenes into memory; calls may come from any thread, one after the other.

    After each drawing, the thread gives the context of OpenGL back, as only one thread can hold it.
    """

    def __init__(self) -> None:
        core = panda()
        for name, value in software_rendering().items():
            os.environ.setdefault(name, value)
        self._messages = core.StringStream()
        core.Notify.ptr().set_ostream_ptr(self._messages, False)
        self._egl = _egl()
        self._pipe = core.GraphicsPipeSelection.get_global_ptr().make_pipe("eglGraphicsPipe", "p3headlessgl")
        if self._pipe is None:
            raise SimulatorError(f"the panda simulator cannot draw: Panda3D finds no EGL display: {INSTALL}")
        self._engine = core.GraphicsEngine(self._pipe)
        self._targets: dict[tuple[int, int, int], tuple[Any, Any, Any]] = {}
        self._host: Any = None
        self._host = self._target(16, 16, SAMPLES)[0]
        driver = self._host.get_gsg()
        self.renderer = f"{driver.driver_version.split(') ')[-1]}, {driver.driver_renderer}"

    def draw(self, camera: Any, width: int, height: int, *, top: int = 0, samples: int = SAMPLES) -> NDArray[np.uint8]:
        """Draw what a camera, a `NodePath`, sees from the row `top` on; the bits of the other rows do not depend on it.

        The image is (rows, columns, 3) uint8 BGR, bottom row first, read-only, and not changed by the next drawing.
        """
        drawn = height - top
        with _lock:
            buffer, region, texture = self._target(width, drawn, samples)
            # The image reaches beyond the buffer: leaving out rows of a larger one would take more time.
            region.set_dimensions(0.0, 1.0, 0.0, height / drawn)
            region.set_camera(camera)
            buffer.set_active(True)
            try:
                self._engine.render_frame()
                image = np.frombuffer(texture.get_ram_image(), np.uint8)
            finally:
                buffer.set_active(False)
                region.set_camera(panda().NodePath())
                self._release()
            if len(image) != width * drawn * 3:
                raise SimulatorError(f"the panda simulator cannot draw: {self._last_message()}")
            return image.reshape(drawn, width, 3)

    def _target(self, width: int, height: int, samples: int) -> tuple[Any, Any, Any]:
        """Off-screen buffer, its display region, and the texture that receives a copy of each drawing."""
        key = (width, height, samples)
        if key in self._targets:
            return self._targets[key]
        core = panda()
        properties = core.FrameBufferProperties()
        properties.set_rgba_bits(8, 8, 8, 0)
        properties.set_depth_bits(24)
        properties.set_multisamples(samples)
        flags = core.GraphicsPipe.BF_refuse_window | core.GraphicsPipe.BF_fb_props_optional
        size = core.WindowProperties.size(width, height)
        buffer = self._engine.make_output(
            self._pipe,
            f"image {key}",
            0,
            properties,
            size,
            flags,
            *([self._host.get_gsg(), self._host] if self._host else []),
        )
        if buffer is None:
            raise SimulatorError(f"the panda simulator cannot draw: OpenGL does not start: {INSTALL}")
        texture = core.Texture("image")
        texture.set_keep_ram_image(True)
        buffer.add_render_texture(texture, core.GraphicsOutput.RTM_copy_ram)
        self._engine.open_windows()
        self._release()
        gsg = buffer.get_gsg()
        if not buffer.is_valid() or "llvmpipe" not in gsg.driver_renderer:
            raise SimulatorError(
                f"the panda simulator draws with Mesa's llvmpipe only, found {gsg.driver_renderer or 'nothing'}: "
                f"unset {', '.join(ENVIRONMENT)}, or {INSTALL}"
            )
        buffer.set_clear_color_active(True)
        buffer.set_clear_depth_active(True)
        buffer.set_clear_color((0.0, 0.0, 0.0, 1.0))
        buffer.set_active(False)
        region = buffer.make_display_region()
        self._targets[key] = (buffer, region, texture)
        return self._targets[key]

    def _release(self) -> None:
        """Give the context back, so that another thread can draw next."""
        self._egl.eglMakeCurrent(self._egl.eglGetCurrentDisplay(), None, None, None)

    def _last_message(self) -> str:
        lines = bytes(self._messages.get_data()).decode(errors="replace").split("\n")
        return next((line for line in reversed(lines) if line.strip()), "Panda3D gives no reason")


_made = cache(Graphics)
"""The one of this process."""


def _egl() -> Any:
    """Library of EGL, loaded."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        raise SimulatorError(f"the panda simulator cannot draw: libEGL.so.1 is missing: {INSTALL}") from None
    egl.eglGetCurrentDisplay.restype = ctypes.c_void_p
    egl.eglMakeCurrent.argtypes = [ctypes.c_void_p] * 4
    return egl
