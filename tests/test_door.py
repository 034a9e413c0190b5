# SPDX-License-Identifier: Apache-2.0
"""Every file of the product is read and written through the door: the modules of `ds_base` that check what it is."""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from ds_base.folder_files import StoreError, enter_folder, place_folder, write_whole

DOOR = {"bounded_file", "bounded_memory", "bounded_tables", "folder_files"}
DOOR_CALLS = {"read_table", "read_parquet", "read_csv"}
"""Functions of this project of the same names as those of libraries, which are called by their module."""
OPENED = {"whole_file", "open_regular"}
"""Functions of the door whose result libraries may read or write."""
CALLS = re.compile(
    r"(.*\.)?(f?d?open|(read|write)_(text|bytes|table)|im(read|write|decode)|Parquet(File|Writer|Dataset)|(to|read)_parquet"
    r"|to_csv|read_(metadata|schema)|save(fig|z|z_compressed|_file)|safe_open|loadtxt|genfromtxt|fromfile|tofile|memmap"
    r"|mkdir|makedirs|renames?|(sym|hard)link_to|touch|copy(file|2|tree|fileobj)|mk[ds]temp|NamedTemporaryFile|ZipFile"
    r"|iterparse|VideoCapture)|json\.loads?|(np|torch)\.(load|save)|sqlite3\.connect|pd\.read_(csv|json)|os\.replace"
    r"|shutil\.(copy|move)|Image\.open|ElementTree\.parse|yaml\.(safe_)?load"
)
"""Names of functions that read or write what a path names, or that build values without limits."""
EXCEPTIONS = {
    "ds_base/installation.py read_text": "the kernel's /proc/cpuinfo",
    "ds_base/processes.py *": "log of an own child, which appends to it",
    "ds_bags/layout.py mkdtemp": "hidden folder of a new name, beside the one that it becomes",
    "ds_bags/reader.py sqlite3.connect": "checked as a regular file, read only and without journals",
    "ds_bags/reader.py self._reader.open": "library for bags, whose files were checked",
    "ds_bags/rosbag2_writer.py *": "a bag grows while it is recorded, in a folder that is new",
    "ds_cli/application.py NamedTemporaryFile": "report of a bug, of a new name",
    "ds_cli/doctor.py *": "runs before anything is installed, on the checkout's own files",
    "ds_cli/main.py *": "standard output and error, and this checkout's version, before anything is installed",
    "ds_driver/closed_loop/*.py json.loads": "messages of an own child",
    "ds_driver/networks/network_file.py zipfile.ZipFile": "names in the memory of a file that was read",
    "ds_driver/networks/images.py cv2.imdecode": "the door of images, which knows their pixels before",
    "ds_driver/networks/weights.py safe_open": "checked as a regular file; numbers without a length of their own",
    "ds_driver/sim2real/generator.py safe_open": "the same",
    "ds_orchestrator/graph/session.py os.open": "lock in /tmp that users share, opened without writing",
    "ds_orchestrator/store/sqlite_file.py sqlite3.connect": "SQLite's own file, checked before",
    "ds_report/watch/server.py json.loads": "text of this process",
    "ds_sim/testing.py read_text": "the kernel's /proc/self/statm",
    "ds_sim/video.py *": "OpenCV writes by a name that ends in .mp4, beside the video",
    "ds_sim_bullet/vehicle.py os.open": "/dev/null",
    "ds_sim_ros/ros/link.py os.open": "lock of one's own, without following links",
    "ds_sim_torcs/*.py *": "private folder and installed files of TORCS",
}
"""Module below its package's parent and call, as patterns -> why it needs no door."""


def calls(node: ast.AST, opened: frozenset[str] = frozenset()) -> Iterator[str]:
    """Names of calls that read or write, except on what the door has opened."""
    if isinstance(node, ast.With):
        for item in node.items:
            made = item.context_expr
            name = ast.unparse(made.func) if isinstance(made, ast.Call) else ""
            used = {one.id for one in ast.walk(made) if isinstance(one, ast.Name)}
            if isinstance(item.optional_vars, ast.Name) and (name in OPENED or used & opened):
                opened |= {item.optional_vars.id}
    if isinstance(node, ast.Call):
        name = ast.unparse(node.func)
        used = {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}
        to_text = name.endswith(".to_csv") and not node.args
        named = isinstance(node.func, ast.Attribute) and node.func.attr == "rename" and node.keywords
        if CALLS.fullmatch(name) and name not in DOOR_CALLS and not (used & opened or to_text or named):
            yield name if len(name) < 40 and "(" not in name else name.rpartition(".")[2]
    for child in ast.iter_child_nodes(node):
        yield from calls(child, opened)


def test_every_file_goes_through_the_door() -> None:
    found: dict[str, list[str]] = {}
    for path in sorted([*Path("src").glob("*/ds_*/**/*.py"), *Path("plugins").glob("*/ds_*/**/*.py")]):
        module = "/".join(path.parts[2:])
        if path.parts[1] != "ds_base" or path.stem not in DOOR:
            for name in calls(ast.parse(path.read_text())):
                key = f"{module} {name}"
                excused = (one for one in EXCEPTIONS if fnmatch(key, one) or fnmatch(key, one.replace(" ", " *.")))
                found.setdefault(next(excused, ""), []).append(key)
    assert not found.get(""), f"these go past ds_base.bounded_* and folder_files: {found['']}"
    assert set(found) == set(EXCEPTIONS), f"exceptions without a call: {set(EXCEPTIONS) - set(found)}"


def test_nothing_is_written_through_a_link_or_to_a_device(tmp_path: Path) -> None:
    out, other = tmp_path / "out", tmp_path / "other"
    other.mkdir()
    (other / "mine").write_text("mine")
    enter_folder(out)
    (out / "file").symlink_to(other / "mine")
    (out / f".file.{os.getpid()}.partial").symlink_to(other / "mine")
    write_whole(out / "file", "new")
    assert (other / "mine").read_text() == "mine" and not (out / "file").is_symlink()
    (out / "sub").symlink_to(other)
    attempts: list[Callable[[], object]] = [
        lambda: write_whole(out / "sub" / "x" / "file", "new"),
        lambda: enter_folder(out / "sub"),
        lambda: enter_folder(out / "sub" / "x"),
        lambda: place_folder(out, out / "sub" / "made"),
    ]
    for attempt in attempts:
        with pytest.raises(StoreError, match="sub is a link"):
            attempt()
    assert [path.name for path in other.iterdir()] == ["mine"]
    with pytest.raises(StoreError, match="neither a file"):
        write_whole(Path("/dev/null"), "new")


def test_the_table_of_limits_is_that_of_the_code() -> None:
    table = Path("SECURITY.md").read_text().partition("## Limits")[2].partition("\n## ")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if "`ds_" in line]
    assert len(rows) > 20
    for _, limit, names in rows:
        values = [constant(name) for name in re.findall(r"`([\w.]+)`", names)]
        assert [number_of(one) for one in limit.split(";")] == values, f"{limit} for {names}, which is {values}"


def constant(name: str) -> Any:
    module, attribute = re.fullmatch(r"([a-z_.\d]+)\.([A-Z].*)", name).groups()  # type: ignore[union-attr]
    return attrgetter(attribute)(import_module(module))


def number_of(text: str) -> int:
    """Value of a cell such as `16 MiB`, `2,000` or `10 km`."""
    number, unit = re.fullmatch(r"\s*([\d,]+)\s*(\w*)\s*", text).groups()  # type: ignore[union-attr]
    return int(number.replace(",", "")) * {"KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "km": 1000}.get(unit, 1)
