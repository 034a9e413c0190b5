# SPDX-License-Identifier: Apache-2.0
"""Kills processes of a campaign at seeded moments, resumes it, and checks that no result is lost or changed.

`tests/graph/test_kill.py` does this. Moments are uniform over the time in which the undisturbed campaign drives. They
are relative to its last line of progress before them, so that they fall at the same place however busy the machine is.
After each kill the campaign is resumed until it is complete. Then

- maps, evaluation and bags must equal those of the undisturbed campaign byte for byte, with no files left over;
- executions in the store at the moment of the kill must be unchanged, and not driven again according to the logs;
- at most as many runs as were in progress may have been driven twice;
- no process may be left.
"""

from __future__ import annotations

import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from ds_driver.networks.pilot import Frame

DRIVER = "benchmarks.kill:Swerving"
CONFIG = f"""
siblings: [bullet, softbody]
twin: donkey
driver: {DRIVER}
seed: 3
search: {{population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 90}}
"""
SIMULATORS, EXECUTIONS = 3, 12
WHOLE = "undisturbed"
KINDS = ("simulator", "driver", "worker", "orchestrator", "two", "sigterm", "sigint")
"""What to kill: `worker` is all processes of one graph, `two` are any two processes, and the last two are signals to
the orchestrator."""
LIMIT = 240.0
"""Longest duration of a campaign, s; chosen: ten times what it takes on an idle machine."""
ORPHAN_TIME = 10.0
"""Time within which the processes of a killed orchestrator must end, s."""
SESSIONS = 3
"""Largest number of times that the command is given; chosen: one more than should be necessary."""
STATUS = {"sigterm": 143, "sigint": 130}
"""Exit status of an orchestrator stopped by a signal during its runs, as in shells; Python does not handle signals
while it starts and exits."""
_MARK = "DS_KILL_MARK"


class Swerving:
    """Steers right in proportion to the brightness of the road ahead, so that every bit of the image matters."""

    def drive(self, frame: Frame) -> float:
        """Steering for a frame, between 0 and 0.5."""
        return float(frame.image[80:].mean()) / 510.0


class Session:
    """One process of the orchestrator, with all its descendants."""

    def __init__(self, folder: Path, workers: int, *, resume: bool = False) -> None:
        self.folder, self.errors = folder, folder.with_suffix(".err")
        config = folder.with_suffix(".yaml")
        config.write_text(CONFIG)
        words = ["resume", str(folder), "--trust", DRIVER] if resume else ["run", str(config), "--out", str(folder)]
        # Background jobs of a shell ignore SIGINT, and child processes inherit that.
        command = ["env", "--default-signal=INT", sys.executable, "-m", "ds_cli.main"]
        command += ["campaign", *words, "--workers", str(workers)]
        path = os.pathsep.join(filter(None, (str(Path.cwd()), os.environ.get("PYTHONPATH"))))
        environment = os.environ | {_MARK: str(folder), "PYTHONPATH": path}
        self.written = self.lines()
        with self.errors.open("a") as errors:
            self.process = subprocess.Popen(
                command, env=environment, stdout=subprocess.DEVNULL, stderr=errors, text=True, start_new_session=True
            )
        self.began = time.monotonic()

    def lines(self) -> int:
        """Number of lines of progress written by all sessions."""
        return self.errors.read_bytes().count(b"\n") if self.errors.exists() else 0

    def wait_until(self, line: int, delay: float) -> None:
        """Wait until `delay` seconds after a line of this session, or until its end."""
        deadline = time.monotonic() + LIMIT
        while self.lines() - self.written < line and self.process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        began = time.monotonic() if line else self.began
        while self.process.poll() is None and time.monotonic() - began < delay:
            time.sleep(0.005)

    def wait(self) -> int:
        """Wait until the session ends; returns its exit status."""
        try:
            return self.process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise RuntimeError(f"the campaign in {self.folder} did not end within {LIMIT:.0f} s") from None

    def victims(self, kind: str, rng: np.random.Generator) -> list[int]:
        """Choose processes to kill; the orchestrator if there is currently no process of this kind."""
        me = self.process.pid
        graph = {pid: domain for pid, domain in marked(self.folder).items() if pid != me}
        if kind == "worker" and graph:
            domain = rng.choice(sorted(set(graph.values())))
            return [pid for pid, own in graph.items() if own == domain]
        if kind == "two" and graph:
            return [int(pid) for pid in rng.choice(sorted([me, *graph]), 2, replace=False)]
        part = {"driver": "ds_driver", "simulator": "simulator:="}.get(kind)
        chosen = sorted(pid for pid in graph if part and part in command_line(pid))
        return [int(rng.choice(chosen))] if chosen else [me]


def marked(folder: Path) -> dict[int, str]:
    """Running processes that descend from a campaign's command, and the ROS domain of each."""
    domains = {}
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            environment = process.environ()
            if environment.get(_MARK) == str(folder) and process.status() != psutil.STATUS_ZOMBIE:
                domains[process.pid] = environment.get("ROS_DOMAIN_ID", "")
    return domains


def command_line(pid: int) -> str:
    """Command line of a process; "" if it has ended."""
    try:
        return " ".join(psutil.Process(pid).cmdline())
    except psutil.Error:
        return ""


