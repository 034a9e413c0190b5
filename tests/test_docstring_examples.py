# SPDX-License-Identifier: Apache-2.0
"""Examples in docstrings give what they say, each module's in an empty folder."""

from __future__ import annotations

import doctest
from importlib import import_module
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src"
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
