# SPDX-License-Identifier: Apache-2.0
"""The documentation matches the code: code of pages, of the notebook and of docstrings runs, every key exists."""

from __future__ import annotations

import doctest
import json
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from ds_orchestrator.campaign.config import CampaignConfig

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


@pytest.mark.timeout(600)
def test_the_python_api_runs_as_written(tmp_path: Path) -> None:
    """In a process in which ROS cannot be imported, with shorter searches and a faster driver."""
    (tmp_path / "page.py").write_text(short_script())
    done = subprocess.run([sys.executable, "page.py"], cwd=tmp_path, capture_output=True, text=True, timeout=580)
    assert done.returncode == 0, done.stderr[-2000:]
    assert {"roads.json", "drive.png", "failures.json"} <= {path.name for path in tmp_path.iterdir()}
    assert (tmp_path / "campaign/report.html").is_file() and "twin_donkey" in done.stdout


def keys(model: BaseModel, prefix: str = "") -> dict[str, Any]:
    """List every key of a configuration with its value as a file would have it, sections flattened."""
    found: dict[str, Any] = {}
    written = model.model_dump(mode="json")
    for name in type(model).model_fields:
        value = getattr(model, name)
        found |= keys(value, f"{prefix}{name}.") if isinstance(value, BaseModel) else {prefix + name: written[name]}
    return found


def test_the_configuration_page_has_every_key_with_its_default() -> None:
    rows = re.findall(r"^\| `([a-z0-9_.]+)` \| `(.*?)` \|", (DOCS / "configuration.md").read_text(), re.MULTILINE)
    assert {key: json.loads(default) for key, default in rows} == keys(CampaignConfig())


def test_every_benchmark_that_a_page_names_can_be_started() -> None:
    """As a module from the root: a file that is started by its path cannot import the others."""
    pages = "".join(page.read_text() for page in DOCS.glob("*.md"))
    modules = set(re.findall(r"python -m (benchmarks[\w.]+)", pages))
    assert len(modules) > 10 and all((ROOT / f"{name.replace('.', '/')}.py").is_file() for name in modules)
    assert "python benchmarks/" not in pages


def test_every_cell_of_the_notebook_runs_and_the_last_one_names_every_drive(tmp_path: Path) -> None:
    """In an empty folder, with a driver that is quicker than a network."""
    notebook = json.loads((ROOT / "examples/first_look.ipynb").read_text())
    assert notebook["nbformat"] == 4 and not any(cell.get("outputs") for cell in notebook["cells"])
    script = "\n".join("".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code")
    network = 'DRIVER = "dave2_short"'
    assert script.count(network) == 1
    script = "import sys\nsys.modules['rclpy'] = None\n" + script.replace(network, 'DRIVER = "autopilot"')
    env, command = os.environ | {"MPLBACKEND": "agg"}, [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    first, *_ = done.stdout.splitlines()
    assert re.match(r"[A-Z_]+ after [\d.]+ s, closest to the edge of the lane: -?[\d.]+ m", first)
    drives = re.findall(r"^(softbody-0-000\d) +(\w+) +(\w+) +[+-]", done.stdout, re.MULTILINE)
    assert {(test, simulator) for test, simulator, _ in drives} == {
        (f"softbody-0-000{number}", name) for number in (0, 1) for name in ("softbody", "donkey")
    }
    assert (tmp_path / "first_look" / "report.html").is_file()


def short_script(*, gymnasium: bool = True) -> str:
    """The blocks of the Python API's page as one script without ROS, with shorter searches and a faster driver."""
    blocks = re.findall(r"^```python\n(.*?)^```", (DOCS / "python_api.md").read_text(), re.MULTILINE | re.DOTALL)
    if not gymnasium:
        blocks = [block for block in blocks if "gymnasium" not in block]
    script = "import sys\nsys.modules['rclpy'] = None\n" + "\n".join(blocks)
    for long, quick in (
        ("population=10, iterations=20", "population=1, iterations=0"),
        ('"iterations": 1', '"iterations": 0'),
        ('make_driver("dave2_short", ', 'make_driver("autopilot", '),
    ):
        assert script.count(long) == 1, long
        script = script.replace(long, quick)
    return script


SOURCE = ROOT / "src"
FILES = sorted(file for file in SOURCE.glob("ds_*/ds_*/**/*.py") if ">>> " in file.read_text())


def test_every_package_of_the_api_has_examples() -> None:
    packages = {file.relative_to(SOURCE).parts[0] for file in FILES}
    assert {"ds_analysis", "ds_bags", "ds_driver", "ds_orchestrator", "ds_road", "ds_sim"} <= packages


@pytest.mark.parametrize("file", FILES, ids=lambda file: "/".join(file.relative_to(SOURCE).parts[1:]))
def test_examples_give_what_they_say(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    module = import_module(".".join(file.relative_to(SOURCE).with_suffix("").parts[1:]))
    examples = [test for test in doctest.DocTestFinder(exclude_empty=True).find(module) if test.examples]
    assert examples, "no example is found: it is not in a docstring of a public name"
    runner, report = doctest.DocTestRunner(), list[str]()
    for test in examples:
        runner.run(test, out=report.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(report)
