"""Nothing lost: kills a campaign's processes at seeded moments, goes on, and compares with the undisturbed campaign.

`python -m benchmarks.kill [--moments 25] [--seed 1] [--kinds simulator,driver]`: one row per moment, as Markdown, and
status 1 if anything differs. Moments are uniform over the time that the undisturbed campaign takes, or with `--driving`
over that in which it drives. They are counted from its last line before them, so that they fall at the same place
however busy the machine is. After each one the campaign is gone on with until it is done, and then

- maps, evaluation and bags are byte for byte those of the undisturbed campaign, and no file is left over;
- what stood in the store at the moment stands there unchanged, and the simulators' logs show no second run of it;
- at most as many runs as were under way were driven twice;
- no process is left.

`tests/graph/test_kill.py` does it for a few moments.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

CONFIG = """
siblings: [bullet, softbody]
twin: donkey
driver: {driver}
seed: 3
search: {{population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 90}}
"""
SIMULATORS, EXECUTIONS = 3, 12
WHOLE = "undisturbed"
DRIVER = "benchmarks.swerving_driver:Swerving"
KILLS = ("simulator", "driver", "worker", "orchestrator")
KINDS = (*KILLS, "two", "sigterm", "sigint")
"""`worker` is all processes of one graph, `two` is two processes of any kind; the last two end the orchestrator."""
LIMIT = 240.0
"""Seconds for a campaign; chosen: ten times what it takes on a free machine."""
ORPHAN_TIME = 10.0
"""Seconds in which the processes of a killed orchestrator have to be gone."""
SESSIONS = 3
"""Times that the command is given at most; chosen: one more than should be needed."""
STATUS = {"sigterm": 143, "sigint": 130}
"""Of an orchestrator that was asked to stop amid its runs, as shells have it; Python's begin and end do not listen."""
_MARK = "DS_KILL_MARK"


@dataclass
class Session:
    """One life of the orchestrator, with every process that descends from it."""

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
        what = ["resume", str(self.folder)] if self.resume else ["run", str(config), "--out", str(self.folder)]
        # A shell lets its background jobs ignore SIGINT, and who inherits that never hears it.
        command = ["env", "--default-signal=INT", sys.executable, "-m", "ds_orchestrator.cli.main"]
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
        """How many lines of progress were written, by all sessions."""
        path = self.folder.with_suffix(".err")
        return path.read_bytes().count(b"\n") if path.exists() else 0

    def wait_until(self, line: int, delay: float) -> None:
        """Until so many seconds after a line of this session, or the end."""
        deadline = time.monotonic() + LIMIT
        while self.lines() - self.written < line and self.process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        began = time.monotonic() if line else self.began
        while self.process.poll() is None and time.monotonic() - began < delay:
            time.sleep(0.005)

    def wait(self) -> int:
        """Until it ends by itself; its exit status."""
        try:
            return self.process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise RuntimeError(f"the campaign in {self.folder} did not end within {LIMIT:.0f} s") from None

    def victims(self, kind: str, rng: np.random.Generator) -> list[int]:
        """Processes to end; the orchestrator where there is no such process at this moment."""
        me = self.process.pid
        graph = {pid: domain for pid, domain in marked(self.folder).items() if pid != me}
        of_kind = {pid: "driver" if "ds_driver" in command_line(pid) else "simulator" for pid in graph}
        if kind == "worker" and graph:
            domain = rng.choice(sorted(set(graph.values())))
            return [pid for pid, mine in graph.items() if mine == domain]
        if kind == "two" and graph:
            return [int(pid) for pid in rng.choice(sorted([me, *graph]), 2, replace=False)]
        chosen = sorted(pid for pid, what in of_kind.items() if what == kind)
        return [int(rng.choice(chosen))] if chosen else [me]


def marked(folder: Path) -> dict[int, str]:
    """Living processes that descend from a campaign's command, and the ROS domain of each."""
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
    """What a process was started with, or nothing if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def results(folder: Path) -> dict[str, bytes]:
    """Every file of maps, evaluation and bags, unfinished and hidden ones too."""
    parts = ("maps", "evaluation", "bags")
    files = (path for part in parts for path in sorted((folder / part).rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def stored(folder: Path) -> dict[tuple[str, str], tuple[object, ...]]:
    """Test and simulator -> road and all that the store knows of the execution; empty before it has tables."""
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
    """How often each road was driven to a verdict on each simulator, as the simulators' own logs have it."""
    counts: Counter[tuple[str, str]] = Counter()
    space_of = {"bullet": "ds1", "softbody": "ds2", "donkey": "twin"}
    for simulator, space in space_of.items():
        for log in folder.glob(f"logs/**/simulator_{space}.log"):
            verdicts = r": ([0-9a-f]{12}): (?:COMPLETED|OUT_OF_BOUNDS|STUCK|TIMEOUT) after"
            counts.update((simulator, road) for road in re.findall(verdicts, log.read_text(errors="replace")))
    return counts


def processes_left(folder: Path) -> int:
    """How many processes there still are when they had time to end."""
    deadline = time.monotonic() + ORPHAN_TIME
    while (left := len(marked(folder))) and time.monotonic() < deadline:
        time.sleep(0.1)
    return left


