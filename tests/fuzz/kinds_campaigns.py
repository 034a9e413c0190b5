# SPDX-License-Identifier: Apache-2.0
"""Kinds of received files: configurations, stores, suites, roads, networks, data sets and parameter files."""

from __future__ import annotations

import json
import sqlite3
import zlib
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from made_networks import write_graph, write_network, write_recorded
from onnx import helper, numpy_helper
from report_campaigns import make_tests, set_conditions
from tests.campaign.damaged_stores import lax_tables
from tests.fuzz.damage import (
    STRANGE,
    Rng,
    damaged_bytes,
    damaged_file,
    damaged_json,
    damaged_table,
    replace_with_no_file,
)
from tests.fuzz.harness import Kind
from tests.fuzz.kinds_tables import as_text

from ds_analysis.paper.campaign_contents import excluded_table, exclusion_lines, maps_of
from ds_base.folder_files import StoreError
from ds_driver.data.dataset import DatasetError, read_samples
from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.driver_name import AUTOPILOT
from ds_driver.networks.pilot import DriverError
from ds_driver.networks.weights import WeightsError, load_weights
from ds_orchestrator.campaign.config import ConfigError, parse_config, read_config
from ds_orchestrator.campaign.folder import read_campaign
from ds_orchestrator.campaign.status import stages_of
from ds_orchestrator.store.store import Store
from ds_road import RoadError, generate
from ds_road.files import read_roads
from ds_sim import BULLET
from ds_sim.gates.gate import Gate, GateState
from ds_sim.simulator import Outcome
from ds_studies.suite_file import Suite, read_suite, road_sha256, settings_of_suite, write_suite
from ds_twin_donkey.car_files import ParameterFileError, read_parameters

_CONFIG = """\
siblings: [bullet, softbody]
twin: donkey
driver: autopilot
search: {method: deephyperion, population: 2, iterations: 1, runs: 1, min_angle: 40, max_angle: 90, extent: 6}
operators: {probability: product, quality_loss: minimum, compare: [mean]}
features: [turns_count, "minimum_radius:20"]
seed: 7
command_timeout: 10.0
record: none
conditions: visibility=80,friction=0.8
gates: conditions
"""
_ROADS = [
    [[125.0, 0.0], [125.0, 25.0], [125.0, 50.0], [135.0, 75.0], [120.0, 95.0]],
    {"road_points": [[0, 0], [10, 0], [20, 1], [30, 3]], "lane_width": 3.5},
    {"control_points": [[0, 0], [10, 0], [20, 1], [30, 3], [40, 9]], "maxitwo_compatible": True},
]
_CAR = """\
format: ds_twin_donkey parameters 1
parameters:
  friction: {value: 0.8, unit: '1', status: fitted, interval_95: [0.7, 0.9], start: 0.85}
  steering_pulse_steps: {value: 85, status: held}
logs: [{name: drive, kind: tub, sha256: '00', seconds: 10.0}]
"""
_DESCRIPTION = """\
file: network.onnx
input: {size: [16, 32], colour: grey, layout: nchw, crop: {top: 60, bottom: 0}, subtract: 127.5, divide: 127.5}
outputs: {steering: {output: steering, index: 0, scale: -1.0, offset: 0.0}, throttle: {output: 0, index: 0}}
"""


def _write_store(folder: Path, n: int) -> Path:
    """Write a small campaign with conditions, gates, errors, drives, notes and results."""
    raw = yaml.safe_load(_CONFIG.replace("population: 2", f"population: {max(n, 2)}"))
    config = parse_config(raw, "config.yaml")
    store = Store(folder / "campaign.sqlite", config=config.identity())
    store.note("version numpy", "2")
    store.add_seconds("search", 12.5)
    for test, executions in make_tests(config, n):
        store.add_test(set_conditions(test, config.conditions))
        for execution in executions[1:]:
            store.add_execution(execution)
            store.add_gate(test.test_id, execution.simulator, Gate(state=GateState.VALID, outcome=Outcome.COMPLETED))
        if executions:
            failed = Gate(state=GateState.INFEASIBLE, outcome=Outcome.OUT_OF_BOUNDS, visible_contrast=0.7)
            store.add_gate(test.test_id, executions[0].simulator, replace(failed, message="too far"))
    store.add_search(BULLET, 0, "deephyperion", n)
    store.set_result("maps", n)
    store.close()
    return folder / "campaign.sqlite"


