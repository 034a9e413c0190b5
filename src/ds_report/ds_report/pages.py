# SPDX-License-Identifier: Apache-2.0
"""Templates of all pages: single HTML files that open offline, with the same style and colours."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from numpy.typing import NDArray

from ds_base import palette
from ds_base.folder_files import write_whole
from ds_base.words import count, duration
from ds_sim.camera.encodings import png


def write_page(path: Path, template: str, **values: Any) -> Path:
    """Write a page as one file; returns its path."""
    write_whole(path, render(template, **values))
    return path


def render(template: str, **values: Any) -> str:
    """Render a page."""
    return environment().get_template(template).render(**values)


def environment() -> Environment:
    """Environment of the pages' templates."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader("ds_report"), PackageLoader("ds_report.watch")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    environment.filters |= {"count": count, "duration": duration, "code": _code}
    environment.globals["palette"] = palette
    return environment


def _code(sentence: str) -> Markup:
    """Escape a sentence that a terminal shows, too, and set what stands between its backticks as code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(sentence))))


def data_address(picture: NDArray[np.uint8]) -> str:
    """Encode an RGB picture, (rows, columns, 3) uint8, as the address of a PNG."""
    return f"data:image/png;base64,{base64.b64encode(png(picture)).decode()}"
