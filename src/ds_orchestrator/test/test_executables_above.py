# SPDX-License-Identifier: Apache-2.0
"""Executables of what lies above this package."""

from __future__ import annotations

import pytest

from ds_orchestrator import executables


def test_an_executable_of_a_package_that_is_not_built_says_how_to_build_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executables, "ABOVE", "not_built.ros.executables")
    with pytest.raises(
        SystemExit, match="orchestrator: not_built is not in this workspace.*--packages-up-to ds_bringup"
    ):
        executables.orchestrator()