def results(folder: Path) -> dict[str, bytes]:
    """Contents of all files of maps, evaluation and bags, including partial and hidden ones."""
    parts = ("maps", "evaluation", "bags")
    files = (path for part in parts for path in sorted((folder / part).rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def stored(folder: Path) -> dict[tuple[str, str], tuple[object, ...]]:
    """Executions in the store: (test, simulator) -> road and all columns; empty before the tables exist."""
    path = folder / "campaign.sqlite"
    if not path.exists():
        return {}
    query = "SELECT t.road_id, e.* FROM executions e JOIN tests t USING (test_id)"
    with closing(sqlite3.connect(path)) as db, suppress(sqlite3.OperationalError):
        return {(row[1], row[2]): row for row in db.execute(query)}
    return {}


def driven(folder: Path) -> Counter[tuple[str, str]]:
    """Number of runs with a verdict per simulator and road, according to the logs of the simulators."""
    counts: Counter[tuple[str, str]] = Counter()
    space_of = {"bullet": "ds1", "softbody": "ds2", "donkey": "twin"}
    for simulator, space in space_of.items():
        for log in folder.glob(f"logs/**/closed_loop_{space}.log"):
            verdicts = r": ([0-9a-f]{12}): (?:COMPLETED|OUT_OF_BOUNDS|STUCK|TIMEOUT) after"
            counts.update((simulator, road) for road in re.findall(verdicts, log.read_text(errors="replace")))
    return counts


def processes_left(folder: Path) -> int:
    """Number of processes left after `ORPHAN_TIME`."""
    deadline = time.monotonic() + ORPHAN_TIME
    while (left := len(marked(folder))) and time.monotonic() < deadline:
        time.sleep(0.1)
    return left


def lines_of(session: Session) -> list[float]:
    """Wait for a session to end; returns the times of its lines of progress and of its end, s."""
    times = [0.0]
    while session.process.poll() is None and times[-1] < LIMIT:
        time.sleep(0.005)
        now = time.monotonic() - session.began
        times += [now] * (session.lines() - len(times) + 1)
    if session.wait():
        raise RuntimeError(f"the campaign failed: {session.errors.read_text()[-500:]}")
    return [*times, time.monotonic() - session.began]


@dataclass
class Report:
    """Result of one kill."""

    line: int
    delay: float
    kind: str
    workers: int
    killed: str = ""
    kept: int = 0
    again: int = 0
    sessions: int = 1
    problems: list[str] = field(default_factory=list)


def disturbed(folder: Path, times: list[float], kind: str, workers: int, rng: np.random.Generator) -> Report:
    """Run the campaign, kill processes at a random moment, resume to the end, and look for differences.

    The campaign's folder is beside that of the undisturbed one, whose lines and end were at `times`, s. The generator
    gives the moment, and the process to kill.
    """
    moment = float(rng.uniform(times[1], times[EXECUTIONS + 2]))  # first stage's start to last run's end
    line = int(np.searchsorted(times[:-1], moment, side="right")) - 1
    report = Report(line, moment - times[line], kind, workers)
    session = Session(folder, workers)
    session.wait_until(report.line, report.delay)
    victims = session.victims(kind, rng)
    report.killed = ", ".join(sorted(name_of(pid, session.process.pid) for pid in victims))
    number = {"sigterm": signal.SIGTERM, "sigint": signal.SIGINT}.get(kind, signal.SIGKILL)
    for pid in victims:
        with suppress(ProcessLookupError):
            os.kill(pid, number)
    before = stored(folder)
    report.kept = len(before)
    status = session.wait() if session.process.pid not in victims else session.process.wait(ORPHAN_TIME)
    if left := processes_left(folder):
        report.problems.append(f"{left} processes left")
    if kind in STATUS and report.line > 0 and report.kept < EXECUTIONS and status != STATUS[kind]:
        report.problems.append(f"status {status}")
    while status and report.sessions < SESSIONS:
        report.sessions += 1
        status = Session(folder, workers, resume=bool(before)).wait()
    if status:
        report.problems.append(f"final status {status}")
    if left := processes_left(folder):
        report.problems.append(f"{left} processes left at the end")
    report.problems += differences(folder, folder.with_name(WHOLE), before)
    report.again = sum(driven(folder).values()) - EXECUTIONS
    if report.again > SIMULATORS * workers:
        report.problems.append(f"{report.again} runs driven again")
    return report


def name_of(pid: int, orchestrator: int) -> str:
    """Role of a process: orchestrator, or the name of the simulator that shares it with its driver."""
    line = command_line(pid)
    if pid == orchestrator:
        return "orchestrator"
    return (re.findall(r"simulator:=\"?(\w+)", line) or ["gone"])[0]


def differences(folder: Path, whole: Path, before: dict[tuple[str, str], tuple[object, ...]]) -> list[str]:
    """Differences from the undisturbed campaign, and from the store at the moment of the kill."""
    problems = []
    ours, expected = results(folder), results(whole)
    for name in sorted(ours.keys() | expected.keys()):
        if ours.get(name) != expected.get(name):
            what = "missing" if name not in ours else "left over" if name not in expected else "different"
            problems.append(f"{name} {what}")
    after, reference = stored(folder), stored(whole)
    if after != reference or len(reference) != EXECUTIONS:
        problems.append(
            f"the {len(after)} executions in the store differ from the {EXECUTIONS} of the undisturbed campaign"
        )
    problems += [f"{'/'.join(key)} changed" for key, row in before.items() if after.get(key) != row]
    runs = driven(folder)
    for (test, simulator), (road, *_) in before.items():
        if (times := runs[simulator, str(road)]) != 1:
            problems.append(f"{test}/{simulator} was kept and driven {times} times")
    return [*problems, "a traceback"] if "Traceback" in folder.with_suffix(".err").read_text() else problems