def _damage_store(path: Path, rng: Rng) -> None:
    """Damage a store: mostly another value in one cell, else another table, or its bytes."""
    chance = rng.random()
    if chance < 0.02:
        replace_with_no_file(path, rng)
    elif chance < 0.2:
        path.write_bytes(damaged_bytes(path.read_bytes(), rng))
    else:
        tables = ["about", "tests", "executions", "errors", "given_up", "searches", "results", "gates", "conditions"]
        with lax_tables(path), closing(sqlite3.connect(path, isolation_level=None)) as db:
            db.execute("PRAGMA ignore_check_constraints=ON")
            with suppress(sqlite3.IntegrityError, sqlite3.OperationalError, OverflowError):  # SQLite refuses the value
                for _ in range(int(rng.integers(1, 4))):
                    _change_store(db, tables[int(rng.integers(len(tables)))], rng)


def _change_store(db: sqlite3.Connection, table: str, rng: Rng) -> None:
    columns = [row[1] for row in db.execute(f"PRAGMA table_info({table})")]
    rows = db.execute(f"SELECT rowid, * FROM {table}").fetchall()
    if rng.random() < 0.05:
        statements = [
            f"DROP TABLE {table}",
            f"DELETE FROM {table}",
            f"ALTER TABLE {table} RENAME TO other",
            f"CREATE TRIGGER t AFTER INSERT ON {table} BEGIN DELETE FROM tests; END",
            f"INSERT INTO {table} SELECT * FROM {table}",
            "CREATE VIEW v AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x FROM n",
        ]
        db.execute(statements[int(rng.integers(len(statements)))])
    elif not rows:
        values = [_cell("", rng) for _ in columns]
        db.execute(f"INSERT INTO {table} VALUES ({','.join('?' * len(columns))})", values)
    else:
        row = rows[int(rng.integers(len(rows)))]
        at = int(rng.integers(len(columns)))
        db.execute(f"UPDATE {table} SET {columns[at]} = ? WHERE rowid = ?", (_cell(row[at + 1], rng), row[0]))


def _cell(value: Any, rng: Rng) -> Any:
    """Return another value for a cell: of another type, a damaged blob, or a decompression bomb."""
    chance = rng.random()
    if isinstance(value, str) and value[:1] in ("{", "[") and chance < 0.7:
        return damaged_json(value, rng)[:1_000_000].decode("utf-8", "replace")
    if isinstance(value, bytes) and chance < 0.3:
        return damaged_bytes(value, rng)
    if isinstance(value, bytes) and chance < 0.5:
        numbers = np.frombuffer(zlib.decompress(value)).copy()
        numbers[int(rng.integers(len(numbers)))] = [np.nan, np.inf, 1e300, 0.0][int(rng.integers(4))]
        return zlib.compress(numbers.tobytes())
    if isinstance(value, bytes) and chance < 0.6:
        return _bomb()
    found = STRANGE[int(rng.integers(len(STRANGE)))]
    return found if isinstance(found, str | float | int | None) and not isinstance(found, bool) else json.dumps(found)


