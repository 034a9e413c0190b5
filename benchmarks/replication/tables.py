"""Computes every number on the page of the paper's campaign from the stored tables of outcomes, without driving.

`python -m benchmarks.replication.tables [--out docs/data/replication.csv]`: the paper's claims, case by case, with an
interval over the five runs, which are five independent searches; then counts, maps and alarms. Draws the maps, too.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from benchmarks.replication.drive import NETWORKS, TABLES
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from ds_analysis.common.heatmap import COLOURS
from ds_analysis.common.restoration import restore_campaign
from ds_analysis.paper.campaign_contents import maps_of
from ds_analysis.paper.correlation import check_robustness, evaluate
from ds_analysis.paper.paper_tables import RQ2, RQ3, PaperRow, role_of
from ds_orchestrator.campaign.folder import CampaignData, open_store, read_campaign
from ds_orchestrator.maps.algebra import jeffreys_interval
from ds_orchestrator.maps.feature_map import MapId, compared_ids
from ds_road.figures import WIDTH, draw_figure
from ds_sim.camera.encodings import png

ROLES = ("DS1", "DS2", "DSS")
QUESTIONS = {"RQ2": ("probability", RQ2), "RQ3": ("quality_loss", RQ3)}
RUNS = 5


class Score(NamedTuple):
    """How well a map predicts the twin's failures; NaN where undefined."""

    r: float
    auc: float


def read(table: Path) -> CampaignData:
    """Contents of a stored campaign."""
    with tempfile.TemporaryDirectory() as folder:
        restore_campaign(table, Path(folder) / "campaign")
        with closing(open_store(Path(folder) / "campaign")) as store:
            return read_campaign(store)


def of_runs(data: CampaignData, runs: Collection[int]) -> CampaignData:
    """The tests of some runs of every sibling's search."""
    tests = tuple(test for test in data.tests if test.run in runs)
    ids = {test.test_id for test in tests}
    return replace(data, tests=tests, executions=tuple(one for one in data.executions if one.test_id in ids))


def is_complete(data: CampaignData) -> bool:
    """Whether every test of the run was driven everywhere."""
    expected = len(data.config.siblings) * data.config.settings.budget * len(data.config.simulators)
    return len(data.verdicts) == expected


def scores_of(data: CampaignData) -> dict[str, dict[str, Score]]:
    """Question -> role -> score."""
    assert data.config.twin
    found = evaluate(maps_of(data), data.config.siblings, data.config.twin)
    return {
        question: {
            role_of(one.map.simulator, data.config.siblings): Score(
                np.nan if one.r is None else one.r, np.nan if one.auc is None else one.auc
            )
            for one in found
            if one.value == value
        }
        for question, (value, _) in QUESTIONS.items()
    }


