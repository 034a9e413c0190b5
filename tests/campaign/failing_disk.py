# SPDX-License-Identifier: Apache-2.0
"""Runs a small campaign on a disk that fails; a process of its own, into which `disk.c` is preloaded.

Every repetition is a fork, so that libraries are loaded once. Only what writes is real: drives are made up, and the
pictures of the report, which are written by the same function as the other files, are left out.
"""

from __future__ import annotations

import os
import shutil
import sys
import traceback
from contextlib import nullcontext, redirect_stderr, redirect_stdout, suppress
from pathlib import Path

from tests.campaign.disk import KINDS, Disk, damage, differences
from tests.campaign.engines import MadeUpEngine

from ds_base.folder_files import write_whole
from ds_cli import application
from ds_orchestrator.engines.start import ENGINES
from ds_report import build

CONFIG = """
siblings: [donkey]
twin: null
driver: autopilot
seed: 7
record: telemetry
search: {population: 1, iterations: 1, runs: 1, min_angle: 40, max_angle: 90}
"""


def prepare(scratch: Path) -> None:
    """Let this process drive nothing and draw no pictures, and load what a campaign needs."""
    ENGINES["local"] = lambda *_: nullcontext(MadeUpEngine())
    build.write_maps = lambda *_: None  # type: ignore[attr-defined]
    build.write_report = lambda out, *_, **__: write_whole(out / "report.html", "")  # type: ignore[assignment]
    (scratch / "c.yaml").write_text(CONFIG)
    with redirect_stdout(None), redirect_stderr(None):
        run_campaign(scratch / "loading")


def run_campaign(folder: Path) -> int:
    """Run the campaign in this process; returns its status."""
    return application.run(["campaign", "run", f"{folder.parent}/c.yaml", "--engine", "local", "--out", str(folder)])


def ds(folder: Path) -> tuple[int, str]:
    """Run the campaign in a fork; returns its status and its standard error."""
    if (child := os.fork()) == 0:
        status = 255
        with suppress(BaseException):
            os.dup2(os.open(folder.with_suffix(".err"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            try:
                status = run_campaign(folder)
            except BaseException:
                traceback.print_exc()
            sys.stderr.flush()
        os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return status, folder.with_suffix(".err").read_text()


def problems_at(folder: Path, disk: Disk, whole: Path, failure: tuple[int, int, str, bool]) -> list[str]:
    """Let one call fail and give the command again; returns what is not as an undisturbed campaign has it."""
    shutil.rmtree(folder, ignore_errors=True)
    disk.arm(folder, *failure)
    status, said = ds(folder)
    disk.disarm()
    problems = [] if status in (0, 1, 2) else [f"status {status}"]
    problems += [said] if "Traceback" in said or "bug of ds" in said else []
    if status:
        problems += [said] if said.count("error: ") != 1 else []
        problems += damage(folder) if folder.is_dir() else []
        problems += [f"left {one}" for one in folder.rglob("*.partial*")]
        status, said = ds(folder)
        problems += [f"resumed: {status} {said}"] if status else []
    return problems + differences(folder, whole)


def main(folder: Path, error: str, stays: bool, first: int, step: int) -> None:
    """Let each call fail, and print one line for each failure after which something is wrong."""
    prepare(folder)
    disk, whole = Disk(folder), folder / "whole"
    disk.arm(whole)
    status, said = ds(whole)
    if status:
        sys.exit(f"undisturbed: {status} {said}")
    calls, tried = disk.disarm(), 0
    for kind, name in enumerate(KINDS if error != "short" else KINDS[:1]):
        for nth in range(first, calls[kind] + 1, step):
            tried += 1
            if problems := problems_at(folder / "tried", disk, whole, (kind, nth, error, stays)):
                print(f"{name} {nth}: {problems}", flush=True)
    print(f"tried {tried} of", " ".join(f"{name}={count}" for name, count in zip(KINDS, calls, strict=True)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3] == "stays", int(sys.argv[4]), int(sys.argv[5]))
