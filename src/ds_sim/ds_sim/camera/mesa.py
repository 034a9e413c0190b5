# SPDX-License-Identifier: Apache-2.0
"""Settings with which EGL draws without a display, by Mesa's software renderer, the same bits on every machine."""

from __future__ import annotations

from pathlib import Path

INSTALL = "install libegl1 libegl-mesa0 libgl1-mesa-dri (Debian, Ubuntu)"
"""What to do where EGL or Mesa is missing."""
MESA_VENDOR = Path("/usr/share/glvnd/egl_vendor.d/50_mesa.json")
ENVIRONMENT = {
    "EGL_PLATFORM": "surfaceless",  # needs neither a display nor a device
    "LIBGL_ALWAYS_SOFTWARE": "1",  # the same bits on machines with a GPU
    "GALLIUM_DRIVER": "llvmpipe",
    "LP_NUM_THREADS": "0",  # draw in the caller's thread
    "EGL_LOG_LEVEL": "fatal",  # it would print what an exception says
    "MESA_SHADER_CACHE_DISABLE": "true",  # it would start threads and write to the home folder
}


def software_rendering() -> dict[str, str]:
    """Environment variables for Mesa's software renderer, to be set before EGL is loaded."""
    vendor = {"__EGL_VENDOR_LIBRARY_FILENAMES": str(MESA_VENDOR)} if MESA_VENDOR.is_file() else {}
    return {**ENVIRONMENT, **vendor}
