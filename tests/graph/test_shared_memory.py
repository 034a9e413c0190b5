"""Shared memory of a node that was killed is removed, that of a living one is not."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ds_orchestrator.graph.shared_memory import FOLDER, remove_leftovers

pytestmark = pytest.mark.graph

NODE = "import rclpy; rclpy.init(); n = rclpy.create_node('n'); print('up', flush=True); rclpy.spin(n)"


def start(domain: int) -> subprocess.Popen[str]:
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    process = subprocess.Popen([sys.executable, "-c", NODE], stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None and process.stdout.readline() == "up\n"
    return process


def segments(process: subprocess.Popen[str]) -> set[str]:
    """List the process's own segments; ports are shared between the processes of a domain."""
    lines = Path(f"/proc/{process.pid}/maps").read_text().splitlines()
    names = {line.partition(f"{FOLDER}/")[2] for line in lines if f"{FOLDER}/fastrtps_" in line}
    return {name for name in names if "_port" not in name}


def test_what_a_killed_process_leaves_is_removed_and_what_a_living_one_uses_stays() -> None:
    """In two domains: a process maps the segments of all its peers."""
    from ds_orchestrator.graph.ros_domain import RosDomain

    domains = RosDomain(), RosDomain()
    killed, living = (start(domain.number) for domain in domains)
    try:
        left, kept = segments(killed), segments(living)
        assert left and kept
        os.kill(killed.pid, signal.SIGKILL)
        killed.wait()
        deadline = time.monotonic() + 10.0
        while any((FOLDER / name).exists() for name in left):  # graphs of other tests remove leftovers, too
            assert time.monotonic() < deadline
            remove_leftovers(older_than=1.0)
        assert all((FOLDER / name).exists() for name in kept)
    finally:
        for process in (killed, living):
            process.kill()
            process.wait()
        for domain in domains:
            domain.close()


def test_young_locked_and_foreign_files_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A group is removed as a whole or not at all; a lock on one of its files keeps the others."""
    names = ("fastrtps_ab", "fastrtps_ab_el", "fastrtps_port7411", "sem.fastrtps_port7411_mutex", "other", "sem.other")
    for name in names:
        (tmp_path / name).touch()
    assert remove_leftovers(tmp_path, older_than=60.0) == 0
    descriptor = os.open(tmp_path / "fastrtps_ab_el", os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    assert remove_leftovers(tmp_path, older_than=-1.0) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["fastrtps_ab", "fastrtps_ab_el", "other", "sem.other"]
    os.close(descriptor)
    monkeypatch.setattr(os, "getuid", lambda: 4242)
    assert remove_leftovers(tmp_path, older_than=-1.0) == 0
