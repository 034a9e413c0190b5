# SPDX-License-Identifier: Apache-2.0
"""The report in headless Chromium: hovering, clicks, keys, on a wide screen and on a narrow one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest
from report_campaigns import NOWHERE, make_campaign, make_tests, report_of, set_conditions

from ds_analysis.paper.campaign_contents import maps_of
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.folder import read_campaign
from ds_orchestrator.maps.feature_map import FeatureMap, MapCell, MapId, compared_ids
from ds_orchestrator.search.features import Cell
from ds_orchestrator.store.model import Test
from ds_orchestrator.store.store import Store
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import parse_conditions
from ds_sim.gates.gate import Gate, GateState
from ds_sim.registry import BULLET, SimulatorName, label_of
from ds_sim.simulator import Outcome

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

TIMEOUT = 60_000
"""Limit for every action of a page, ms; chosen: a hundred times what it takes."""
PLACE = """([name, x, y]) => {
  const plot = document.querySelector(`[data-map="${name}"]`);
  const box = plot.querySelector(".nsewdrag").getBoundingClientRect();
  const { x: columns, y: rows } = plot.data[0];
  return [box.x + box.width * (columns.indexOf(x) + 0.5) / columns.length,
          box.y + box.height * (rows.length - rows.indexOf(y) - 0.5) / rows.length];
}"""


class Opened:
    """A report in a page of the browser, with its console errors and requests."""

    def __init__(
        self, browser: Browser, path: Path, width: int = 1280, scheme: Literal["light", "dark"] = "light"
    ) -> None:
        self.page: Page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        self.page.set_default_timeout(TIMEOUT)
        self.complaints: list[str] = []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self._asked(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("body[data-ready]")

    def _asked(self, address: str) -> None:
        if not address.startswith(("file:", "data:", "blob:")):
            self.complaints.append(address)

    def place(self, name: str, cell: tuple[int, ...]) -> tuple[float, float]:
        """Scroll to the middle of a map's cell, and return its place on the screen."""
        self.page.locator(f'[data-map="{name}"]').scroll_into_view_if_needed()
        x, y = self.page.evaluate(PLACE, [name, cell[0], cell[1]])
        return x, y

    def shown(self, name: str) -> dict[tuple[int, int], float | None]:
        """Read what a map draws: cell -> value, or None if the cell is empty."""
        columns, rows, values = self.page.evaluate(
            'name => { const t = document.querySelector(`[data-map="${name}"]`).data[0]; return [t.x, t.y, t.z]; }',
            name,
        )
        return {(x, y): values[j][i] for j, y in enumerate(rows) for i, x in enumerate(columns)}

    def show(self, test: Test) -> None:
        place = f"#cell={test.road.turns_count}-{int(100 * test.road.curvature)}"
        self.page.evaluate("place => { location.hash = place; }", place)
        self.page.click(f'[data-test="{test.test_id}"]')
        shown = "id => document.querySelector('.test h4').textContent === `Test ${id}`"
        self.page.wait_for_function(shown, arg=test.test_id)

    def tests(self) -> list[str]:
        found: list[str] = self.page.eval_on_selector_all("[data-test]", "all => all.map(b => b.dataset.test)")
        return found

    def width_missing(self) -> int:
        """Pixels by which the page is wider than its window."""
        missing: int = self.page.evaluate("document.documentElement.scrollWidth - innerWidth")
        return missing


class Campaign:
    def __init__(self, folder: Path, config: CampaignConfig, per_sibling: int) -> None:
        self.config = config
        self.store: Store = make_campaign(folder, config, per_sibling, bags=True)
        self.maps: dict[MapId, FeatureMap] = maps_of(read_campaign(self.store))
        self.path = report_of(folder, self.store)

    @property
    def fullest_on_bullet(self) -> tuple[Cell, MapCell]:
        return max(self.maps[MapId.union(BULLET)].cells.items(), key=lambda item: (item[1].tests, item[0]))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    config = CampaignConfig(siblings=[BULLET, SimulatorName("nowhere:B")], twin=SimulatorName("nowhere:C"), seed=7)
    return Campaign(tmp_path_factory.mktemp("seen"), config, 4)