@cache
def _bomb() -> bytes:
    """Compress a gigabyte of zeros to a megabyte; no block refers to the previous one, so that they can be repeated."""
    packer = zlib.compressobj(9)
    first, again = (packer.compress(bytes(2**24)) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    return first + again * 63


def _read_store(path: Path) -> object:
    """Read a store as `ds campaign status`, `ds maps` and `ds report` do."""
    store = Store(path)
    try:
        data = read_campaign(store)
        return stages_of(data), maps_of(data), exclusion_lines(data), excluded_table(data).csv()
    finally:
        store.close()


def _write_weights(folder: Path, n: int) -> Path:
    return write_network(folder / "weights.safetensors", "chauffeur")


def _damage_weights(path: Path, rng: Rng) -> None:
    """Damage a weights file: mostly its header, a JSON document."""
    if rng.random() < 0.4:
        damaged_file(path, rng)
        return
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = damaged_json(content[8 : 8 + length].decode(), rng)
    path.write_bytes(len(header).to_bytes(8, "little") + header + content[8 + length :])


def _write_network(folder: Path, n: int) -> Path:
    weight = numpy_helper.from_array(np.linspace(-1e-3, 1e-3, 512, dtype=np.float32).reshape(512, 1), "weight")
    nodes = [
        helper.make_node("Flatten", ["image"], ["flat"]),
        helper.make_node("MatMul", ["flat", "weight"], ["0"]),
        *(helper.make_node("Relu", [f"{k}"], [f"{k + 1}" if k < n - 1 else "steering"]) for k in range(n)),
    ]
    (folder / "network").mkdir()
    write_graph(folder / "network/network.onnx", nodes, {"image": [1, 1, 16, 32]}, {"steering": [1, 1]}, [weight])
    as_text(lambda n: _DESCRIPTION, "network.yaml")(folder / "network", n)
    return folder / "network"


def _damage_of(name: str) -> Callable[[Path, Rng], None]:
    return lambda folder, rng: damaged_file(folder / name, rng)


def _read_network(folder: Path) -> object:
    return DescribedNetworkPilot(folder / "network.yaml")


def _write_data(folder: Path, n: int) -> Path:
    image = np.zeros((160, 320, 3), np.uint8)
    write_recorded(folder / "data", "donkey", [image] * n, [0.1 * (k % 9) for k in range(n)])
    return folder / "data"


def _car(n: int) -> str:
    return _CAR.replace("10.0}", "10.0}" + ", {name: drive, kind: tub, sha256: '00', seconds: 10.0}" * (n - 1))


def suite_of(count: int, *, driver: str = "dave2", twin: str = "donkey") -> dict[str, Any]:
    """A suite of so many tests, as its file has it."""
    outcome = {"outcome": "COMPLETED", "fitness": 0.5, "trajectory_sha256": "0" * 64}
    tests = []
    for number in range(count):
        points = [list(map(float, point)) for point in generate(np.random.default_rng(number)).control_points]
        tests.append(
            {
                "name": f"bullet-0-{number:04d}",
                "why": ["failing", "cell"],
                "control_points": points,
                "road_sha256": road_sha256(points),
                "seed": number,
                "conditions": "visibility=80" if number else "",
                "cell": [3, 17],
                "outcomes": {"bullet": outcome, twin: outcome},
            }
        )
    format_ = {"format": "digital-siblings-suite", "version": 1}
    return {**format_, "campaign": "mine", "driver": driver, "siblings": ["bullet"], "twin": twin, "tests": tests}


def _write_suite(folder: Path, n: int) -> Path:
    write_suite(Suite.model_validate(suite_of(n)), folder / "suite.json")
    return folder / "suite.json"


def _read_suite(path: Path) -> object:
    """Read a suite as `ds suite run` does before it drives."""
    suite = read_suite(path)
    return settings_of_suite(suite, AUTOPILOT), [suite.scenario_of(test).road.points for test in suite.tests]


KINDS = [
    Kind("campaign-yaml", as_text(lambda n: _CONFIG, "campaign.yaml"), damaged_file, read_config, (ConfigError,)),
    Kind("campaign-sqlite", _write_store, _damage_store, _read_store, (StoreError, ConfigError), 10, small=3),
    Kind(
        "roads",
        as_text(lambda n: json.dumps(_ROADS * n), "roads.json"),
        damaged_file,
        read_roads,
        (RoadError, OSError),
        10,
        small=1,
    ),
    Kind("weights", _write_weights, _damage_weights, lambda path: load_weights(str(path)), (WeightsError,)),
    Kind("network-description", _write_network, _damage_of("network.yaml"), _read_network, (DriverError,), small=1),
    Kind("network-onnx", _write_network, _damage_of("network.onnx"), _read_network, (DriverError,), 200, small=1),
    Kind("data-set", _write_data, damaged_table, read_samples, (DatasetError,), 200, small=4),
    Kind(
        "twin-parameters", as_text(_car, "car.yaml"), damaged_file, read_parameters, (ParameterFileError,), 100, small=1
    ),
    Kind("suite", _write_suite, damaged_file, _read_suite, (ConfigError,), 20, small=2),
]