def undisturbed(folder: Path, driver: str = DRIVER) -> list[float]:
    """Run the campaign that the others are held against; the seconds at which its lines came, and its end."""
    return lines_of(Session(folder, driver, 1))


def lines_of(session: Session) -> list[float]:
    """See a session to its end; the seconds at which its lines came, and its end."""
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
    """What came of one moment."""

    line: int
    delay: float
    kind: str
    workers: int
    killed: str = ""
    kept: int = 0
    again: int = 0
    sessions: int = 1
    seconds: float = 0.0
    problems: list[str] = field(default_factory=list)


def disturbed(
    folder: Path,
    times: list[float],
    kind: str,
    workers: int,
    rng: np.random.Generator,
    *,
    driver: str = DRIVER,
    driving: bool = False,
) -> Report:
    """Run the campaign, end a process at a moment, go on to the end, and look for differences.

    Args:
        folder: of the campaign; beside it lies the undisturbed one.
        times: of the undisturbed one's lines, and of its end.
        kind: of `KINDS`.
        workers: graphs at the same time.
        rng: chooses the moment and the process.
        driver: at the wheel.
        driving: choose a moment between the first stage's begin and the last run's end, not of the whole time.
    """
    moment = float(rng.uniform(*((times[1], times[EXECUTIONS + 2]) if driving else (0.0, times[-1]))))
    line = int(np.searchsorted(times[:-1], moment, side="right")) - 1
    report = Report(line, moment - times[line], kind, workers)
    session = Session(folder, driver, workers)
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
        status = Session(folder, driver, workers, resume=bool(before)).wait()
    report.seconds = time.monotonic() - session.began
    if status:
        report.problems.append(f"status {status} at last")
    if left := processes_left(folder):
        report.problems.append(f"{left} processes left at the end")
    report.problems += differences(folder, folder.with_name(WHOLE), before)
    report.again = sum(driven(folder).values()) - EXECUTIONS
    if report.again > SIMULATORS * workers:
        report.problems.append(f"{report.again} runs driven again")
    return report


def name_of(pid: int, orchestrator: int) -> str:
    """What a process is in the graph."""
    line = command_line(pid)
    if pid == orchestrator:
        return "orchestrator"
    return "driver" if "ds_driver" in line else (re.findall(r"simulator:=\"?(\w+)", line) or ["gone"])[0]


def differences(folder: Path, whole: Path, before: dict[tuple[str, str], tuple[object, ...]]) -> list[str]:
    """What differs from the undisturbed campaign, and from what stood in the store at the moment."""
    problems = []
    ours, theirs = results(folder), results(whole)
    for name in sorted(ours.keys() | theirs.keys()):
        if ours.get(name) != theirs.get(name):
            what = "missing" if name not in ours else "left over" if name not in theirs else "different"
            problems.append(f"{name} {what}")
    after, reference = stored(folder), stored(whole)
    if after != reference or len(reference) != EXECUTIONS:
        problems.append(f"{len(after)} executions in the store that are not the {EXECUTIONS} of the undisturbed one")
    problems += [f"{'/'.join(key)} changed" for key, row in before.items() if after.get(key) != row]
    runs = driven(folder)
    twice = [key for key, row in before.items() if runs[(key[1], str(row[0]))] != 1]
    problems += [f"{'/'.join(key)} was kept and driven {runs[(key[1], str(before[key][0]))]} times" for key in twice]
    errors = folder.with_suffix(".err").read_text()
    problems += ["a traceback"] * ("Traceback" in errors)
    return problems


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--moments", type=int, default=25)
    parser.add_argument("--first", type=int, default=0, help="number of the first moment, to repeat one")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", default=",".join(KILLS), help=f"of {', '.join(KINDS)}")
    parser.add_argument("--driver", default=DRIVER)
    parser.add_argument("--driving", action="store_true", help="moments while roads are driven only")
    parser.add_argument("--out", type=Path, help="folder for the campaigns; a temporary one is removed")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        out = (arguments.out or Path(temporary)).resolve()
        out.mkdir(parents=True, exist_ok=True)
        times = undisturbed(out / WHOLE, arguments.driver)
        print(f"Undisturbed: {times[-1]:.0f} s, {EXECUTIONS} executions.\n")
        print("| | moment | killed | workers | kept | driven again | commands | took, s | |")
        print("|---|---|---|---|---|---|---|---|---|", flush=True)
        bad = 0
        for number in range(arguments.first, arguments.first + arguments.moments):
            rng = np.random.default_rng([arguments.seed, number])
            kind, workers = str(rng.choice(arguments.kinds.split(","))), 1 + int(rng.random() < 0.2)
            folder, driver, driving = out / f"moment_{number:02d}", arguments.driver, arguments.driving
            r = disturbed(folder, times, kind, workers, rng, driver=driver, driving=driving)
            bad += bool(r.problems)
            print(
                f"| {number} | {r.delay:.2f} s after line {r.line} | {kind}: {r.killed} | {r.workers} | {r.kept} | "
                f"{r.again} | {r.sessions} | {r.seconds:.0f} | {'; '.join(r.problems) or 'the same'} |",
                flush=True,
            )
    sys.exit(bad > 0)


if __name__ == "__main__":
    main()
