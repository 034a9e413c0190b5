# SPDX-License-Identifier: Apache-2.0
"""The report without a browser: nothing is fetched, everything is inside, text is escaped, also with almost no data."""

from __future__ import annotations

import base64
import csv
import json
import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from report_campaigns import (
    EVIL,
    NOWHERE,
    campaign_data,
    make_campaign,
    make_execution,
    make_map,
    make_tests,
    report_of,
    results,
    road,
    set_conditions,
)
from statsmodels.stats.proportion import proportion_confint

from ds_analysis.paper.campaign_contents import maps_of
from ds_analysis.paper.correlation import Correlation, PairedDifference, evaluate, paired_differences
from ds_analysis.paper.paper_tables import read_correlations
from ds_base.table import Column, Table
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import CampaignData, read_campaign
from ds_orchestrator.maps.feature_map import FeatureMap, MapId, map_ids
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Origin, Test
from ds_orchestrator.store.store import Store
from ds_report.build import write_all, write_report
from ds_report.findings import RoadOutcomes, best_split, road_outcomes, summarise, where_it_fails
from ds_report.page_data import page_data
from ds_road import Road
from ds_sim import BULLET, DONKEY, SOFTBODY, SimulatorName
from ds_sim.conditions.model import Conditions
from ds_sim.registry import label_of
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome


