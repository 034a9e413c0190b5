# SPDX-License-Identifier: Apache-2.0
"""A campaign that answers after its first tests, and goes on: it ends as one that does not."""

from __future__ import annotations

from contextlib import closing, suppress
from pathlib import Path

import pytest
from tests.campaign.engines import MadeUpEngine, use_engines

from ds_driver.networks.driver_name import AUTOPILOT
from ds_orchestrator.campaign.config import CampaignConfig, SearchConfig
from ds_orchestrator.campaign.executor import Stopped
from ds_orchestrator.campaign.folder import open_store
from ds_sim import BULLET, SOFTBODY
from ds_studies.whole_campaign import CampaignOutcome, run_campaign

SEARCH = SearchConfig(population=6, iterations=6, runs=1, min_angle=150)
CONFIG = CampaignConfig(siblings=[BULLET, SOFTBODY], driver=AUTOPILOT, record="none", engine="local", search=SEARCH)


class Run:
    """Runs of one campaign, each for some drives at most; keeps what came first."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self._patch = folder, monkeypatch
        self.answers: list[CampaignOutcome] = []
        self.shown: list[str] = []

    def __call__(self, drives: int = 10_000, config: CampaignConfig = CONFIG, *, staged: bool = True) -> int:
        engine = MadeUpEngine(runs=drives)
        use_engines(self._patch, lambda _: engine)
        with suppress(Stopped):
            run_campaign(config, self.folder, first=self._keep if staged else None)
        return len(engine.roads)

    def _keep(self, outcome: CampaignOutcome) -> None:
        self.answers.append(outcome)
        self.shown.append(outcome.report.read_text())

    def results(self) -> tuple[object, dict[str, str]]:
        """Every drive, and every file of the evaluation; the times of stages in the store differ."""
        with closing(open_store(self.folder)) as store:
            tests = {test.test_id: test.road.road_id for test in store.tests()}
            drives = sorted((one.test_id, one.simulator, one.trajectory_sha256) for one in store.executions())
        files = sorted(path for name in ("maps", "evaluation") for path in (self.folder / name).rglob("*.*"))
        texts = {str(path.relative_to(self.folder)): path.read_bytes().hex() for path in files}
        return (tests, drives), texts


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    with pytest.MonkeyPatch.context() as patch:
        run = Run(tmp_path_factory.mktemp("whole"), patch)
        assert run(staged=False) == CONFIG.executions_at_most == 72 and not run.answers
    return run


@pytest.mark.parametrize("stops", [(), (5, 25), (24, 1, 1)])
def test_the_first_answer_is_of_a_part_of_the_same_campaign(
    stops: tuple[int, ...], whole: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tmp_path / "staged", monkeypatch)
    assert sum(map(run, stops)) + run() == 72  # nothing is driven twice, wherever it was stopped
    assert run.results() == whole.results()

    (first,) = run.answers  # an answer that was given is not given again
    assert first.tests == 8 and first.executions == 24 and first.answer.command.startswith("ds campaign resume")
    assert "8 roads" in first.answer.where and first.answer.where in run.shown[0]
    assert "24 roads" in first.report.read_text()


def test_where_only_elites_migrate_the_whole_search_decides_which(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tmp_path / "elites", monkeypatch)
    run(config=CONFIG.model_copy(update={"migration": "elites"}))
    assert not run.answers
