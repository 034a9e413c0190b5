# SPDX-License-Identifier: Apache-2.0
"""Where shared files are looked for."""

from __future__ import annotations

import pytest

from ds_base.installation import share_folders


def test_a_checkout_without_a_workspace_has_its_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    assert any((folder / "msg/Road.msg").is_file() for folder in share_folders("ds_interfaces"))
