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
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ds_driver.networks.pilot import Frame

CONFIG = """
siblings: [bullet, softbody]
twin: donkey
driver: {driver}
seed: 3
search: {{population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 90}}
"""
SIMULATORS, EXECUTIONS = 3, 12
WHOLE = "undisturbed"
DRIVER = "benchmarks.kill:Swerving"
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


@dataclass
class Session:
    """One process of the orchestrator, with all its descendants."""

    folder: Path
    driver: str
    workers: int
    resume: bool = False
    process: subprocess.Popen[str] = field(init=False)
    began: float = field(init=False)
    written: int = field(init=False)

    def __post_init__(self) -> None:
        config = self.folder.with_suffix(".yaml")
        config.write_text(CONFIG.format(driver=self.driver))
        what = (
            ["resume", str(self.folder), "--trust", self.driver]
            if self.resume
            else ["run", str(config), "--out", str(self.folder)]
        )
        # Background jobs of a shell ignore SIGINT, and child processes inherit that.
        command = ["env", "--default-signal=INT", sys.executable, "-m", "ds_cli.main"]
        command += ["campaign", *what, "--workers", str(self.workers)]
        path = os.pathsep.join(filter(None, (str(Path.cwd()), os.environ.get("PYTHONPATH"))))
        environment = os.environ | {_MARK: str(self.folder), "PYTHONPATH": path}
        self.written = self.lines()
        with self.folder.with_suffix(".err").open("a") as errors:
            self.process = subprocess.Popen(
                command, env=environment, stdout=subprocess.DEVNULL, stderr=errors, text=True, start_new_session=True
            )
        self.began = time.monotonic()

    def lines(self) -> int:
        """Number of lines of progress written by all sessions."""
        path = self.folder.with_suffix(".err")
        return path.read_bytes().count(b"\n") if path.exists() else 0

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
        lines = {pid: command_line(pid) for pid in graph}  # a process may hold a simulator and its driver
        parts = {"driver": "ds_driver", "simulator": "simulator:="}
        if kind == "worker" and graph:
            domain = rng.choice(sorted(set(graph.values())))
            return [pid for pid, own in graph.items() if own == domain]
        if kind == "two" and graph:
            return [int(pid) for pid in rng.choice(sorted([me, *graph]), 2, replace=False)]
        chosen = sorted(pid for pid, line in lines.items() if kind in parts and parts[kind] in line)
        return [int(rng.choice(chosen))] if chosen else [me]


def marked(folder: Path) -> dict[int, str]:
    """Running processes that descend from a campaign's command, and the ROS domain of each."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                environment = (entry / "environ").read_bytes().decode(errors="replace").split("\0")
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            except OSError:
                continue
            if f"{_MARK}={folder}" in environment and state != "Z":
                found[int(entry.name)] = next((v for v in environment if v.startswith("ROS_DOMAIN_ID=")), "")
    return found


def command_line(pid: int) -> str:
    """Command line of a process; "" if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
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
    db = sqlite3.connect(path)
    try:
        rows = db.execute("SELECT t.road_id, e.* FROM executions e JOIN tests t USING (test_id)").fetchall()
    except sqlite3.OperationalError:
        return {}
    finally:
        db.close()
    return {(row[1], row[2]): row for row in rows}


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
        raise RuntimeError(f"the campaign failed: {session.folder.with_suffix('.err').read_text()[-500:]}")
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

    Args:
        folder: folder of the campaign, beside that of the undisturbed one.
        times: times of the lines and of the end of the undisturbed campaign, s.
        kind: one of `KINDS`.
        workers: number of graphs at the same time.
        rng: source of the moment and of the process to kill.
    """
    moment = float(rng.uniform(times[1], times[EXECUTIONS + 2]))  # first stage's start to last run's end
    line = int(np.searchsorted(times[:-1], moment, side="right")) - 1
    report = Report(line, moment - times[line], kind, workers)
    session = Session(folder, DRIVER, workers)
    session.wait_until(report.line, report.delay)
    victims = session.victims(kind, rng)
    report.killed = ", ".join(sorted(name_of(pid, session.process.pid) for pid in victims))
    number = {"sigterm": signal.SIGTERM, "sigint": signal.SIGINT}.get(kind, signal.SIGKILL)
    for pid in victims:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            report.killed += " (had ended)"
    before = stored(folder)
    report.kept = len(before)
    status = session.wait() if session.process.pid not in victims else session.process.wait(ORPHAN_TIME)
    if left := processes_left(folder):
        report.problems.append(f"{left} processes left")
    if kind in STATUS and report.line > 0 and report.kept < EXECUTIONS and status != STATUS[kind]:
        report.problems.append(f"status {status}")
    while status and report.sessions < SESSIONS:
        report.sessions += 1
        status = Session(folder, DRIVER, workers, resume=bool(before)).wait()
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
    found, expected = results(folder), results(whole)
    for name in sorted(found.keys() | expected.keys()):
        if found.get(name) != expected.get(name):
            what = "missing" if name not in found else "left over" if name not in expected else "different"
            problems.append(f"{name} {what}")
    after, reference = stored(folder), stored(whole)
    if after != reference or len(reference) != EXECUTIONS:
        problems.append(
            f"the {len(after)} executions in the store differ from the {EXECUTIONS} of the undisturbed campaign"
        )
    problems += [f"{'/'.join(key)} changed" for key, row in before.items() if after.get(key) != row]
    runs = driven(folder)
    twice = [key for key, row in before.items() if runs[(key[1], str(row[0]))] != 1]
    problems += [f"{'/'.join(key)} was kept and driven {runs[(key[1], str(before[key][0]))]} times" for key in twice]
    errors = folder.with_suffix(".err").read_text()
    problems += ["a traceback"] * ("Traceback" in errors)
    return problems