@pytest.fixture(scope="module")
def opened(browser: Browser, campaign: Campaign) -> Opened:
    return Opened(browser, campaign.path)


def test_it_opens_without_a_complaint_and_fits_the_screen(opened: Opened) -> None:
    assert opened.page.locator("[data-maps=compared] .plot svg.main-svg").count() >= 4
    assert opened.width_missing() <= 0
    assert opened.complaints == []
    assert opened.page.locator("#configuration pre").is_hidden()


OVERLAPS = """() => {
  const clashes = [];
  for (const plot of document.querySelectorAll(".plot")) {
    const texts = [...plot.querySelectorAll(".xtick text, .ytick text, .infolayer text")].filter((t) => t.textContent);
    const boxes = texts.map((t) => [t.textContent, t.getBoundingClientRect()]);
    boxes.forEach(([one, a], i) => boxes.slice(i + 1).forEach(([other, b]) => {
      const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      const high = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      if (wide > 2 && high > 3) clashes.push(`${one} | ${other}`);
    }));
    for (const [text, box] of boxes) if (box.right > innerWidth || box.left < 0) clashes.push(`${text} is cut off`);
  }
  return clashes;
}"""
"""Texts of a chart that overlap or leave the screen."""


def test_on_a_phone_nothing_collides_or_is_cut_off_and_a_tap_is_read_out(browser: Browser, campaign: Campaign) -> None:
    report = Opened(browser, campaign.path, 390)
    page = report.page
    assert report.width_missing() <= 0
    assert page.evaluate(OVERLAPS) == []
    too_wide = "all => all.filter(t => t.scrollWidth > t.parentElement.clientWidth).map(t => t.id)"
    assert page.eval_on_selector_all(".stack", too_wide) == []
    cell, content = campaign.fullest_on_bullet
    page.mouse.click(*report.place("union_bullet", cell))
    page.wait_for_function("place => location.hash === place", arg="#cell=" + "-".join(map(str, cell)))
    readout = page.locator("figure.map", has=page.locator('[data-map="union_bullet"]')).locator(".readout")
    words = readout.inner_text()
    assert f"{content.failures} of {content.tests} test" in words and f"radius {100 / cell[1]:.1f} m" in words
    # No label hides the cell under the finger.
    assert page.locator(".maps .hoverlayer .hovertext").count() == 0
    assert report.complaints == []
    page.close()


def test_dark_mode_turns_page_and_charts_dark_but_paper_stays_white(browser: Browser, campaign: Campaign) -> None:
    report = Opened(browser, campaign.path, scheme="dark")
    page = report.page
    lightness = """selector => {
      const node = document.querySelector(selector);
      const style = getComputedStyle(node);
      const of_page = selector === "body" ? style.backgroundColor : style.color;
      const colour = node instanceof SVGElement ? style.fill : of_page;
      return colour.match(/[0-9.]+/g).slice(0, 3).reduce((sum, part) => sum + Number(part) / 765, 0);
    }"""
    texts = ("#finding", ".hint", '[data-map="merged"] .ytick text', '[data-map="merged"] .infolayer text')
    assert page.evaluate(lightness, "body") < 0.15
    assert all(page.evaluate(lightness, text) > 0.6 for text in texts)
    lanes = ('[data-chart="road"] .fills path', '[data-chart="lateral"] .shapelayer path')
    assert all(page.evaluate(lightness, lane) < 0.35 for lane in lanes)
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate(lightness, "body") == 1.0 and page.evaluate(lightness, "#finding") < 0.2
    page.close()


def test_printed_charts_and_tables_shrink_with_the_page(browser: Browser, campaign: Campaign) -> None:
    """A page of A4 is 703 pixels wide between its margins; the charts are drawn for a wide screen."""
    report = Opened(browser, campaign.path)
    page = report.page
    page.evaluate("() => { document.body.style.width = '703px'; }")
    page.emulate_media(media="print")
    wide = page.eval_on_selector_all(
        ".plot .main-svg, table, pre",
        "all => all.filter(n => n.getBoundingClientRect().right > 704).map(n => n.className.baseVal ?? n.outerHTML)",
    )
    assert wide == []
    assert page.locator(".command button").first.is_hidden() and page.locator("nav").is_hidden()
    page.close()