class Page(HTMLParser):
    """Elements of a page with their attributes, and the text of each kind of element."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self._open: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "img", "br"):
            self._open.append(tag)
            self.texts.setdefault(tag, []).append("")

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        for tag in set(self._open):
            self.texts[tag][-1] += data

    @property
    def data(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.texts["script"][0])
        return found


ReadPage = tuple[Page, str, Store]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> ReadPage:
    folder = tmp_path_factory.mktemp("campaign")
    config = CampaignConfig(siblings=[DONKEY, EVIL], twin=SimulatorName("nowhere:Twin"), seed=77)
    store = make_campaign(folder, config, 6)
    store.add_error("donkey-0-0001", EVIL, 0, Outcome.SIM_ERROR, "<img src=x> broke & stopped")
    html = report_of(folder, store).read_text(encoding="utf-8")
    return Page(html), html, store


def test_every_map_is_inside(campaign: ReadPage) -> None:
    page, _, store = campaign
    maps = maps_of(read_campaign(store))
    assert page.data["maps"].keys() == {map_id.name for map_id in maps}
    for map_id, feature_map in maps.items():
        cells: dict[Cell, Any] = {(cell[0], cell[1]): cell[2:] for cell in page.data["maps"][map_id.name]["cells"]}
        assert cells.keys() == feature_map.cells.keys()
        for cell, value in feature_map.cells.items():
            tests, failures, probability, interval, quality = cells[cell]
            assert [tests, failures] == [value.tests, value.failures] and value.interval is not None
            expected = [value.probability, *value.interval, value.quality_loss]
            assert [probability, *interval, quality] == pytest.approx(expected, abs=1e-4)


def test_nothing_is_fetched(campaign: ReadPage) -> None:
    page, html, *_ = campaign
    # Plotly's code names sites for geographic maps; the policy below forbids fetching from them.
    own = html.replace(page.texts["script"][1], "")
    assert len(own) < len(html) - 10**6
    assert not re.findall(r"(?i)https?:|//[a-z0-9-]+\.[a-z]|@import|url\((?!#)", re.sub(r"base64,[\w+/=]+", "", own))
    for tag, attributes in page.elements:
        for name in ("src", "href", "action", "data", "srcset"):
            target = attributes.get(name)
            assert target is None or target.startswith(("data:", "#")), (tag, target)
    policies = [a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert policies == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"]


def test_text_is_escaped(campaign: ReadPage) -> None:
    page, html, *_ = campaign
    assert "</script><script>alert" not in html and "<img src=x>" not in html and "1.2.3<b>" not in html
    # Escaped in HTML text, and restored for the script that reads the data.
    assert any(EVIL in text for text in page.texts["h1"])
    assert "<img src=x> broke & stopped" in page.texts["td"]
    assert page.data["simulators"][1]["name"] == EVIL
    assert len(page.texts["script"]) == 3


def test_errors_and_what_is_left_over_are_listed(tmp_path: Path) -> None:
    store = make_campaign(tmp_path, NOWHERE, 2)
    lost = Test("A-0-0009", Scenario(road(1), seed=1), Origin(NOWHERE.siblings[0], 0, 9))
    store.add_test(lost)
    store.add_error(lost.test_id, "a:One", 0, Outcome.SIM_ERROR, "the wheels came off")
    store.give_up(lost.test_id)
    page = Page(report_of(tmp_path, store).read_text())
    cells = page.texts["td"]
    assert "the wheels came off" in cells and "a:One, b:Two, c:Three" in cells
    assert "every attempt ended in an error on a:One; the search continued without it" in cells
    assert any(text.startswith("1 attempt ended in an error.") for text in page.texts["p"])
    assert any(text.startswith("1 test. A test without an outcome enters no map") for text in page.texts["p"])


def test_tables_of_the_evaluation_stand_in_the_page(tmp_path: Path) -> None:
    data = campaign_data(tmp_path, NOWHERE, 4)
    rq2 = Table(
        name="rq2",
        title="RQ2 & more",
        notes=["A note."],
        columns=[Column("vs DT"), Column("r", "number"), Column("p", "p"), Column("paper: p", "p")],
        rows=[["DS1", 0.5, 0.0, 1e-17], ["DSS", None, 0.25, None]],
    )
    densities = Table(
        name="rq1_densities",
        title="RQ1: densities",
        rows=[[0.0, 0.04, 25.0], [0.04, 0.08, 0.0]],
        columns=[Column("error from", "number"), Column("to", "number"), Column("a:One", "number")],
    )
    maps, correlations = results(data)
    path = write_report(tmp_path, data, maps, correlations, tables=[densities, rq2], network=("dave2", "sim"))
    page = Page(path.read_text())
    assert page.texts["caption"] == ["RQ2 & more"] and "A note." in page.texts["p"]
    at = page.texts["td"].index("0.500")
    # A p-value of 0 does not exist.
    assert page.texts["td"][at - 1 : at + 7] == ["DS1", "0.500", "< 0.001", "< 0.001", "DSS", "–", "0.250", "–"]
    assert page.data["figures"]["densities"]["data"][0]["y"] == [25.0, 0.0]
    # The chart has the campaign's numbers and the paper's, for RQ2 and RQ3.
    ours, paper = page.data["figures"]["correlations"]["data"][:2]
    assert ours["x"] == [c.r for c in correlations if c.r is not None]
    assert len(paper["x"]) == 6


def test_a_thousand_tests_stay_small() -> None:
    config = CampaignConfig()
    tests, driven = zip(*make_tests(config, 500, roads=40), strict=True)
    campaign = CampaignData(config=config, tests=tests, executions=tuple(chain.from_iterable(driven)))
    page = page_data(campaign, maps_of(campaign))
    assert len(page["tests"]) == 1000
    # Plotly takes 5 MB and pictures 2, so that 5,000 tests stay below 20 MB.
    assert len(json.dumps(page)) < 2.5e6


# Two siblings and a twin over four cells, each six times: they agree on failure in one, on none in one, and disagree in
# two.
UNIONS = {"bullet": (1.0, 0.0, 0.5, 0.0), "softbody": (0.5, 0.0, 0.0, 0.5)}
MERGED = (0.5, 0.0, 0.0, 0.0)
TWIN = (1.0, 0.0, 0.0, 0.5)
TIMES = 6


def hand_made(map_id: MapId, values: tuple[float, ...], times: int = TIMES) -> FeatureMap:
    return make_map(map_id, {(k, 10): (value, value) for k, value in enumerate(values * times)})


def driven(config: CampaignConfig) -> CampaignData:
    """One test that every simulator completed."""
    test = Test("t", Scenario(road(0), seed=1), Origin(config.siblings[0], 0, 0))
    executions = tuple(make_execution(test, name, 0.5) for name in config.simulators)
    return CampaignData(config=config, tests=(test,), executions=executions)


def said(siblings: list[SimulatorName], merged: tuple[float, ...], twin: tuple[float, ...], times: int = TIMES) -> str:
    config = CampaignConfig(siblings=siblings)
    values = {MapId.union(name): UNIONS[name] for name in siblings} | {MapId.merged(): merged, MapId.twin(DONKEY): twin}
    maps = {map_id: hand_made(map_id, of, times) for map_id, of in values.items()}
    correlations, added = evaluate(maps, siblings, DONKEY), paired_differences(maps, siblings, DONKEY, resamples=50)
    found = summarise(driven(config), maps, correlations, paired_differences=added)
    return " ".join((found.headline, *found.details))


def test_findings_say_what_the_numbers_say() -> None:
    text = said([BULLET, SOFTBODY], MERGED, TWIN)
    assert "Of 24 cells that all siblings fill, they agree on failure in 6, agree on no failure in 6 and " in text
    assert "disagree in 12." in text
    # By NumPy: softbody's map is nearest to the twin's, then the merged one, then bullet's.
    r = {name: np.corrcoef(of, TWIN)[0, 1] for name, of in {**UNIONS, "merged": MERGED}.items()}
    assert r["softbody"] > r["merged"] > r["bullet"] > 0
    assert f"r = {r['merged']:.2f} (bullet {r['bullet']:.2f} and softbody {r['softbody']:.2f})" in text
    assert "worse than softbody alone" in text or "not distinguishable from" in text
    assert "Of 6 cells in which the merged map predicts failures, the twin fails in 6; of 18 cells" in text
    assert "predicts none, the twin fails in 6." in text


def test_too_few_failing_cells_carry_no_conclusion() -> None:
    """The four cells once: two fail. Neither r nor a comparison of maps is stated."""
    text = said([BULLET, SOFTBODY], MERGED, TWIN, times=1)
    assert text.count("No conclusion about how well the siblings predict the twin: the twin fails in 2 of 4 cells") == 1
    assert "r =" not in text and "better than" not in text and "distinguishable" not in text


def test_a_map_is_called_better_only_when_the_interval_leaves_0_out() -> None:
    config = CampaignConfig(siblings=[BULLET, SOFTBODY, SimulatorName("third:Simulator")])
    unions = [MapId.union(name) for name in config.siblings]
    added = [
        PairedDifference(over=union, value="quality_loss", cells=30, r=(low + high) / 2, r_interval=(low, high))
        for union, low, high in zip(unions, (0.05, -0.2, -0.3), (0.2, 0.3, -0.1), strict=True)
    ]
    correlations = [
        Correlation(map=map_id, value="quality_loss", cells=30, failing=12, r=0.5, p=0.001)
        for map_id in (*unions, MapId.merged())
    ]
    maps = {map_id: hand_made(map_id, MERGED) for map_id in (*unions, MapId.merged())}
    maps[MapId.twin(DONKEY)] = hand_made(MapId.twin(DONKEY), TWIN)
    *_, sentence = summarise(driven(config), maps, correlations, paired_differences=added).details
    assert sentence.endswith(
        ": better than bullet alone, worse than third:Simulator alone and not distinguishable from softbody alone."
    )


def test_findings_say_why_there_is_no_correlation() -> None:
    text = said([BULLET, SOFTBODY], MERGED, (0.0, 0.0, 0.0, 0.0))
    assert "predict the twin: the twin fails in 0 of 24 cells" in text and "r =" not in text
    text = said([BULLET, SOFTBODY], (0.5, 0.5, 0.5, 0.5), TWIN)
    assert "cannot be compared with the twin: the map's probability is 0.5 in every cell" in text
    assert "does not predict" in said([BULLET, SOFTBODY], MERGED, (0.0, 1.0, 0.5, 0.0))


def test_findings_of_one_sibling() -> None:
    text = said([BULLET], UNIONS["bullet"], TWIN)
    assert "bullet, the only sibling, has failures in 12 of 24 cells." in text
    assert "its map and the merged map are the same" in text


def shaped(curvature: float, turns: int, number: int) -> Test:
    """A test whose road has these features, whatever its control points, and is no mutant of another."""
    made = Road(road(number).control_points)
    made.__dict__.update(curvature=curvature, turns_count=turns)
    return Test(f"t{number}", Scenario(made, seed=1), Origin(SimulatorName("A"), 0, number))


def outcomes(*roads: tuple[float, int, bool]) -> RoadOutcomes:
    """Roads by curvature, turns and whether they fail."""
    tests = tuple(shaped(curvature, turns, k) for k, (curvature, turns, _) in enumerate(roads))
    return RoadOutcomes(where="the twin T", tests=tests, failed=tuple(failed for *_, failed in roads))


def test_the_headline_names_the_bend_from_which_roads_fail() -> None:
    gentle, tight = [(0.1, 3, False)] * 20, [(0.2, 3, True)] * 4 + [(0.25, 2, False)]
    text = where_it_fails(DriverName("net"), outcomes(*gentle, *tight))
    # Radius 1 / 0.2; no road is alone at the threshold, so that the others choose the same: Clopper and Pearson's
    # intervals of 4 of 5 and 0 of 20 by statsmodels.
    ends = [proportion_confint(k, n, method="beta") for k, n in ((4, 5), (0, 20))]
    assert text == (
        "On the twin T, net fails on roads with a bend of 5.0 m radius or tighter (curvature 0.200 1/m or more): "
        "4 of 5 such roads failed, and none of the 20 others. Among roads that did not choose this threshold, "
        f"80% (95% interval {100 * ends[0][0]:.0f} to {100 * ends[0][1]:.0f}%) fail, against "
        f"0% (95% interval 0 to {100 * ends[1][1]:.0f}%)."
    )


def test_the_headline_names_turns_where_they_separate_better() -> None:
    few = [(0.1 + 0.01 * (k % 7), 2, False) for k in range(20)]
    many = [(0.1 + 0.01 * (k % 7), 5, True) for k in range(8)]
    text = where_it_fails(DriverName("net"), outcomes(*few, *many))
    assert "net fails on roads with 5 turns or more: 8 of 8 such roads failed, and none of the 20 others." in text


def under(made: RoadOutcomes, name: str, values: list[float]) -> RoadOutcomes:
    """The same roads, each with its own value of a condition."""
    pairs = zip(made.tests, values, strict=True)
    return replace(made, tests=tuple(set_conditions(test, Conditions(**{name: value})) for test, value in pairs))


@pytest.mark.parametrize(
    ("name", "hard", "easy", "said"),
    [
        ("visibility", 40.0, 90.0, "in fog or haze with a visibility of 47 m or less (visibility)"),
        ("visibility", 3000.0, 4000.0, "in fog or haze with a visibility of 3010 m or less (visibility)"),
        ("friction", 0.2, 0.5, "on a road with a fifth or less of the dry road's grip (friction 0.207)"),
        ("camera_pitch", -0.1, 0.02, "with the camera tilted 5.3 degrees or more up (camera_pitch -0.093 rad)"),
        ("camera_pitch", 0.1, -0.02, "with the camera tilted 5.7 degrees or more down (camera_pitch 0.1 rad)"),
    ],
)
def test_the_headline_names_the_condition_that_separates_best(name: str, hard: float, easy: float, said: str) -> None:
    failing, passing = [(0.1, 3, True)] * 8, [(0.2, 3, False)] * 20
    step = 1.0 if name == "visibility" else 0.001
    values = [hard + step * k for k in range(8)] + [easy + step * k for k in range(20)]
    text = where_it_fails(DriverName("net"), under(outcomes(*failing, *passing), name, values))
    assert f"net fails {said}: 8 of 8 such tests failed" in text and "none of the 20 others" in text


def test_a_threshold_on_bends_names_the_conditions_under_which_it_was_found() -> None:
    made = under(outcomes(*[(0.1 + 0.01 * k, 3, k >= 8) for k in range(20)]), "visibility", [40.0, 50.0] * 10)
    text = where_it_fails(DriverName("net"), made)
    assert text.startswith(
        "On the twin T, all tests in fog or haze with a visibility of 40 to 50 m (visibility), net fails on tests "
    )


def test_a_condition_that_a_test_leaves_to_the_simulator_has_no_threshold() -> None:
    made = outcomes(*[(0.1, 3, k < 9) for k in range(20)])
    values = [0.4] * 9 + [0.1] * 11
    assert best_split(under(made, "pavement_reflectance", values)) is not None
    split = best_split(under(made, "pavement_reflectance", [*values[:-1], None]))  # type: ignore[list-item]
    assert split is None


def test_the_headline_claims_no_threshold_that_chance_would_find() -> None:
    mixed = outcomes(*[(0.1 + 0.01 * k, 3, k in (2, 9)) for k in range(12)])
    split = best_split(mixed)
    assert split is not None and not split.is_clear
    text = where_it_fails(DriverName("net"), mixed)
    assert text.startswith("net failed on 2 of 12 roads, 17%") and "Neither the tightest bend" in text
    assert "There are 12 roads, which is few: from 16 random roads on" in text
    # One road that fails and one that does not carry no threshold, however well they are separated.
    assert "Neither" in where_it_fails(DriverName("net"), outcomes((0.1, 2, False), (0.2, 3, True)))


@pytest.mark.parametrize(
    ("roads", "start"),
    [
        ([(0.1, 2, False)] * 9, "net failed on none of 9 roads, 0% (95% interval 0 to 34%), on the twin T."),
        ([(0.1, 2, True)] * 9, "net failed on all 9 roads, 100% (95% interval 66 to 100%), on the twin T;"),
        ([(0.1, 2, True)], "net failed on the only road, 100%"),
        ([], "No road has an outcome on the twin T yet"),
    ],
)
def test_the_headline_of_campaigns_without_a_contrast(roads: list[tuple[float, int, bool]], start: str) -> None:
    assert where_it_fails(DriverName("net"), outcomes(*roads)).startswith(start)


def test_a_road_fails_where_the_twin_fails_or_else_where_every_sibling_does() -> None:
    tests = [shaped(0.1, 2, 0), shaped(0.2, 2, 1)]
    executions = [
        make_execution(test, name, offset)
        for test, offsets in zip(tests, ((2.5, 0.5, 2.5), (2.5, 2.5, 0.5)), strict=True)
        for name, offset in zip(NOWHERE.simulators, offsets, strict=True)
    ]
    data = CampaignData(config=NOWHERE, tests=tuple(tests), executions=tuple(executions))
    assert road_outcomes(data).failed == (True, False) and road_outcomes(data).where == "the twin c:Three"
    alone = replace(data, config=NOWHERE.model_copy(update={"twin": None}))
    assert road_outcomes(alone).failed == (False, True) and road_outcomes(alone).where == "every sibling"


def test_limits_say_what_was_tested_and_what_was_not() -> None:
    found = summarise(driven(CampaignConfig()), results(driven(CampaignConfig()))[0], [])
    only = road(0)
    assert f"Tested: 1 road with {only.turns_count} turns" in found.limits
    assert f"{1 / only.curvature:.1f} m radius" in found.limits and "traffic" in found.limits
    assert "Only the shape of the road varied" in found.limits


def test_limits_name_the_conditions_that_were_tested() -> None:
    data, fog = driven(CampaignConfig()), "Conditions: in fog or haze with a visibility of 50 m (visibility)."
    foggy = replace(data, tests=(set_conditions(data.tests[0], Conditions(visibility=50.0)),))
    maps, seeing = results(data)[0], CampaignConfig(driver=DriverName("dave2_real"))
    limits = summarise(foggy, maps, []).limits
    assert f"{fog} Traffic" in limits and "shape of the road" not in limits
    assert f"{fog} The driver saw translated images" in summarise(replace(foggy, config=seeing), maps, []).limits
    assert "translated" not in summarise(replace(data, config=seeing), maps, []).limits


def test_a_search_of_conditions_shows_its_maps_over_further_features(tmp_path: Path) -> None:
    config = CampaignConfig.model_validate(
        {
            "siblings": ["nowhere:A"],
            "twin": None,
            "search": {"conditions": {"line_contrast": {"low": 0.1, "high": 1.0}}},
            "features": ["lane_curvature", "line_contrast"],
        }
    )
    store = make_campaign(tmp_path, config, 4, changed=lambda test: set_conditions(test, Conditions(line_contrast=0.5)))
    page = Page(write_all(tmp_path, store).read_text())
    store.close()
    images = [attributes for tag, attributes in page.elements if tag == "img"]
    shown, of_merged = (image for image in images if (image["alt"] or "").startswith("curvature by turns count: "))
    assert "Siblings merged" in (of_merged["alt"] or "")
    maps = json.loads((tmp_path / "maps/turns_count_by_curvature/maps.json").read_text())
    (union,) = (content for name, content in maps.items() if name.startswith("union_"))
    merged = maps["merged"]
    failing = sum(cell["failures"] > 0 for cell in union["cells"])
    assert 0 < failing < len(union["cells"]) and len(merged["cells"]) == len(union["cells"])
    assert f"All tests on nowhere:A: failures in {failing} of {len(union['cells'])} cells" in (shown["alt"] or "")
    picture = cv2.imdecode(np.frombuffer(base64.b64decode((shown["src"] or "").partition(",")[2]), np.uint8), 1)
    drawn = cv2.imread(str(next((tmp_path / "maps/turns_count_by_curvature").glob("union_*_probability.png"))))
    assert picture is not None and drawn is not None and np.array_equal(picture, drawn)


def test_the_page_of_a_large_campaign_shows_its_worst_tests_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ds_report.build.SHOWN_TESTS", 3)
    store = make_campaign(tmp_path, NOWHERE.model_copy(update={"twin": None, "driver": AUTOPILOT}), 5)
    failures = Counter({test.test_id: 0 for test in store.tests()})
    failures.update(one.test_id for one in store.executions() if one.outcome.is_failure)
    page = Page(report_of(tmp_path, store).read_text(encoding="utf-8"))
    shown = [test[0] for test in page.data["tests"]]
    assert len(shown) == 3 and min(failures[i] for i in shown) >= max(n for i, n in failures.items() if i not in shown)
    for map_id, feature_map in maps_of(read_campaign(store)).items():
        assert len(page.data["maps"][map_id.name]["cells"]) == len(feature_map.cells)
    assert any("Below are the 3 worst" in text for text in page.texts["p"])
    store.close()


TWO = CampaignConfig(
    siblings=[SimulatorName("nowhere:A"), SimulatorName("path_to_x:Sim")], twin=SimulatorName("nowhere:Twin")
)
"""Simulators that cannot be created, so that nothing is rendered; one has a name that looks like a migration."""
ONE, ALONE = (TWO.model_copy(update=changed) for changed in ({"siblings": TWO.siblings[:1]}, {"twin": None}))
FAILS, PASSES = 2.5, 0.5


def store_of(folder: Path, config: CampaignConfig, offsets: list[float], roads: list[int]) -> Store:
    """Create a store with one test per road, the siblings in turn, each with the same outcome on every simulator."""
    store = Store(folder / "campaign.sqlite", config=config.identity())
    for k, (offset, seed) in enumerate(zip(offsets, roads, strict=True)):
        sibling = config.siblings[k % len(config.siblings)]
        test = Test(f"t-0-{k:04d}", Scenario(road(seed), seed=1), Origin(sibling, 0, k))
        store.add_test(test)
        for name in config.simulators:
            store.add_execution(make_execution(test, name, offset))
    return store


@pytest.mark.parametrize(
    ("config", "offsets", "roads", "said"),
    [
        pytest.param(TWO, [PASSES], [0], "did not fail on the only road", id="one test"),
        pytest.param(TWO, [FAILS], [0], "failed on the only road", id="one failure"),
        pytest.param(TWO, [FAILS, PASSES], [0, 1], "failed on 1 of 2 roads", id="two tests"),
        pytest.param(TWO, [PASSES] * 6, list(range(6)), "failed on none of 6 roads", id="no failures"),
        pytest.param(TWO, [FAILS] * 6, list(range(6)), "failed on all 6 roads", id="all failures"),
        pytest.param(TWO, [FAILS, PASSES] * 2, [0] * 4, "failed on the only road", id="one road"),
        pytest.param(ONE, [FAILS, PASSES, PASSES], [0, 1, 2], "failed on 1 of 3 roads", id="one sibling"),
        pytest.param(ALONE, [FAILS, PASSES, PASSES], [0, 1, 2], "failed on 1 of 3 roads", id="no twin"),
        pytest.param(TWO, [], [], "Nothing was driven yet", id="nothing"),
    ],
)
def test_the_whole_chain(
    tmp_path: Path, config: CampaignConfig, offsets: list[float], roads: list[int], said: str
) -> None:
    store = store_of(tmp_path, config, offsets, roads)
    store.add_error("t-0-0000", config.siblings[0], 0, Outcome.SIM_ERROR, "broke")
    page = write_all(tmp_path, store).read_text(encoding="utf-8")
    assert said in page
    for path in (tmp_path / "maps").glob("*.json"):
        json.loads(path.read_text(), parse_constant=pytest.fail)
    for map_id in map_ids(config.siblings, config.twin):
        stem = tmp_path / "maps" / label_of(map_id.name)
        assert all(Path(f"{stem}{end}").is_file() for end in (".json", "_probability.png", "_quality.png"))
    tables = list((tmp_path / "evaluation").glob("*.csv"))
    assert any(not path.stem.startswith("sibling_") for path in tables) == bool(config.twin)
    assert any(path.stem.startswith("sibling_") for path in tables) == bool(offsets)
    assert ("What does a sibling add?" in page) == bool(offsets) == ("too few failures to say" in page)
    for path in tables:
        assert not {"nan", "inf", "-inf"} & {value for row in csv.reader(path.open()) for value in row}
    found = read_correlations(tmp_path, config)
    compared = 2 * (len(config.siblings) + 1)
    assert len(found) == (compared if config.twin else 0)
    # With so few cells r allows no conclusion, and no interval is given.
    assert all(c.caution and c.r_interval is None and c.auc_interval is None for c in found)
    assert ("No conclusion from this campaign" in page) == bool(config.twin)
    # Write again: the results are up to date, and rewriting them loses nothing.
    assert write_all(tmp_path, store).read_text(encoding="utf-8") == page
    store.close()


def test_a_report_says_what_each_sibling_adds(tmp_path: Path) -> None:
    """The same outcomes everywhere, on roads that do not decide them: the second sibling says no more."""
    fails = np.random.default_rng(3).permutation(24) < 12
    store = store_of(tmp_path, TWO, [FAILS if one else PASSES for one in fails], list(range(24)))
    page = write_all(tmp_path, store).read_text(encoding="utf-8")
    store.close()
    adds = r"<li>nowhere:A adds 0\.\d+ bits \(.*\) about nowhere:Twin beyond features: adds information</li>"
    assert re.search(adds, page)
    assert re.search(r"<li>path_to_x:Sim adds .* beyond features and nowhere:A: nothing shown</li>", page)
    assert page.count('<img class="wide" src="data:image/png;base64,') == 2
    rows = list(csv.DictReader((tmp_path / "evaluation" / "sibling_information.csv").open()))
    assert [row["verdict"] for row in rows] == ["adds information", "nothing shown"]


def test_correlations_of_an_earlier_version_are_read(tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    of_r = {"cells": 9, "r": 0.5, "p": 0.1, "reason": "", "r_interval": [0.1, 0.9]}
    of_auc = {"baseline": 0, "auc": None, "auc_interval": None, "auc_reason": "why"}
    row = {"name": "union_path_to_x:Sim", "value": "quality", **of_r, **of_auc}
    (tmp_path / "maps" / "correlations.json").write_text(json.dumps([row]))
    (found,) = read_correlations(tmp_path, TWO)
    assert found.map == MapId.union(SimulatorName("path_to_x:Sim")) and found.value == "quality_loss"
    assert found.r_interval == (0.1, 0.9) and found.failing is None and found.caution == ""
