# SPDX-License-Identifier: Apache-2.0
"""Computes every number on the page of the paper's campaign from the stored tables of outcomes, without driving.

`python -m benchmarks.replication.tables [--out docs/data/replication.csv]`: the paper's claims, case by case, with an
interval over the five runs, which are five independent searches; then counts, maps and alarms. Draws the pictures.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from benchmarks.replication.drive import NETWORKS, TABLES, title_of
from benchmarks.replication.stored import read
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray
from scipy import stats

from ds_analysis.paper.campaign_contents import maps_of
from ds_analysis.paper.correlation import check_robustness, evaluate
from ds_analysis.paper.paper_tables import RQ2, RQ3, PaperRow, role_of
from ds_base.figures import WIDTH, draw_figure
from ds_base.intervals import jeffreys_interval
from ds_base.palette import BETWEEN, FAIL, PASS
from ds_base.palette import SERIES as GROUPS
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData
from ds_orchestrator.maps.feature_map import FeatureMap, MapId, compared_ids
from ds_orchestrator.store.model import Test
from ds_sim import SimulatorName
from ds_sim.camera.encodings import png
from ds_sim.registry import NO_SIMULATOR, PANDA

ROLES = ("DS1", "DS2", "DSS")
QUESTIONS = {"RQ2": ("probability", RQ2), "RQ3": ("quality_loss", RQ3)}
RUNS = 5
REAL_TESTS = 120
"""Tests of a run on pseudo-real images in the paper: 20, and 100 iterations (4.2.4); ours have 150 iterations."""
SHOWN = "epoch"
"""Network of the picture of the idea; chosen: most of its cells have tests, and its siblings differ."""
THIRD = PANDA
THIRD_RUN = 0
"""Run whose tests a third sibling drives, too; chosen: whole searches, so that its maps are like those of any run."""
AGREED = ("all siblings fail", "no sibling fails")
UNDEFINED = (np.nan, np.nan, np.nan)
Row = tuple[tuple[str, ...], tuple[float, ...]]
"""Network, question, measure and who; then the paper's value, ours, the mean over runs and its interval."""
BETTER, WORSE = "DSS minus the better", "DSS minus the worse"
CLAIMS = (
    ("RQ2", "r", BETTER),
    ("RQ2", "auc", BETTER),
    ("RQ3", "r", BETTER),
    ("RQ3", "r", WORSE),
    ("RQ3", "auc", BETTER),
)
"""Question, measure and comparison of what the paper claims of the merged map."""


class Score(NamedTuple):
    """How well a map predicts the twin's failures; NaN where undefined."""

    r: float
    auc: float


@dataclass(frozen=True)
class Driven:
    """The runs of a network that were driven everywhere, together and each alone."""

    data: CampaignData
    runs: tuple[CampaignData, ...]

    @cached_property
    def maps(self) -> dict[MapId, FeatureMap]:
        """Maps of all tests together."""
        return maps_of(self.data)


def third_table(network: str) -> Path:
    """Where `benchmarks.replication.third_sibling` keeps a network's outcomes on three siblings."""
    return TABLES / f"{network}_{THIRD}.parquet"


def of_runs(data: CampaignData, runs: Collection[int]) -> CampaignData:
    """The tests of some runs of every sibling's search."""
    return _chosen(data, lambda test: test.run in runs)


def with_tests(data: CampaignData, most: int) -> CampaignData:
    """The first tests of every run, as a search of fewer iterations makes them."""
    return _chosen(data, lambda test: test.number < most)


def _chosen(data: CampaignData, is_chosen: Callable[[Test], bool]) -> CampaignData:
    tests = tuple(filter(is_chosen, data.tests))
    ids = {test.test_id for test in tests}
    return replace(data, tests=tests, executions=tuple(one for one in data.executions if one.test_id in ids))


def is_complete(data: CampaignData) -> bool:
    """Whether every test of the run was driven everywhere."""
    expected = len(data.config.siblings) * data.config.settings.budget * len(data.config.simulators)
    return len(data.verdicts) == expected