def test_commands_drive_a_test_again(opened: Opened, campaign: Campaign) -> None:
    test = campaign.store.tests()[0]
    opened.show(test)
    lines = opened.page.locator("#cell .command pre").all_inner_texts()
    bags = [f"{test.test_id}-on-{label_of(name)}" for name in campaign.config.simulators]
    assert lines == [
        *(f"ds bag redrive bags/{bag} --video {bag}.mp4" for bag in bags),
        f"ds campaign roads . --test {test.test_id} > road.json",
        *(
            f"ds drive --sim {name} --driver dave2 --road road.json --seed {test.seed}"
            for name in campaign.config.simulators
        ),
    ]
    opened.page.evaluate("() => { navigator.clipboard.writeText = async (text) => { window.copied = text; }; }")
    opened.page.locator("#cell .command button").first.click()
    opened.page.wait_for_function("text => window.copied === text", arg=lines[0])
    words = opened.page.locator("article.test .hint").first.inner_text()
    assert f"tightest bend {1 / test.road.curvature:.1f} m in radius" in words


def test_maps_draw_their_values_and_nothing_where_nothing_is_known(opened: Opened, campaign: Campaign) -> None:
    for value in ("quality_loss", "tests", "probability"):
        opened.page.click(f"[data-value={value}]")
        for map_id in (MapId.union(BULLET), MapId.merged(), MapId.twin(SimulatorName("nowhere:C"))):
            name = map_id.name
            expected = {cell: getattr(content, value) for cell, content in campaign.maps[map_id].cells.items()}
            opened.page.wait_for_function(
                '([name, total]) => Math.abs(document.querySelector(`[data-map="${name}"]`).data[0].z.flat()'
                ".reduce((sum, v) => sum + (v ?? 0), 0) - total) < 1e-2",
                arg=[name, sum(expected.values())],
            )
            shown = opened.shown(name)
            assert {cell for cell, drawn in shown.items() if drawn is not None} == set(expected)
            assert {cell: shown[cell[0], cell[1]] for cell in expected} == pytest.approx(expected, abs=1e-4)
            assert any(drawn is None for drawn in shown.values())
    assert 0.0 in opened.shown("merged").values()


def test_hovering_over_a_cell_shows_it_in_every_map(opened: Opened, campaign: Campaign) -> None:
    name = "union_bullet"
    cell, content = campaign.fullest_on_bullet
    empty = next(place for place, value in opened.shown(name).items() if value is None)
    for where, told in ((cell, f"{content.failures} of {content.tests} test"), (empty, "no test")):
        opened.page.mouse.move(5, 5)
        opened.page.mouse.move(*opened.place(name, where))
        opened.page.wait_for_function(
            "() => [...document.querySelectorAll('[data-maps=compared] .plot')]"
            ".every(plot => plot.querySelector('.hoverlayer .hovertext'))"
        )
        labels: list[str] = opened.page.eval_on_selector_all(
            "[data-maps=compared] .plot", "all => all.map(plot => plot.querySelector('.hoverlayer').textContent)"
        )
        assert len(labels) == 4 and told in labels[0]
        assert all(f"turns count {where[0]}curvature {where[1] / 100:.2f} to" in label for label in labels)
        assert all(f"radius {100 / where[1]:.1f} m to" in label for label in labels)
    opened.page.mouse.move(5, 5)


