# SPDX-License-Identifier: Apache-2.0
"""A host that ends, hangs or answers nonsense is an error of one drive; the next one has another host."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from ds_road import generate
from ds_sim.scenario import Scenario
from ds_sim.session import Session
from ds_sim.simulator import Command, Outcome, SimulatorError
from ds_sim.testing import STRAIGHT, missing_because
from ds_sim_torcs import host as module
from ds_sim_torcs.host import Kind, TorcsHost
from ds_sim_torcs.simulator import TorcsSimulator

GO = Command(0.0, 0.5)


@pytest.fixture
def simulator(monkeypatch: pytest.MonkeyPatch) -> TorcsSimulator:
    """A simulator that waits a second at most."""
    if reason := missing_because("torcs"):
        pytest.skip(reason)
    monkeypatch.setattr(TorcsHost.__init__, "__kwdefaults__", {"timeout": 1.0})
    return TorcsSimulator()


def host_of(simulator: TorcsSimulator) -> TorcsHost:
    found: TorcsHost = simulator.vehicle._host  # type: ignore[attr-defined]
    return found


@pytest.mark.parametrize(
    ("number", "said"),
    [(signal.SIGKILL, "the host ended with status -9"), (signal.SIGSTOP, "the host did not answer within 1 s")],
)
def test_a_drive_whose_host_fails_is_an_error_and_the_next_one_is_not(
    simulator: TorcsSimulator, number: signal.Signals, said: str
) -> None:
    session = Session(simulator)
    assert session.start(Scenario(STRAIGHT, seed=1)) is not None and session.advance(GO) is not None
    ended = host_of(simulator).pid
    assert ended is not None
    os.kill(ended, number)
    assert session.advance(GO) is None
    assert session.run is not None and session.run.outcome is Outcome.SIM_ERROR and session.run.outcome.is_error
    assert said in session.run.message and session.run.message.endswith("the next drive starts another host")
    assert not Path(f"/proc/{ended}").exists()
    assert session.start(Scenario(STRAIGHT, seed=1)) is not None and session.advance(GO) is not None
    assert host_of(simulator).pid != ended
    simulator.close()


STAND_IN = """#!{python}
import os, sys
kinds = []
while head := os.read(0, 8):
    kind, size = head[0], int.from_bytes(head[4:8], "little")
    while size:
        size -= len(os.read(0, size))
    kinds.append(kind)
    {answer}