def scores_of(maps: Mapping[MapId, FeatureMap], config: CampaignConfig) -> dict[str, dict[str, Score]]:
    """Question -> role -> score."""
    assert config.twin
    scores: dict[str, dict[str, Score]] = {question: {} for question in QUESTIONS}
    for one in evaluate(maps, config.siblings, config.twin):
        for question, (value, _) in QUESTIONS.items():
            if one.value == value:
                score = Score(*(np.nan if number is None else number for number in (one.r, one.auc)))
                scores[question][role_of(one.map.simulator, config.siblings)] = score
    return scores


def over_runs(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean and 95% interval (Student's t) over independent runs; NaN if fewer than two are defined."""
    defined = np.array([value for value in values if np.isfinite(value)])
    if len(defined) < 2:
        return float(defined.mean()) if len(defined) else np.nan, np.nan, np.nan
    half = float(stats.t.ppf(0.975, len(defined) - 1)) * float(defined.std(ddof=1)) / len(defined) ** 0.5
    return float(defined.mean()), float(defined.mean()) - half, float(defined.mean()) + half


def rows_of(network: str, driven: Driven) -> Iterator[Row]:
    """Rows of the CSV: network, question, measure, who, paper, ours, mean over runs, its interval."""
    architecture, _, real = network.partition("_")
    whole = scores_of(driven.maps, driven.data.config)
    each = [scores_of(maps_of(run), run.config) for run in driven.runs]
    for question, (_, published) in QUESTIONS.items():
        paper: dict[str, PaperRow] = published[architecture, "real" if real else "sim"]
        for measure in Score._fields:
            theirs = {role: float(getattr(paper[role], measure)) for role in ROLES}
            ours = {role: float(getattr(whole[question][role], measure)) for role in ROLES}
            by_run = [{role: float(getattr(one[question][role], measure)) for role in ROLES} for one in each]
            for values in (theirs, ours, *by_run):
                values[BETTER] = values["DSS"] - max(values["DS1"], values["DS2"])
                values[WORSE] = values["DSS"] - min(values["DS1"], values["DS2"])
            for who in ours:
                mean = over_runs([one[who] for one in by_run])
                yield (network, question, measure, who), (theirs[who], ours[who], *mean)
    for key, row in (*_computed_otherwise(driven, whole), *_counts(driven)):
        yield (network, *key), row


def _computed_otherwise(driven: Driven, main: dict[str, dict[str, Score]]) -> Iterator[Row]:
    """The merged map minus the better sibling as the authors' package computes them, and with every operator."""
    data = driven.data
    assert data.config.twin
    scores: dict[tuple[str, str, str], dict[str, float]] = {}
    for check in check_robustness(driven.maps, data.config.siblings, data.config.twin):
        question = next(question for question, (value, _) in QUESTIONS.items() if value == check.value)
        for measure, score in (("r", None if check.what.startswith("AUC") else check.r), ("auc", check.auc)):
            if check.against == MapId.twin(data.config.twin) and score is not None:
                role = role_of(check.map.simulator, data.config.siblings)
                scores.setdefault((question, measure, check.what), {})[role] = score
    only_elites = data.config.model_copy(update={"migration": "elites"})
    elites = scores_of(maps_of(replace(data, config=only_elites)), only_elites)
    for question, measure in product(QUESTIONS, Score._fields):
        by_role = {role: getattr(elites[question][role], measure) for role in ROLES}
        scores[question, measure, "only the elites of each run (maxitwo)"] = by_role
    for (question, measure, what), by_role in scores.items():
        if "DSS" in by_role:  # operators change the merged map only
            better = max(by_role.get(role, getattr(main[question][role], measure)) for role in ("DS1", "DS2"))
            yield (question, f"{measure}: {what}", BETTER), (np.nan, by_role["DSS"] - better, *UNDEFINED)


def _counts(driven: Driven) -> Iterator[Row]:
    """What failed, and what agreement is worth: per test and per cell of the map."""
    data = driven.data
    failed = data.failed
    for simulator in data.config.simulators:
        shares = [
            float(np.mean([one.outcome.is_failure for one in run.verdicts if one.simulator == simulator]))
            for run in driven.runs
        ]
        count = sum(value for (_, name), value in failed.items() if name == simulator)
        yield ("counts", "tests failed", simulator), (np.nan, count, *over_runs(shares))
    twin, siblings = data.config.twin or NO_SIMULATOR, data.config.siblings
    for who, wanted in zip(AGREED, (len(siblings), 0), strict=True):
        agreed = [
            failed[test.test_id, twin]
            for test in data.tests
            if sum(failed[test.test_id, name] for name in siblings) == wanted
        ]
        interval = jeffreys_interval(sum(agreed), len(agreed)) if agreed else (np.nan, np.nan)
        yield ("counts", who, "tests"), (np.nan, len(agreed), *UNDEFINED)
        yield ("counts", who, "fail on the twin"), (np.nan, sum(agreed), np.nan, *interval)
    merged, truth = driven.maps[MapId.merged()].cells, driven.maps[MapId.twin(SimulatorName(twin))].cells
    fails = {cell for cell, value in truth.items() if value.probability > 0}
    alarms = {cell for cell, value in merged.items() if value.probability > 0}
    cells = {"failing on the twin": fails, "on the twin": truth, "alarms": alarms, "false alarms": alarms - fails}
    for who, of_these in cells.items():
        yield ("counts", "cells", who), (np.nan, len(of_these), *UNDEFINED)


SCALE = LinearSegmentedColormap.from_list("maps", [PASS, BETWEEN, FAIL])


def _draw_map(drawn: FeatureMap, axes: Axes, title: str) -> AxesImage:
    """Draw the failure probabilities of a map of turns and curvature."""
    (turns, curvature), values = zip(*drawn.cells, strict=True), drawn.cells.values()
    grid = np.full((max(curvature) + 1, max(turns) + 1), np.nan)
    grid[curvature, turns] = [cell.probability for cell in values]
    extent = (-0.5, max(turns) + 0.5, -0.005, max(curvature) / 100 + 0.005)
    image = axes.imshow(grid, SCALE, vmin=0.0, vmax=1.0, origin="lower", aspect="auto", extent=extent)
    axes.set(title=title, xlim=(0.5, None), ylim=(0.01, None))
    axes.grid(visible=False)
    return image


def draw_maps(networks: Mapping[str, Driven]) -> NDArray[np.uint8]:
    """Draw the failure probabilities of each network in a row: the siblings', the merged ones, the twin's."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(networks), 4, squeeze=False, sharex=True, sharey=True)
        for (network, driven), row in zip(networks.items(), panels, strict=True):
            for id_, axes in zip(compared_ids(driven.maps), row, strict=True):
                title = driven.maps[id_].title.removeprefix("All tests on ").lower()
                title = {"siblings merged": "merged", "twin donkey": "twin"}.get(title, title)
                image = _draw_map(driven.maps[id_], axes, f"{title_of(network)}: {title}")
            row[0].set_ylabel("curvature, 1/m")
        for axes in panels[-1]:
            axes.set_xlabel("turns count")
        figure.colorbar(image, ax=panels, label="failure probability; white cells have no test", aspect=60, pad=0.01)

    return draw_figure(WIDTH, 60 + 260 * len(networks), draw)


def draw_idea(network: str, driven: Driven) -> NDArray[np.uint8]:
    """Draw the maps of two siblings, their product and the twin's map side by side."""
    titles = ("bullet, a sibling", "\u00d7   softbody, a sibling", "=   the merged map", "donkey, the twin")

    def draw(figure: Figure) -> None:
        figure.suptitle(f"Where both siblings fail, expect the twin to fail ({title_of(network)})", x=0.01, ha="left")
        panels = figure.subplots(1, 4, sharey=True)
        for id_, axes, title in zip(compared_ids(driven.maps), panels, titles, strict=True):
            image = _draw_map(driven.maps[id_], axes, title)
            axes.set_xlabel("number of turns")
        panels[0].set_ylabel("curvature of the sharpest bend, 1/m")
        bar = figure.colorbar(image, ax=panels, label="share of tests that fail", aspect=20, pad=0.01)
        bar.set_ticks([0.0, 0.5, 1.0], labels=["0%", "50%", "100%"])

    return draw_figure(WIDTH, 320, draw)


def draw_claims(networks: Sequence[str], cells: Mapping[tuple[str, ...], tuple[float, ...]]) -> NDArray[np.uint8]:
    """Draw what merging gains over a sibling: a claim in each panel, a network in each row."""

    def draw(figure: Figure) -> None:
        figure.suptitle("Merging minus a sibling: below 0, the merged map predicts the twin worse", x=0.01, ha="left")
        panels = figure.subplots(1, len(CLAIMS), sharey=True)
        for (question, measure, who), axes in zip(CLAIMS, panels, strict=True):
            rows = np.array([cells[network, question, measure, who] for network in networks])
            paper, ours, _, low, high = rows.T
            places = np.arange(len(networks))
            axes.axvline(0.0, color="black", linewidth=0.8)
            axes.hlines(places, low, high, color=GROUPS[0], linewidth=2.0, label="95% interval over five runs")
            axes.plot(ours, places, "o", color=GROUPS[0], label="ours, all tests")
            axes.plot(paper, places, "D", color=GROUPS[1], markersize=5, label="the paper")
            what = "failures" if question == "RQ2" else "quality"
            title = f"{question}, {what}: {'r' if measure == 'r' else 'AUC-PRC'}"
            names = [title_of(network) for network in networks]
            axes.set(title=title, xlabel=who.replace("DSS", "merged"), yticks=places, yticklabels=names)
        panels[0].set_ylim(len(networks) - 0.5, -0.5)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))

    return draw_figure(WIDTH, 130 + 28 * len(networks), draw)


