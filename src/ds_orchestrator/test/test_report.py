"""The report, read back as a browser would: nothing from outside, everything inside, and every word escaped."""

from __future__ import annotations

import base64
import json
import re
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ds_orchestrator.config import CampaignConfig
from ds_orchestrator.evaluation import Correlation, evaluate
from ds_orchestrator.features import Cell
from ds_orchestrator.findings import summarise
from ds_orchestrator.maps import FeatureMap, MapCell, campaign_maps
from ds_orchestrator.report import TOLERANCE, camera_pictures, page_data, write_report
from ds_orchestrator.store import Execution, Store, Test
from ds_road import Road, generate
from ds_sim.registry import label_of
from ds_sim.simulator import Outcome

EVIL = "nowhere:</script><script>alert('&')</script>"
"""The name of a simulator that cannot be made, and that no page may take at its word."""


@cache
def road(seed: int) -> Road:
    return generate(np.random.default_rng(seed), max_angle=200)


def make_execution(test: Test, simulator: str, offset: float) -> Execution:
    """Along the right lane, drifting to the right until `offset` m; the run ends when the lane is left."""
    centre, across = test.road.right_lane_centre, (test.road.right_edge - test.road.left_edge) / (2 * 4.0)
    lateral = np.linspace(0.0, offset, len(centre))
    steps = int(np.argmax(lateral > 2.0)) + 1 if offset > 2.0 else len(centre)
    path = centre + lateral[:, None] * across
    trajectory = np.column_stack((path, np.zeros(len(path)), np.full(len(path), 8.0), lateral))[:steps]
    worst = float(np.abs(trajectory[:, 4]).max())
    return Execution(
        test_id=test.test_id, simulator=simulator,
        outcome=Outcome.OUT_OF_BOUNDS if worst > 2.0 else Outcome.COMPLETED,
        message="", fitness=2.0 - worst, max_lateral_position=worst, steps=steps - 1,
        simulated_seconds=(steps - 1) / 20, trajectory_sha256="", trajectory=trajectory,
    )  # fmt: skip


def make_tests(config: CampaignConfig, per_sibling: int, *, roads: int = 8) -> list[tuple[Test, list[Execution]]]:
    """Tests that the searches found, each driven on every simulator."""
    rng = np.random.default_rng(5)
    made = []
    for k, sibling in enumerate(config.siblings):
        for number in range(per_sibling):
            test_id = f"{label_of(sibling)}-0-{number:04d}"
            chosen = road((len(config.siblings) * number + k) % roads)
            test = Test(test_id=test_id, sibling=sibling, run=0, number=number, road=chosen, seed=3)
            driven = [make_execution(test, name, float(rng.uniform(0.2, 2.6))) for name in config.simulators]
            made.append((test, driven))
    return made


def make_campaign(folder: Path, config: CampaignConfig, per_sibling: int) -> Store:
    """A store of such tests."""
    store = Store(folder / "campaign.sqlite", config=config.model_dump_json())
    store.note("version numpy", "1.2.3<b>")
    for test, driven in make_tests(config, per_sibling):
        store.add_test(test)
        for execution in driven:
            store.add_execution(execution)
    return store


def results(store: Store, config: CampaignConfig) -> tuple[dict[str, FeatureMap], list[Correlation]]:
    maps = campaign_maps(config.siblings, config.twin, store.tests(), store.executions())
    return maps, evaluate(maps, config.siblings, config.twin) if config.twin else []


class Page(HTMLParser):
    """What a browser finds in a page: elements with attributes, and the text of each kind of element."""

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


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> tuple[Page, str, Store, CampaignConfig]:
    folder = tmp_path_factory.mktemp("campaign")
    config = CampaignConfig(siblings=["donkey", EVIL], twin="nowhere:Twin", seed=77)
    store = make_campaign(folder, config, 6)
    store.add_error("donkey-0-0001", EVIL, 0, Outcome.SIM_ERROR, "<img src=x> broke & stopped")
    html = write_report(folder, store, config, *results(store, config)).read_text(encoding="utf-8")
    return Page(html), html, store, config


def absolute(steps: list[int]) -> np.ndarray:
    """The points of a line, m."""
    return np.cumsum(np.array(steps).reshape(-1, 2), axis=0) / 100