def test_a_click_opens_the_tests_with_their_roads_and_drives(opened: Opened, campaign: Campaign) -> None:
    merged = campaign.maps[MapId.merged()].cells
    for cell in sorted(merged):
        opened.page.mouse.click(*opened.place("merged", cell))
        roads = {test.test_id: test.road for test in campaign.store.tests()}
        wanted = [name for name, road in roads.items() if (road.turns_count, int(100 * road.curvature)) == cell]
        opened.page.wait_for_function(
            "wanted => wanted.join() === [...document.querySelectorAll('[data-test]')]"
            ".map(button => button.dataset.test).sort().join()",
            arg=sorted(wanted),
        )
    first = opened.tests()[0]
    assert opened.page.locator("article.test h4").first.inner_text() == f"Test {first}"
    for number, test_id in enumerate(opened.tests()):
        opened.page.click(f'[data-test="{test_id}"]')
        driven = [e for e in campaign.store.executions() if e.test_id == test_id]
        opened.page.wait_for_function(
            "() => ['road', 'lateral', 'steering'].every(kind => document.querySelector(`[data-chart=${kind}]`).data)"
        )
        lines: dict[str, Any] = opened.page.evaluate(
            "() => Object.fromEntries(document.querySelector('[data-chart=road]').data"
            ".filter(t => t.mode === 'lines' && t.name).map(t => [t.name, [t.x.at(-1), t.y.at(-1)]]))"
        )
        # Every simulator's drive ends where it ended.
        assert set(lines) == {e.simulator for e in driven}
        for execution in driven:
            assert lines[execution.simulator] == pytest.approx(list(execution.trajectory[-1, :2]), abs=0.011)
        failed = sum(e.outcome.is_failure for e in driven)
        assert opened.page.locator(".test table.outcomes td.failed").count() == failed, number
        images = opened.page.locator(".strip img")
        assert images.count() == 5
        assert images.first.evaluate("image => image.decode().then(() => image.naturalWidth)") == 240
    assert opened.complaints == []


def test_a_failed_test_is_replayed_by_keys_and_pointer(opened: Opened, campaign: Campaign) -> None:
    """Marks on the map, words and pictures at a time are those of the stored drives."""
    page = opened.page
    test, execution = next(
        (test, e)
        for test in campaign.store.tests()
        for e in campaign.store.executions()
        if e.test_id == test.test_id and e.simulator == "bullet" and e.outcome.is_failure
    )
    opened.show(test)
    slider, view = page.locator("#cell .replay input"), page.locator("#cell .replay .view").first
    # It opens where the first drive of all has failed.
    driven = [e for e in campaign.store.executions() if e.test_id == test.test_id and e.outcome.is_failure]
    first = min(int(np.argmax(np.abs(e.trajectory[:, 4]) > 2.0)) / 20 for e in driven)
    assert float(slider.input_value()) == pytest.approx(first, abs=0.11)
    slider.focus()
    for key, presses, frame in (("Home", 1, 0), ("ArrowRight", 17, 34), ("ArrowLeft", 2, 30), ("End", 1, -1)):
        for _ in range(presses):
            slider.press(key)
        lateral = execution.trajectory[frame, 4]
        assert view.inner_text().count(f"{lateral:.2f} m right") == 1, (key, view.inner_text())
        assert ("out of bounds" in view.inner_text()) == (frame == -1)
        assert f"bullet: {lateral:.2f} m right" in (slider.get_attribute("aria-valuetext") or "")
        assert view.locator("img").evaluate("image => image.decode().then(() => image.naturalWidth)") == 240
        # The latest picture, of which there is one every half second.
        pictured = re.match(r"bullet, ([\d.]+) s, ", view.locator("img").get_attribute("alt") or "")
        time = frame / 20 if frame >= 0 else execution.simulated_seconds
        assert pictured and -0.06 < time - float(pictured[1]) < 0.51, (time, pictured)
    box = page.locator("#cell .replay .timeline").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 20)
    assert float(slider.input_value()) == pytest.approx(float(slider.get_attribute("max") or 0) / 2, abs=0.11)
    page.click("#cell .replay button")
    page.wait_for_function(
        "() => { const slider = document.querySelector('#cell .replay input'); return +slider.value === +slider.max; }"
    )
    page.wait_for_selector("#cell .replay button[aria-pressed=false]")
    assert opened.complaints == []


def test_arrow_keys_choose_cells(opened: Opened) -> None:
    plot = opened.page.locator('[data-map="merged"]')
    columns, rows = zip(*opened.shown("merged"), strict=True)
    opened.page.evaluate("() => document.activeElement.blur()")
    plot.focus()
    for _ in range(len(set(columns))):
        plot.press("ArrowLeft")
    for _ in range(len(set(rows))):
        plot.press("ArrowDown")
    opened.page.wait_for_function("place => location.hash === place", arg=f"#cell={min(columns)}-{min(rows)}")
    opened.page.wait_for_function(
        "start => document.getElementById('said').textContent.startsWith(start)", arg=f"turns count {min(columns)}, "
    )
    plot.press("ArrowRight")
    opened.page.wait_for_function("place => location.hash === place", arg=f"#cell={min(columns) + 1}-{min(rows)}")