def main() -> None:
    """Write the table and the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/data/replication.csv"))
    parser.add_argument("--pictures", type=Path, default=Path("docs/images"))
    arguments = parser.parse_args()
    drawn: dict[str, Driven] = {}
    cells: dict[tuple[str, ...], tuple[float, ...]] = {}
    with arguments.out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["network", "question", "measure", "who", "paper", "ours", "mean over runs", "low", "high"])
        for network in [name for name in NETWORKS if (TABLES / f"{name}.parquet").exists()]:
            data = read(TABLES / f"{network}.parquet")
            runs = tuple(run for run in (of_runs(data, {number}) for number in range(RUNS)) if is_complete(run))
            print(f"{network}: {len(runs)} of {RUNS} runs driven everywhere, {len(data.executions)} executions")
            if not runs:
                continue
            drawn[network] = Driven(of_runs(data, {test.run for run in runs for test in run.tests}), runs)
            cells |= dict(rows_of(network, drawn[network]))
        for network, driven in drawn.items():
            if network.endswith("_real"):
                whole, *shorter = (with_tests(one, REAL_TESTS) for one in (driven.data, *driven.runs))
                cells |= dict(rows_of(f"{network}, first {REAL_TESTS}", Driven(whole, tuple(shorter))))
            if (table := third_table(network)).exists():
                three, two = read(table), of_runs(driven.data, {THIRD_RUN})
                for name, run in ((f"{network}, first run", two), (f"{network}, with {THIRD}", three)):
                    cells |= {(name, *key): values for key, values in _counts(Driven(run, (run,)))}
        for (network, *key), values in cells.items():
            base, comma, part = network.partition(",")
            numbers = ("" if np.isnan(one) else one if isinstance(one, int) else f"{one:.3f}" for one in values)
            writer.writerow([f"{title_of(base)}{comma}{part}", *key, *numbers])
    (arguments.pictures / "replication_maps.png").write_bytes(png(draw_maps(drawn)))
    (arguments.pictures / "idea.png").write_bytes(png(draw_idea(SHOWN, drawn[SHOWN])))
    (arguments.pictures / "replication_claims.png").write_bytes(png(draw_claims(list(drawn), cells)))


if __name__ == "__main__":
    main()