def test_nothing_is_fetched(campaign: tuple[Page, str, Store, CampaignConfig]) -> None:
    page, html, *_ = campaign
    assert not re.findall(r"(?i)https?:|//[a-z0-9-]+\.[a-z]|@import|url\(", re.sub(r"base64,[\w+/=]+", "", html))
    for tag, attributes in page.elements:
        for name in ("src", "href", "action", "data", "srcset"):
            target = attributes.get(name)
            assert target is None or target.startswith(("data:", "#")), (tag, target)
    policies = [a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert len(policies) == 1 and (policies[0] or "").startswith("default-src 'none'; img-src data:;")


def test_every_map_and_every_test_is_inside(campaign: tuple[Page, str, Store, CampaignConfig]) -> None:
    page, _, store, config = campaign
    maps, _ = results(store, config)
    data = page.data
    assert set(data["maps"]) == set(maps) == {*data["compared"], *data["origins"]}
    for name, feature_map in maps.items():
        cells: dict[Cell, Any] = {(c[0], c[1]): c[2:] for c in data["maps"][name]["cells"]}
        assert set(cells) == set(feature_map.cells)
        for cell, value in feature_map.cells.items():
            assert cells[cell][:2] == [value.tests, value.failures]
            assert cells[cell][2:] == pytest.approx([value.probability, value.quality], abs=1e-4)
            assert data["turns"][0] <= cell[0] <= data["turns"][1]
            assert data["curvature"][0] <= cell[1] <= data["curvature"][1]
    assert [test["id"] for test in data["tests"]] == [test.test_id for test in store.tests()]
    assert tuple(data["selected"]) in maps["merged"].cells
    assert [s["name"] for s in data["simulators"]] == config.simulators


def test_lines_are_thinned_within_the_tolerance_and_failures_are_marked(
    campaign: tuple[Page, str, Store, CampaignConfig],
) -> None:
    page, _, store, config = campaign
    failed = 0
    for shown, test in zip(page.data["tests"], store.tests(), strict=True):
        drawn = page.data["roads"][shown["road"]]
        for name, points in (("left", test.road.left_edge), ("centre", test.road.points)):
            line = absolute(drawn[name])
            assert len(line) < len(points)
            assert max(_distance(p, line) for p in points) < TOLERANCE + 0.01
        for run, simulator in zip(shown["runs"], config.simulators, strict=True):
            execution = store.execution(test.test_id, simulator)
            assert execution is not None
            line = absolute(run["path"])
            assert max(_distance(p, line) for p in execution.trajectory[:, :2]) < TOLERANCE + 0.01
            assert run["failed"] == execution.outcome.is_failure == ("failedAt" in run)
            assert run["fitness"] == pytest.approx(execution.fitness, abs=1e-4)
            if run["failed"]:
                failed += 1
                x, y, distance, lateral = np.array(run["failedAt"]) / 100
                assert (x, y) == pytest.approx(tuple(execution.trajectory[-1, :2]), abs=0.006)
                assert lateral >= 2.0
                driven = np.hypot(*np.diff(execution.trajectory[:, :2], axis=0).T).sum()
                assert distance == pytest.approx(driven, abs=0.006)
    assert failed > 3


def _distance(point: np.ndarray, line: np.ndarray) -> float:
    """From a point to a line of points."""
    a, b = line[:-1], line[1:]
    along = np.clip(np.sum((point - a) * (b - a), axis=1) / np.maximum(np.sum((b - a) ** 2, axis=1), 1e-12), 0, 1)
    return float(np.hypot(*(a + along[:, None] * (b - a) - point).T).min())


def test_text_is_escaped(campaign: tuple[Page, str, Store, CampaignConfig]) -> None:
    page, html, *_ = campaign
    assert "</script><script>alert" not in html and "<img src=x>" not in html and "1.2.3<b>" not in html
    # Escaped for HTML where people read it, and whole again for the script that reads the data.
    assert any(EVIL in text for text in page.texts["h1"])
    assert "<img src=x> broke & stopped" in page.texts["td"]
    assert page.data["simulators"][1]["name"] == EVIL
    assert len(page.texts["script"]) == 2


def test_cameras_are_pictures_and_a_missing_simulator_is_a_note(
    campaign: tuple[Page, str, Store, CampaignConfig],
) -> None:
    page, *_ = campaign
    pictures = [a for tag, a in page.elements if tag == "img"]
    captions = page.texts["figcaption"]
    assert len(pictures) == 1 and len(captions) == 3
    raw = base64.b64decode((pictures[0]["src"] or "").removeprefix("data:image/png;base64,"))
    image = cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None and image.shape == (160, 320, 3) and image.std() > 20
    place = re.search(r"([\d.]+) m along the lane", captions[0])
    assert place and 45.0 <= float(place[1]) < 46.0
    assert "cannot be loaded" in captions[2]


def test_camera_pictures_repeat() -> None:
    test = Test(test_id="t", sibling="donkey", run=0, number=0, road=road(0), seed=1)
    assert camera_pictures(["donkey"], test) == camera_pictures(["donkey"], test)


def test_the_same_store_gives_the_same_bytes(tmp_path: Path) -> None:
    config = CampaignConfig(siblings=["nowhere:A"], twin=None)
    pages = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        store = make_campaign(tmp_path / name, config, 3)
        pages.append(write_report(tmp_path / name, store, config, *results(store, config)).read_bytes())
    assert pages[0] == pages[1]
    text = pages[0].decode()
    assert "No twin took part in this campaign" in text
    # The configuration can be copied out and run again.
    assert "cat &gt; campaign.yaml" in text and "siblings:\n- nowhere:A\ntwin: null\n" in text


def test_a_campaign_that_has_only_begun_has_a_report(tmp_path: Path) -> None:
    config = CampaignConfig(siblings=["nowhere:A", "nowhere2:B"], twin="nowhere3:C")
    store = Store(tmp_path / "campaign.sqlite", config=config.model_dump_json())
    page = Page(write_report(tmp_path, store, config, *results(store, config)).read_text())
    assert "Nothing was driven yet" in page.texts["p"][1]
    assert page.data["tests"] == [] and page.data["selected"] is None
    store.add_test(Test(test_id="A-0-0000", sibling="nowhere:A", run=0, number=0, road=road(1), seed=1))
    store.add_execution(make_execution(store.tests()[0], "nowhere:A", 2.4))
    page = Page(write_report(tmp_path, store, config, *results(store, config)).read_text())
    assert [run is None for run in page.data["tests"][0]["runs"]] == [False, True, True]
    assert any("no cell of the feature map in common" in text for text in page.texts["p"])
    assert any("1 of 3 runs have a verdict" in text for text in page.texts["li"])


def test_five_hundred_tests_stay_small() -> None:
    config = CampaignConfig()
    made = make_tests(config, 250, roads=40)
    tests, executions = [test for test, _ in made], [execution for _, driven in made for execution in driven]
    maps = campaign_maps(config.siblings, config.twin, tests, executions)
    data = page_data(config, maps, tests, executions)
    assert len(data["tests"]) == 500 and len(data["roads"]) == 40
    assert len(json.dumps(data)) < 4e6


# Two siblings and a twin over four cells: they agree on failure in one, on none in one, and disagree in two.
UNIONS = {"bullet": (1.0, 0.0, 0.5, 0.0), "softbody": (0.5, 0.0, 0.0, 0.5)}
MERGED = (0.5, 0.0, 0.0, 0.0)
TWIN = (1.0, 0.0, 0.0, 0.5)


def hand_made(name: str, values: tuple[float, ...]) -> FeatureMap:
    cells: dict[Cell, MapCell] = {
        (k, 10): MapCell(tests=2, failures=None, probability=v, quality=v) for k, v in enumerate(values)
    }
    return FeatureMap(name=name, cells=cells)


def said(siblings: list[str], merged: tuple[float, ...], twin: tuple[float, ...]) -> str:
    """Everything that is said about such maps."""
    config = CampaignConfig(siblings=siblings)
    values = {**{f"union_{name}": UNIONS[name] for name in siblings}, "merged": merged, "twin_donkey": twin}
    maps = {name: hand_made(name, of) for name, of in values.items()}
    test = Test(test_id="t", sibling="bullet", run=0, number=0, road=road(0), seed=1)
    driven = [make_execution(test, name, 0.5) for name in config.simulators]
    found = summarise(config, maps, evaluate(maps, siblings, "donkey"), driven, tests=1)
    return " ".join((found.headline, *found.details))


def test_findings_say_what_the_numbers_say() -> None:
    text = said(["bullet", "softbody"], MERGED, TWIN)
    assert "Of 4 cells that all siblings fill, they agree on failure in 1, agree on no failure in 1 and " in text
    assert "disagree in 2." in text
    # By NumPy: softbody's map is nearest to the twin's, then the merged one, then bullet's.
    r = {name: np.corrcoef(of, TWIN)[0, 1] for name, of in {**UNIONS, "merged": MERGED}.items()}
    assert r["softbody"] > r["merged"] > r["bullet"] > 0
    assert f"r = {r['merged']:.2f} (bullet {r['bullet']:.2f} and softbody {r['softbody']:.2f})" in text
    assert "better than bullet alone, but not better than softbody" in text and "this may be chance" in text
    assert "Of 1 cell in which the merged map expects failures, the twin fails in 1; of 3 cells" in text
    assert "expects none, the twin fails in 1." in text


def test_findings_say_why_there_is_no_correlation() -> None:
    text = said(["bullet", "softbody"], MERGED, (0.0, 0.0, 0.0, 0.0))
    assert "cannot be said: the twin's failure probability is 0 in every cell" in text and "r =" not in text
    assert "does not foretell" in said(["bullet", "softbody"], MERGED, (0.0, 1.0, 0.5, 0.5))


def test_findings_of_one_sibling() -> None:
    text = said(["bullet"], UNIONS["bullet"], TWIN)
    assert text.startswith("bullet, the only sibling, sees failures in 2 of 4 cells.")
    assert "and the merged map is the same" in text