def test_folds_open_with_their_maps_and_tables(opened: Opened, campaign: Campaign) -> None:
    opened.page.click("text=Where the tests come from")
    opened.page.wait_for_function(
        "() => [...document.querySelectorAll('[data-maps=origins] .plot')].every(plot => plot.data)"
    )
    assert opened.page.locator("[data-maps=origins] .plot").count() == 6
    opened.page.click("text=The maps as a table")
    filled = {cell for map_id in compared_ids(campaign.maps) for cell in campaign.maps[map_id].cells}
    opened.page.wait_for_function(
        "rows => document.querySelectorAll('#numbers tbody tr').length === rows", arg=len(filled)
    )
    assert opened.complaints == []


def test_three_features_are_shown_slice_by_slice(browser: Browser, tmp_path: Path) -> None:
    features = ["turns_count", "curvature", "direction_coverage:10"]
    config = CampaignConfig(siblings=[SimulatorName("nowhere:A")], twin=None, features=features)
    campaign = Campaign(tmp_path, config, 8)
    report = Opened(browser, campaign.path)
    cells = campaign.maps[MapId.merged()].cells
    slices = sorted({cell[2] for cell in cells})
    assert len(slices) > 1
    for third in slices:
        report.page.select_option("#slice", str(third))
        wanted = sorted([cell[0], cell[1]] for cell in cells if cell[2] == third)
        report.page.wait_for_function(
            "wanted => { const t = document.querySelector('[data-map=\"merged\"]').data[0];"
            " const filled = t.x.flatMap((x, i) => t.y.flatMap((y, j) => t.z[j][i] === null ? [] : [[x, y]]));"
            " return JSON.stringify(filled) === JSON.stringify(wanted); }",
            arg=wanted,
        )
    cell = max(cell for cell in cells if cell[2] == slices[-1])
    report.page.mouse.click(*report.place("merged", cell))
    report.page.wait_for_function("place => location.hash === place", arg="#cell=" + "-".join(map(str, cell)))
    report.page.wait_for_selector("[data-test]")
    assert report.complaints == []
    report.page.close()


def test_tests_are_filtered_by_their_conditions(browser: Browser, tmp_path: Path) -> None:
    config = NOWHERE.model_copy(update={"twin": None, "conditions": parse_conditions("visibility=60")})
    store = Store(tmp_path / "campaign.sqlite", config=config.identity())
    kinds = (Conditions(visibility=40.0), Conditions(visibility=200.123, friction=0.5))
    for number, (test, driven) in enumerate(make_tests(config, 4, roads=1)):
        store.add_test(set_conditions(test, kinds[number % 2]))
        store.add_execution(driven[0])
        gate = Gate(state=GateState.INFEASIBLE, message="the autopilot ends stuck", outcome=Outcome.STUCK)
        store.add_gate(test.test_id, SimulatorName("b:Two"), gate)
    opened, tests = Opened(browser, report_of(tmp_path, store)), store.tests()
    excluded = opened.page.locator("#excluded li").all_inner_texts()
    assert excluded == ["b:Two: 8 of 8 gated tests enter no map: 8 infeasible"]
    opened.show(tests[0])
    assert sorted(opened.tests()) == [test.test_id for test in tests]
    words = opened.page.locator("article.test").inner_text()
    assert any(said in words for said in ("Conditions visibility = 40.", "visibility = 200,"))  # of three digits
    assert "infeasible: the autopilot ends stuck" in words
    field = opened.page.locator("#cell input[type=search]")
    for terms, kept in (
        ("visibility < 60", {kinds[0]}),
        ("visibility>60, friction=0.5", {kinds[1]}),
        ("fri", {kinds[1]}),
        ("visibility < 60, friction", set()),
        ("fog", set()),
        ("", set(kinds)),
    ):
        field.fill(terms)
        assert sorted(opened.tests()) == [test.test_id for test in tests if test.conditions in kept], terms
    assert opened.complaints == []