"""
SOUND = 'os.write(1, bytes([kind, 0, 0, 0, 2, 0, 0, 0]) + b"ok")'


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ('os.write(1, b"TORCS 1.3.7\\n" * 99)', "answered kind 1129467732 of"),
        ("os.write(1, bytes([2, 0, 0, 0, 200, 0, 0, 0]) + bytes(200))", "kind 2 of 200 bytes, expected 2 of 96"),
        ("os.write(1, bytes([2, 0, 0, 0, 96, 0, 0, 0]) + bytes(50)); sys.exit(7)", "ended with status 7"),
        ('os.write(1, bytes([0, 0, 0, 0, 7, 0, 0, 0]) + b"no car!")', "the host refuses: no car!"),
        ("pass", "did not answer within 0.5 s"),
        (
            'os.write(1, bytes([2, 0, 0, 0, 96, 0, 0, 0])); print("Segmentation", file=sys.stderr); os._exit(139)',
            "ended with status 139 (Segmentation)",
        ),
    ],
)
def test_nonsense_is_said_in_one_line(answer: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if reason := missing_because("torcs"):
        pytest.skip(reason)
    program = tmp_path / "host"
    program.write_text(STAND_IN.format(python=sys.executable, answer=answer))
    program.chmod(stat.S_IRWXU)
    monkeypatch.setenv(module.OVERRIDE, str(program))
    host = TorcsHost(320, 160, timeout=0.5)
    host.start()
    with pytest.raises(SimulatorError) as raised:
        host.ask(Kind.CAR, size=96)
    assert said in str(raised.value) and "\n" not in str(raised.value)
    assert host.pid is None and not host.folder.exists()
    with pytest.raises(SimulatorError, match="no host runs: load a road first"):
        host.ask(Kind.STEP)


def test_a_host_that_is_no_program_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if reason := missing_because("torcs"):
        pytest.skip(reason)
    (tmp_path / "host").write_text("neither ELF nor script")
    (tmp_path / "host").chmod(stat.S_IRWXU)
    monkeypatch.setenv(module.OVERRIDE, str(tmp_path / "host"))
    host = TorcsHost(320, 160)
    with pytest.raises(SimulatorError, match=r"host does not start \(Exec format error\): type make torcs"):
        host.start()
    assert not host.folder.exists()


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda host: host.ask(Kind.STEP, bytes(20)), "no car is placed"),
        (lambda host: host.ask(Kind.VIEW, bytes(80)), "no world is loaded"),
        (lambda host: host.ask(Kind.ROAD, b"nowhere"), "no world tracks/road/nowhere/nowhere.xml"),
        (lambda host: host.ask(Kind.CAR, b"?"), "request 2 of a wrong size"),
    ],
)
def test_a_wrong_request_is_refused_in_words(host: TorcsHost, ask: Callable[[TorcsHost], bytes], said: str) -> None:
    host.start()
    with pytest.raises(SimulatorError, match=f"the host refuses: {said}"):
        ask(host)


def test_the_host_ends_with_the_process_that_started_it() -> None:
    if reason := missing_because("torcs"):
        pytest.skip(reason)
    code = (
        f"import sys; sys.path[:0] = {[*sys.path]!r}\n"
        "import os, signal\nfrom ds_sim_torcs.host import TorcsHost\n"
        "host = TorcsHost(320, 160); host.renderer(); print(host.pid, host.folder, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    pid, folder = done.stdout.split()
    until = time.monotonic() + 10.0
    while (alive := _runs(pid)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not alive and not Path(folder).exists() and (module.DATA / "cars").is_dir()


def _runs(pid: str) -> bool:
    """Whether a process exists that is more than an entry which nobody has waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_host_of_another_source_or_renderer_is_refused(
    host: TorcsHost, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "Mesa" in host.renderer() and "llvmpipe" in host.renderer()
    monkeypatch.setattr(host, "ask", lambda kind: b"0123\n4.6, a graphics card")
    with pytest.raises(SimulatorError, match=r"built from another torcs_host.cpp: type make torcs"):
        host.renderer()
    monkeypatch.setattr(module, "SOURCE", tmp_path)
    with pytest.raises(SimulatorError, match="draws with 4.6, a graphics card, expected Mesa's llvmpipe"):
        host.renderer()


def test_a_fork_leaves_the_host_to_its_owner(host: TorcsHost) -> None:
    host.start()
    child = os.fork()
    if not child:
        host.close()
        os._exit(0)
    os.waitpid(child, 0)
    assert host.renderer()


def test_a_missing_host_is_said_with_what_to_type(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(module, "LIBRARIES", tmp_path)
    with pytest.raises(ImportError, match=r"TORCS is not installed: sudo apt-get install -y torcs .*, then make torcs"):
        module.host_program()
    if not (module.DATA / "cars").is_dir():
        return
    (tmp_path / "modules/simu").mkdir(parents=True)
    (tmp_path / "modules/simu/simuv2.so").touch()
    monkeypatch.setenv(module.OVERRIDE, str(tmp_path / "none"))
    with pytest.raises(ImportError, match="type make torcs, or name a host in DS_TORCS_HOST"):
        module.host_program()


def test_a_host_does_not_grow_with_the_roads_that_it_draws(simulator: TorcsSimulator) -> None:
    import numpy as np

    def size_after(first: int, last: int) -> int:
        for seed in range(first, last):
            simulator.load(generate(np.random.default_rng(seed), max_angle=150), seed=1)
        pages = int(Path(f"/proc/{host_of(simulator).pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")

    settled = size_after(0, 10)
    assert size_after(10, 40) - settled < 30e6
    simulator.close()
