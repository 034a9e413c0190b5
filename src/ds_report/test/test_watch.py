# SPDX-License-Identifier: Apache-2.0
"""The page of a running campaign: by HTTP, in headless Chromium, and never a change of the campaign's folder."""

from __future__ import annotations

import asyncio
import json
import shutil
import socket
import sqlite3
import threading
import time
from contextlib import ExitStack, closing, suppress
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode, urlsplit

import numpy as np
import pytest
from report_campaigns import EVIL, NOWHERE, make_campaign, make_execution, make_tests, road, set_conditions
from tests.waiting import wait_until

from ds_base.folder_files import StoreError
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.campaign.engine import Watch
from ds_orchestrator.campaign.executor import Listener
from ds_orchestrator.campaign.live_file import FRESH, LiveFile, read_live
from ds_orchestrator.graph.session import GraphEngine
from ds_orchestrator.store.model import Execution, Origin, Test
from ds_orchestrator.store.store import Store
from ds_report.watch import server as watch_server
from ds_report.watch.campaign_state import CampaignReader, page_state
from ds_report.watch.server import ServerError, serve
from ds_sim import BULLET, SimulatorName
from ds_sim.conditions.model import Conditions
from ds_sim.conditions.text import parse_conditions
from ds_sim.gates.gate import Gate, GateState
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord
from ds_sim.simulator import Outcome

if TYPE_CHECKING:
    from playwright.sync_api import Browser

CONFIG = CampaignConfig(siblings=[BULLET, EVIL], twin=SimulatorName("nowhere:Twin"), seed=77)


class Server:
    """A running server of one folder, asked as a browser would."""

    def __init__(self, folder: Path) -> None:
        self.address, self._ready = "", threading.Event()
        self._folder = folder
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert self._ready.wait(60)

    def _run(self) -> None:
        async def run() -> None:
            self._loop, self._task = asyncio.get_running_loop(), asyncio.current_task()
            await serve(self._folder, port=0, ready=self._started)

        with pytest.raises(asyncio.CancelledError):
            asyncio.run(run())

    def _started(self, address: str) -> None:
        self.address = address
        self._ready.set()

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes, dict[str, str]]:
        connection = HTTPConnection(urlsplit(self.address).netloc, timeout=60)
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())

    def connect(self) -> socket.socket:
        where = urlsplit(self.address)
        assert where.hostname is not None and where.port is not None
        return socket.create_connection((where.hostname, where.port), timeout=30)

    def state(self) -> Any:
        return json.loads(self.ask("/state.json")[1])

    def close(self) -> None:
        assert self._task is not None
        self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join(60)
        assert not self._thread.is_alive()


def served(folder: Path) -> closing[Server]:
    return closing(Server(folder))


