# SPDX-License-Identifier: Apache-2.0
"""A process of a graph knows the user's ROS domain, in which a simulator of another project runs (`ros@FILE`)."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from ds_orchestrator.graph.supervisor import ProcessSpec, Supervisor


@pytest.mark.parametrize(("domain", "expected"), [(None, "0"), ("", "0"), ("7", "7")])
def test_the_users_domain_is_passed_on(
    domain: str | None, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "says_domain.py").write_text(
        "import os, pathlib, time\n"
        "pathlib.Path('domain').write_text(os.environ['DS_USER_ROS_DOMAIN_ID'])\n"
        "time.sleep(60)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    monkeypatch.delenv("DS_USER_ROS_DOMAIN_ID", raising=False)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    if domain is not None:
        monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    supervisor = Supervisor(
        [ProcessSpec(name="one", module="says_domain", parameters={})], domain=42, logs=tmp_path / "logs"
    )
    deadline = time.monotonic() + 30.0
    while not ((tmp_path / "domain").is_file() and (tmp_path / "domain").read_text()) and time.monotonic() < deadline:
        supervisor.check(["one"])
        time.sleep(0.05)
    supervisor.close()
    assert (tmp_path / "domain").read_text() == expected