def over_runs(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean and 95 % interval (Student's t) over independent runs; NaN if fewer than two are defined."""
    defined = np.array([value for value in values if np.isfinite(value)])
    if len(defined) < 2:
        return float(defined.mean()) if len(defined) else np.nan, np.nan, np.nan
    half = float(stats.t.ppf(0.975, len(defined) - 1)) * float(defined.std(ddof=1)) / len(defined) ** 0.5
    return float(defined.mean()), float(defined.mean()) - half, float(defined.mean()) + half


def rows_of(network: str, data: CampaignData, runs: Sequence[CampaignData]) -> Iterator[list[object]]:
    """Rows of the CSV: network, question, measure, who, paper, ours, mean over runs, its interval."""
    architecture, _, real = network.partition("_")
    whole, each = scores_of(data), [scores_of(run) for run in runs]
    for question, (_, published) in QUESTIONS.items():
        paper: dict[str, PaperRow] = published[architecture, "real" if real else "sim"]
        for measure in Score._fields:
            theirs = {role: float(getattr(paper[role], measure)) for role in ROLES}
            ours = {role: float(getattr(whole[question][role], measure)) for role in ROLES}
            by_run = [{role: float(getattr(one[question][role], measure)) for role in ROLES} for one in each]
            for values in (theirs, ours, *by_run):
                values["DSS minus the better"] = values["DSS"] - max(values["DS1"], values["DS2"])
                values["DSS minus the worse"] = values["DSS"] - min(values["DS1"], values["DS2"])
            for who in ours:
                mean = over_runs([one[who] for one in by_run])
                yield [network, question, measure, who, theirs[who], ours[who], *mean]
    yield from ([network, *row] for row in _computed_otherwise(data, whole))
    yield from ([network, "counts", *row] for row in _counts(data, runs))


def _computed_otherwise(data: CampaignData, main: dict[str, dict[str, Score]]) -> Iterator[list[object]]:
    """The merged map minus the better sibling as the authors' package computes them, and with every operator."""
    assert data.config.twin
    found: dict[tuple[str, str, str], dict[str, float]] = {}
    for check in check_robustness(maps_of(data), data.config.siblings, data.config.twin):
        question = next(question for question, (value, _) in QUESTIONS.items() if value == check.value)
        for measure, score in (("r", None if check.what.startswith("AUC") else check.r), ("auc", check.auc)):
            if check.against == MapId.twin(data.config.twin) and score is not None:
                role = role_of(check.map.simulator, data.config.siblings)
                found.setdefault((question, measure, check.what), {})[role] = score
    elites = scores_of(replace(data, config=data.config.model_copy(update={"migration": "elites"})))
    for question, measure in product(QUESTIONS, Score._fields):
        by_role = {role: getattr(elites[question][role], measure) for role in ROLES}
        found[question, measure, "only the elites of each run (maxitwo)"] = by_role
    for (question, measure, what), by_role in found.items():
        if "DSS" in by_role:  # operators change the merged map only
            better = max(by_role.get(role, getattr(main[question][role], measure)) for role in ("DS1", "DS2"))
            ours = [by_role["DSS"] - better, np.nan, np.nan, np.nan]
            yield [question, f"{measure}: {what}", "DSS minus the better", np.nan, *ours]


def _counts(data: CampaignData, runs: Sequence[CampaignData]) -> Iterator[list[object]]:
    """What failed, and what agreement is worth: per test and per cell of the map."""
    failed = {(one.test_id, one.simulator): one.outcome.is_failure for one in data.verdicts}
    for simulator in data.config.simulators:
        shares = [
            float(np.mean([one.outcome.is_failure for one in run.verdicts if one.simulator == simulator]))
            for run in runs
        ]
        count = sum(value for (_, name), value in failed.items() if name == simulator)
        yield ["tests failed", simulator, np.nan, count, *over_runs(shares)]
    twin, siblings = str(data.config.twin), data.config.siblings
    for who, wanted in (("all siblings fail", len(siblings)), ("no sibling fails", 0)):
        agreed = [
            failed[test.test_id, twin]
            for test in data.tests
            if sum(failed[test.test_id, name] for name in siblings) == wanted
        ]
        interval = jeffreys_interval(sum(agreed), len(agreed)) if agreed else (np.nan, np.nan)
        yield [f"{who}, of {len(agreed)} tests on the twin", "fail", np.nan, sum(agreed), np.nan, *interval]
    maps = maps_of(data)
    merged, truth = maps[MapId.merged()].cells, maps[MapId.twin(twin)].cells
    fails = {cell for cell, value in truth.items() if value.probability > 0}
    alarms = {cell for cell, value in merged.items() if value.probability > 0}
    yield ["cells", "failing on the twin", np.nan, len(fails), np.nan, np.nan, np.nan]
    yield ["cells", "on the twin", np.nan, len(truth), np.nan, np.nan, np.nan]
    yield ["cells", "alarms", np.nan, len(alarms), np.nan, np.nan, np.nan]
    yield ["cells", "false alarms", np.nan, len(alarms - fails), np.nan, np.nan, np.nan]


def draw_maps(networks: Mapping[str, CampaignData]) -> NDArray[np.uint8]:
    """Draw the failure probabilities of each network in a row: the siblings', the merged ones, the twin's."""
    scale = LinearSegmentedColormap.from_list("maps", [np.array(colour) / 255 for colour in COLOURS])

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(networks), 4, squeeze=False, sharex=True, sharey=True)
        for (network, data), row in zip(networks.items(), panels, strict=True):
            maps = maps_of(data)
            for id_, axes in zip(compared_ids(maps), row, strict=True):
                (turns, curvature), cells = zip(*maps[id_].cells, strict=True), maps[id_].cells.values()
                grid = np.full((max(curvature) + 1, max(turns) + 1), np.nan)
                grid[curvature, turns] = [cell.probability for cell in cells]
                extent = (-0.5, max(turns) + 0.5, -0.005, max(curvature) / 100 + 0.005)
                image = axes.imshow(grid, scale, vmin=0.0, vmax=1.0, origin="lower", aspect="auto", extent=extent)
                title = maps[id_].title.removeprefix("All tests on ").lower()
                axes.set(title=f"{network}: {title}", xlim=(0.5, None), ylim=(0.01, None))
                axes.grid(visible=False)
            row[0].set_ylabel("curvature, 1/m")
        for axes in panels[-1]:
            axes.set_xlabel("turns count")
        figure.colorbar(image, ax=panels, label="failure probability", aspect=60, pad=0.01)

    return draw_figure(WIDTH, 60 + 260 * len(networks), draw)


def main() -> None:
    """Write the table and the picture, and print each row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/data/replication.csv"))
    parser.add_argument("--picture", type=Path, default=Path("docs/images/replication_maps.png"))
    arguments = parser.parse_args()
    drawn = {}
    with arguments.out.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["network", "question", "measure", "who", "paper", "ours", "mean over runs", "low", "high"])
        for table in sorted(TABLES.glob("*.parquet")):
            data = read(table)
            every = {run: of_runs(data, {run}) for run in range(RUNS)}
            runs = {run: one for run, one in every.items() if is_complete(one)}
            if not runs:
                print(f"{table.stem}: no run was driven everywhere yet ({len(data.executions)} executions)")
                continue
            print(f"{table.stem}: {len(runs)} of {RUNS} runs, {len(data.executions)} executions")
            drawn[table.stem] = of_runs(data, runs)
            for row in rows_of(table.stem, drawn[table.stem], list(runs.values())):
                cells = [f"{value:.3f}" if isinstance(value, float) and np.isfinite(value) else value for value in row]
                cells = ["" if isinstance(value, float) else value for value in cells]
                writer.writerow(cells)
                print("  ", *cells)
    arguments.picture.write_bytes(png(draw_maps({name: drawn[name] for name in NETWORKS if name in drawn})))


if __name__ == "__main__":
    main()