def bytes_of(folder: Path) -> dict[str, bytes]:
    """Every file but SQLite's shared memory, which is no part of the campaign."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.endswith("-shm")}


def later_test(number: int) -> Test:
    return Test(f"bullet-0-{number:04d}", Scenario(road(number), seed=3), Origin(BULLET, 0, number))


def test_a_campaign_is_read_while_it_is_written_and_stays_as_it_is(tmp_path: Path) -> None:
    store = make_campaign(tmp_path, CONFIG, 2)
    assert (tmp_path / "campaign.sqlite-wal").stat().st_size > 0
    before = bytes_of(tmp_path)
    reader = CampaignReader(tmp_path)
    assert len(reader.read().data.executions) == 12
    assert bytes_of(tmp_path) == before
    # What is written meanwhile is seen, and gives the same as reading all of it at once.
    for number in (5, 6):
        store.add_test(later_test(number))
        store.add_execution(make_execution(later_test(number), "bullet", 2.4))
        snapshot = reader.read()
        assert snapshot.latest["bullet"] == f"bullet-0-{number:04d}"
        assert page_state(snapshot) | {"state": ""} == page_state(CampaignReader(tmp_path).read()) | {"state": ""}
    # A search that was stopped takes its last test back; the next one gets its row.
    store.add_test(later_test(7))
    assert len(reader.read().data.tests) == 7
    store.take_back(["bullet-0-0006", "bullet-0-0007"])
    store.add_test(later_test(8))
    assert {test.test_id for test in reader.read().data.tests} == {test.test_id for test in store.tests()}
    # The writer is not disturbed: it closes, which removes its log.
    store.close()
    assert not (tmp_path / "campaign.sqlite-wal").exists()
    before = bytes_of(tmp_path)
    assert len(reader.read().data.executions) == 14
    assert bytes_of(tmp_path) == before and {path.name for path in tmp_path.iterdir()} == set(before)


def test_a_killed_campaign_is_read_without_recovering_it(tmp_path: Path) -> None:
    (tmp_path / "running").mkdir()
    store = make_campaign(tmp_path / "running", CONFIG, 2)
    killed = tmp_path / "killed"
    shutil.copytree(tmp_path / "running", killed, ignore=shutil.ignore_patterns("*-shm"))
    store.close()
    before = bytes_of(killed)
    assert before["campaign.sqlite-wal"]
    snapshot = CampaignReader(killed).read()
    assert len(snapshot.data.executions) == 12 and snapshot.live is None
    assert page_state(snapshot)["state"] == "stopped"
    assert bytes_of(killed) == before


def test_a_campaign_that_ends_while_it_is_read_leaves_everything_in_its_file(tmp_path: Path) -> None:
    """SQLite alone would leave the log beside the file, as the one who reads may not write it back."""
    store = make_campaign(tmp_path, CONFIG, 2)
    reader = sqlite3.connect(f"file:{tmp_path}/campaign.sqlite?mode=ro", uri=True, check_same_thread=False)
    reader.execute("BEGIN")
    reader.execute("SELECT * FROM executions").fetchone()
    timer = threading.Timer(0.5, reader.close)
    timer.start()
    store.close()
    timer.join()
    shutil.copy(tmp_path / "campaign.sqlite", tmp_path / "alone.sqlite")
    with sqlite3.connect(tmp_path / "alone.sqlite") as db:
        assert db.execute("SELECT count(*) FROM executions").fetchone() == (12,)


def test_state_counts_what_the_store_holds(tmp_path: Path) -> None:
    store = make_campaign(tmp_path, CONFIG, 4)
    store.add_error("bullet-0-0001", EVIL, 0, Outcome.SIM_ERROR, "the wheels came off")
    state = page_state(CampaignReader(tmp_path).read())
    executions = store.executions()
    tests = {test.test_id: test for test in store.tests()}
    for shown, name in zip(state["simulators"], CONFIG.simulators, strict=True):
        own = [e for e in executions if e.simulator == name]
        assert (shown["name"], shown["tests"]) == (name, len(own))
        assert shown["failures"] == sum(e.max_lateral_position > 2.0 for e in own)
        cells = {(x, y): (n, failures) for x, y, n, failures in state["maps"][name]}
        for place in {(t.road.turns_count, int(100 * t.road.curvature)) for t in tests.values()}:
            there = [
                e for e in own if (r := tests[e.test_id].road) and (r.turns_count, int(100 * r.curvature)) == place
            ]
            assert cells[place] == (len(there), sum(e.max_lateral_position > 2.0 for e in there))
    assert (state["done"], state["errors"]) == (24, 1) and "the wheels came off" in state["last_error"]
    assert state["total"] == CONFIG.executions_at_most
    assert json.loads(json.dumps(state, allow_nan=False)) == state


def test_campaigns_that_have_not_begun_or_have_gates_are_shown(tmp_path: Path) -> None:
    for name in ("empty", "gated"):
        (tmp_path / name).mkdir()
    Store(tmp_path / "empty/campaign.sqlite", config=CONFIG.identity()).close()
    state = page_state(CampaignReader(tmp_path / "empty").read())
    assert (state["state"], state["done"], state["tests"]) == ("stopped", 0, 0)
    assert all(not cells for cells in state["maps"].values())

    features = ["turns_count", "curvature", "direction_coverage:10"]
    config = CampaignConfig(
        siblings=NOWHERE.siblings, twin=None, conditions=parse_conditions("visibility=60"), features=features
    )
    store = Store(tmp_path / "gated/campaign.sqlite", config=config.identity())
    for test, driven in make_tests(config, 3):
        store.add_test(set_conditions(test, Conditions(visibility=60.0)))
        store.add_execution(next(e for e in driven if e.simulator == test.sibling))
        other = next(name for name in config.siblings if name != test.sibling)
        store.add_gate(test.test_id, other, Gate(state=GateState.INFEASIBLE, message="stuck", outcome=Outcome.STUCK))
    state = page_state(CampaignReader(tmp_path / "gated").read())
    assert (state["done"], state["excluded"]) == (12, 6)
    # The third feature is summed up: a cell of the page counts every test with its turns and curvature.
    assert {sum(n for _, _, n, _ in cells) for cells in state["maps"].values()} == {3}
    assert len(state["axes"]) == 2


class SlowEngine:
    """Engine that says where its car is, and waits."""

    capacity = None

    def __init__(self) -> None:
        self.go = threading.Event()

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        assert watch is not None
        watch(40, 0.5, 0.25)
        assert self.go.wait(60)
        return request.ended(Outcome.COMPLETED, "")

    def stop(self) -> None: ...


def test_drives_under_way_are_in_the_live_file_and_on_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make_campaign(tmp_path, CONFIG, 1)
    test, slow = later_test(9), SlowEngine()
    store.add_test(test)
    with LiveFile(tmp_path, Listener()) as live:
        live.expect([{BULLET: 10}])
        live.stage("search")
        live.finished(store.tests()[0], BULLET, None, fresh=True)
        engine = GraphEngine([slow], [BULLET], SlowEngine)
        asked = DriveRequest(test.scenario, DriverName("dave2"), BULLET)

        def drive() -> None:
            with live.driving(asked) as watch:
                engine.drive(asked, watch)

        thread = threading.Thread(target=drive, daemon=True)
        thread.start()
        wait_until(lambda: any(one["car"] for one in page_state(CampaignReader(tmp_path).read())["now"]))
        found = read_live(tmp_path, time.time())
        assert found is not None and (found.stage, found.done, found.total) == ("search", 1, 10)
        assert found.seconds_left is not None
        state = page_state(CampaignReader(tmp_path).read())
        (now,) = state["now"]
        assert state["state"] == "running" and (now["test"], now["simulator"]) == (test.test_id, "bullet")
        # Half of the road, a quarter of a metre to the right of the lane's centre.
        x, y, yaw = now["car"]
        lane = test.road.lane_centre
        nearest = int(np.argmin(np.hypot(*(lane - (x, y)).T)))
        assert nearest / len(lane) == pytest.approx(0.5, abs=0.15)
        ahead = lane[nearest + 1] - lane[nearest]
        across = (x - lane[nearest][0]) * ahead[1] - (y - lane[nearest][1]) * ahead[0]
        assert across / np.hypot(*ahead) == pytest.approx(0.25, abs=0.05)  # positive to the right
        assert np.cos(yaw - np.arctan2(ahead[1], ahead[0])) > 0.95
        right = time.time
        for hour in (3600, -3600):  # somebody sets the clock during the drive
            monkeypatch.setattr(time, "time", lambda hour=hour: right() + hour)
            wait_until(lambda: read_live(tmp_path, time.time()) is not None)
            found = read_live(tmp_path, time.time())
            assert found is not None and found.seconds_left is not None and found.seconds_left < 600
            (now,) = page_state(CampaignReader(tmp_path).read())["now"]
            assert 0 < now["seconds"] < 100
        slow.go.set()
        thread.join(60)
        assert read_live(tmp_path, time.time() + FRESH + 5) is None  # a killed campaign's file counts for nothing
    assert read_live(tmp_path, time.time()) is None and not list(tmp_path.glob(".live*"))


DRIVE = {"simulator": "bullet", "road_id": "x", "seed": 1, "began": 0.0}


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        "[1]",
        '{"updated": "NaN"}',
        '{"updated": 1, "drives": [{}]}',
        '{"updated": 1, "done": 1e99}',
        json.dumps({"updated": 1, "drives": [DRIVE] * 300}),
        json.dumps({"updated": 1, "drives": [DRIVE] * 10_000}),
    ],
)
def test_a_live_file_of_other_content_is_ignored(tmp_path: Path, content: str) -> None:
    (tmp_path / ".live.json").write_text(content)
    assert read_live(tmp_path, 1.0) is None


def test_the_server_answers_only_reading_requests_of_this_machine(tmp_path: Path) -> None:
    store = make_campaign(tmp_path, CONFIG, 2)
    before = bytes_of(tmp_path)
    with served(tmp_path) as server:
        status, page, headers = server.ask("/")
        assert status == 200 and "default-src 'none'" in headers["Content-Security-Policy"]
        assert b"</script><script>alert" not in page and b"Under way" in page
        assert not any(b in page for b in (b"https://", b'src="', b"@import"))
        state = server.state()
        assert (state["done"], state["driver"]) == (12, "dave2")
        execution: Execution | None = store.execution("bullet-0-0001", "bullet")
        assert execution is not None
        drive = json.loads(server.ask("/drive.json?" + urlencode({"test": "bullet-0-0001", "simulator": "bullet"}))[1])
        run, *others = drive["runs"]
        assert others == [None, None] and run["x"][-1] == pytest.approx(execution.trajectory[-1, 0], abs=0.01)
        assert run["lateral"][3] == pytest.approx(execution.trajectory[6, 4], abs=0.01)
        assert len(drive["pictures"]["frames"]) == len(drive["pictures"]["times"]) > 5
        # Code that is named in the folder does not run.
        query = urlencode({"test": "bullet-0-0001", "simulator": EVIL})
        assert "not shipped" in json.loads(server.ask(f"/drive.json?{query}")[1])["pictures"]["note"]
        for path, method, host, expected in (
            ("/", "GET", "evil.example", 403),
            ("/state.json", "GET", "evil.example:80", 403),
            ("/", "POST", "", 405),
            ("/drive.json", "GET", "", 404),
            ("/drive.json?test=x&simulator=bullet", "GET", "", 404),
            ("/campaign.sqlite", "GET", "", 404),
            ("/../campaign.sqlite", "GET", "", 404),
            ("/state.json", "PUT", "", 405),
        ):
            assert server.ask(path, method, **({"Host": host} if host else {}))[0] == expected, (path, method)
        port = urlsplit(server.address).port
        assert port is not None
        with pytest.raises(ServerError, match=rf"port {port} is in use: choose another with --port, or 0"):
            asyncio.run(serve(tmp_path, port=port))
        # A store that is damaged while it is watched is a sentence on the page, with the last state.
        assert bytes_of(tmp_path) == before
        store.close()
        with sqlite3.connect(tmp_path / "campaign.sqlite") as db:
            db.execute("UPDATE tests SET road = '', rowid = rowid + 100")
        wait_until(lambda: "problem" in server.state())
        state = server.state()
        assert "is damaged" in state["problem"] and state["done"] == 12


def test_readers_that_do_not_read_keep_nobody_waiting(tmp_path: Path) -> None:
    make_campaign(tmp_path, CONFIG, 4).close()
    with served(tmp_path) as server:
        assert server.state()["done"] == 24
        paths = [f"/drive.json?test=bullet-0-{k:04d}&simulator=bullet" for k in range(4)]
        assert server.ask(paths[0])[0] == 200
        with ExitStack() as open_ones:
            for k in range(60):
                one = open_ones.enter_context(server.connect())
                one.sendall(f"GET {paths[k % 4]} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            assert server.ask(paths[1])[0] == 200  # whose limit is 60 s


def test_idle_readers_beyond_the_limit_are_sent_away_until_others_leave(tmp_path: Path) -> None:
    make_campaign(tmp_path, CONFIG, 1).close()
    with served(tmp_path) as server:
        with ExitStack() as open_ones:
            for _ in range(watch_server.MOST_CONNECTIONS):
                open_ones.enter_context(server.connect())
            assert open_ones.enter_context(server.connect()).recv(1) == b""
        wait_until(lambda: answers(server))


def answers(server: Server) -> bool:
    with suppress(OSError, HTTPException):
        return server.ask("/state.json")[0] == 200
    return False


def test_a_connection_that_asks_nothing_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch_server, "PATIENCE", 0.5)
    make_campaign(tmp_path, CONFIG, 1).close()
    with served(tmp_path) as server, server.connect() as silent:
        assert silent.recv(1) == b""


def test_a_folder_without_a_campaign_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no campaign in .*: run one there first"):
        asyncio.run(serve(tmp_path, port=0))


def test_the_page_shows_a_campaign_that_grows(browser: Browser, tmp_path: Path) -> None:
    store = make_campaign(tmp_path, CONFIG, 2)
    with (
        LiveFile(tmp_path, Listener()) as live,
        served(tmp_path) as server,
        closing(browser.new_page(viewport={"width": 1280, "height": 900})) as page,
    ):
        live.stage("search")
        page.set_default_timeout(60_000)
        complaints: list[str] = []
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(server.address)
        page.wait_for_selector("body[data-ready]")
        page.wait_for_function("() => document.getElementById('headline').textContent === 'Running: search'")
        assert page.locator("#grids figure").count() == 3
        # The latest drive on the shipped simulator has pictures that change; the others say why they have none.
        page.wait_for_selector("#cards img")
        first = page.locator("#cards img").get_attribute("src")
        page.wait_for_function("src => document.querySelector('#cards img').src !== src", arg=first)
        page.wait_for_function("() => document.querySelectorAll('#cards .nopicture').length === 2")
        page.click("#pause")
        assert page.locator("#pause").get_attribute("aria-pressed") == "true"
        filled = page.locator("#grids figure").first.locator(".filled").count()
        number = next(k for k in range(2, 40) if road(k).turns_count not in {r.road.turns_count for r in store.tests()})
        store.add_test(later_test(number))
        store.add_execution(make_execution(later_test(number), "bullet", 2.4))
        page.wait_for_function(
            "n => document.querySelectorAll('#grids figure')[0].querySelectorAll('.filled').length === n",
            arg=filled + 1,
        )
        assert "13 of at most" in page.locator("#facts").inner_text()
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
        page.set_viewport_size({"width": 390, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
        assert complaints == []
        browser.close()
