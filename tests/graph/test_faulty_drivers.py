# SPDX-License-Identifier: Apache-2.0
"""Drivers that crash, hang, or answer twice, late or wrongly: the run ends in time, with the right outcome."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.graph.processes import SHORT, SPACE, simulator_processes, supervised

from ds_cli.campaign.inspection import campaign_status_command
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.campaign.executor import trajectory_sha256
from ds_orchestrator.graph import session as running
from ds_orchestrator.graph.client import GraphClient
from ds_orchestrator.graph.supervisor import ProcessSpec, Supervisor
from ds_sim import DONKEY
from ds_sim.registry import SimulatorName
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome
from ds_studies.whole_campaign import run_campaign

pytestmark = pytest.mark.graph

LIMIT = 2.0
"""Command timeout of the simulator, s."""
BUSY, PATIENT = 60.0, 30.0
"""Limit for a run of the straight road and its services on a busy machine, in addition to the timeouts; and a command
timeout that no healthy driver exceeds there, s."""


class Bench:
    """A simulator and a faulty driver that follows orders; the client knows of neither, as of a user's nodes."""

    def __init__(self, orders: Path, supervisor: Supervisor, executor: GraphClient) -> None:
        self._orders, self.supervisor, self.executor = orders, supervisor, executor

    def order(self, fault: str, at: int = 20, delay: float = 0.0) -> None:
        self._orders.write_text(f"{fault} {at} {delay}")

    def drive(self, limit: float = LIMIT) -> tuple[Any, float]:
        """Drive the straight road with a command timeout; return the run and its wall-clock time, s."""
        self.executor._timeout = limit
        began = time.monotonic()
        run = self.executor.execute(DONKEY, Scenario(SHORT, seed=1))
        return run, time.monotonic() - began

    def drive_until_completed(self) -> None:
        """Drive until a run completes: a driver that has just started may miss the first runs."""
        self.order("none")
        deadline = time.monotonic() + 60.0
        while (outcome := self.drive()[0].outcome) is not Outcome.COMPLETED:
            assert outcome is Outcome.DRIVER_SILENT and time.monotonic() < deadline


def faulty_driver(name: str, **parameters: object) -> ProcessSpec:
    return ProcessSpec(name=name, module="tests.graph.faulty_driver", namespace="/ds1", parameters=parameters)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("faulty")
    orders = folder / "orders"
    orders.write_text("none 20 0.0")
    driver = faulty_driver("faulty", orders=str(orders))
    with supervised([*simulator_processes(SPACE, LIMIT), driver], folder / "logs") as (supervisor, domain):
        executor = GraphClient(SPACE, domain=domain, command_timeout=LIMIT)
        executor.wait_until_ready(120.0)
        bench = Bench(orders, supervisor, executor)
        bench.drive_until_completed()
        yield bench
        executor.close()


@pytest.mark.parametrize(
    ("fault", "at", "named"),
    [
        ("silent", 0, "no command within 2 s"),
        ("old", 20, "no command within 2 s"),
        ("nan", 20, "steering is nan"),
        ("beyond", 0, "-1.5"),
    ],
)
def test_a_driver_that_gives_no_usable_answer_ends_the_run_in_time(
    bench: Bench, fault: str, at: int, named: str
) -> None:
    """At the first frame, and in the middle of a run."""
    bench.order(fault, at=at)
    run, seconds = bench.drive()
    assert run.outcome is Outcome.DRIVER_SILENT and named in run.message
    assert run.steps == at
    assert LIMIT <= seconds < LIMIT + BUSY


def test_only_the_first_answer_to_a_frame_counts(bench: Bench) -> None:
    """Lock-step by stamp: neither a second answer nor one to the previous frame is executed."""
    bench.order("twice", at=0)
    run, _ = bench.drive(PATIENT)
    assert run.outcome is Outcome.COMPLETED
    assert {(c.steering, c.throttle) for c in run.commands} == {(0.0, 0.5)}


def test_a_late_answer_within_the_limit_changes_nothing(bench: Bench) -> None:
    bench.order("none")
    prompt, _ = bench.drive(PATIENT)
    bench.order("late", delay=0.4 * LIMIT)
    late, _ = bench.drive(PATIENT)
    assert late.outcome is prompt.outcome is Outcome.COMPLETED
    assert trajectory_sha256(late) == trajectory_sha256(prompt)


def test_an_answer_after_the_limit_counts_neither_then_nor_in_the_next_run(bench: Bench) -> None:
    """The next run starts before the late answer arrives."""
    bench.order("late", delay=2.0 * LIMIT)
    run, seconds = bench.drive()
    assert run.outcome is Outcome.DRIVER_SILENT and run.steps == 20
    assert seconds < LIMIT + BUSY
    bench.order("none")
    runs = [bench.drive()[0] for _ in range(3)]
    assert runs[-1].outcome is Outcome.COMPLETED
    for run in runs:
        assert run.outcome in (Outcome.COMPLETED, Outcome.DRIVER_SILENT)
        assert {c.steering for c in run.commands} <= {0.0}


def test_a_driver_that_is_gone_ends_the_run_and_a_new_one_takes_over(bench: Bench) -> None:
    bench.order("crash")
    run, seconds = bench.drive()
    assert run.outcome is Outcome.DRIVER_SILENT and run.steps == 20
    assert seconds < LIMIT + BUSY
    bench.supervisor.restart("faulty")
    bench.drive_until_completed()


CONFIG = {
    "siblings": ["donkey"],
    "twin": None,
    "driver": "autopilot",  # in its place the faulty one
    "command_timeout": LIMIT,
    "retries": 1,
    "search": {"population": 2, "iterations": 1, "runs": 1, "min_angle": 40, "max_angle": 90},
}


def test_a_campaign_outlives_its_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver crashes once, during a run; the test is repeated, and the error enters no map."""
    faulty = faulty_driver("driver", fault="crash", once=str(tmp_path / "once"))

    def separate(_driver: str, namespaces: dict[SimulatorName, str], limit: float, *, draw: str) -> list[ProcessSpec]:
        assert draw == "seen"
        return [*simulator_processes(namespaces, limit), faulty]

    monkeypatch.setattr(running, "closed_loop_processes", separate)
    began = time.monotonic()
    result = run_campaign(parse_config(CONFIG, "test"), tmp_path / "out")
    assert time.monotonic() - began < 100.0
    assert (tmp_path / "once").exists()
    assert result.executions == 3 and result.executions_in_error == 0
    errors = campaign_status_command(tmp_path / "out").document["errors"]
    assert [(error["outcome"], error["attempt"]) for error in errors] == [("SIM_ERROR", 0)]
    assert "driver ended during the run" in errors[0]["message"]
    report = result.report.read_text()
    assert errors[0]["test_id"] in report and "driver ended during the run" in report
