# SPDX-License-Identifier: Apache-2.0
"""Kinds of received files: outcomes of tests and what is made of them, roads of other tools, and files of a car."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tests.fuzz.damage import STRANGE, Rng, damaged_bytes, damaged_file, damaged_one_of, damaged_parquet, damaged_table
from tests.fuzz.harness import Kind

from ds_analysis.common.outcome_table import SIBLINGS, OutcomeTableError, table_of_comparison
from ds_analysis.outcomes.column_names import guess_columns
from ds_analysis.outcomes.columns import Columns, read_columns
from ds_analysis.outcomes.sbft import read_competition
from ds_analysis.outcomes.study import import_outcomes, read_study, write_study
from ds_analysis.real.proposal import PROPOSAL, read_proposed
from ds_analysis.real.records import FOLDER, RecordError, read_csv
from ds_analysis.sensitivity import RESULT, read_ranges
from ds_base.folder_files import StoreError
from ds_base.table import Table, TableError, keep_tables, read_tables, styled
from ds_orchestrator.engines.cluster import ClusterError, read_cluster
from ds_road import Road, RoadError, read_roads
from ds_road.files import write_roads
from ds_road.importing import import_roads
from ds_road.opendrive import write_all
from ds_sim.conditions.model import ConditionsError
from ds_twin_donkey.car_files import ParameterFileError, read_start
from ds_twin_donkey.logs import LogError, read_log

_COLUMNS = """\
test: [road, seed]
simulators: {a: {failed: oob_a}, b: {margin: {column: xte, limit: {b: 2.5}}}}
where: [{column: road, is_not: ""}]
map: {turns: 2.0, length: 10}
twin: b
"""
_CLUSTER = "scheduler: tcp://127.0.0.1:8786\nlisten: 127.0.0.1\nunencrypted: true\n"


def outcomes(n: int) -> str:
    """CSV of the outcomes of n tests on two simulators."""
    rows = [f"{k},{s},{(k + (s == 'b')) % 3 == 0},{k % 5 / 7},{k % 41},{k * k % 97}" for k in range(n) for s in "ab"]
    return "\n".join(["test_id,simulator,failed,xte,turns,length", *rows]) + "\n"


def _myconfig(n: int) -> str:
    return "WHEEL_BASE = 0.17\nMAX_STEERING_ANGLE = math.radians(25)\n" + "PWM = {'STEERING_LEFT_PWM': 460}\n" * n


def _study(folder: Path, n: int) -> Path:
    path = as_text(outcomes, "outcomes.csv")(folder, n)
    write_study(folder / "study", import_outcomes([path], Columns()))
    return folder / "study"


def _parquet(folder: Path, n: int) -> Path:
    return _study(folder, n).rename(folder / "made") / "outcomes.parquet"


def _packed(folder: Path, n: int) -> Path:
    (folder / "outcomes.csv.gz").write_bytes(gzip.compress(outcomes(n).encode()))
    return folder / "outcomes.csv.gz"


def _sbft(folder: Path, n: int) -> Path:
    (folder / "sbft").mkdir()
    for k in range(n):
        points = [[float(x), float(x * x % (7 + k))] for x in range(0, 60, 4)]
        text = json.dumps({"test_outcome": ("PASS", "FAIL")[k % 2], "is_valid": True, "road_points": points})
        (folder / "sbft" / f"{k}.json").write_text(text)
    return folder / "sbft"


def _road(n: int, height: float = 1.0) -> Road:
    return Road.from_road_points([(100.0 + x, 100.0 + height * np.sin(x / 20)) for x in np.linspace(0, 60, n)])


def _opendrive(folder: Path, n: int) -> Path:
    return write_all([_road(n)], ["road"], folder)[0]


def _commonroad(n: int) -> str:
    road = _road(n)
    bounds = zip(("left", "right"), (road.points, road.right_edge), strict=True)
    text = "".join(
        f"<{side}Bound>{''.join(f'<point><x>{x}</x><y>{y}</y></point>' for x, y in line.tolist())}</{side}Bound>"
        for side, line in bounds
    )
    at = "<point><x>{}</x><y>{}</y></point>".format(*road.lane_centre[1])
    start = f"<planningProblem><initialState><position>{at}</position></initialState></planningProblem>"
    return f'<commonRoad commonRoadVersion="2020a"><lanelet id="1">{text}</lanelet>{start}</commonRoad>'


def _track(n: int) -> str:
    return "# x_m,y_m\n" + "".join(f"{100 + k / n * 60},{100 + np.sin(k / n * 3)}\n" for k in range(n))


def _urdf(n: int) -> str:
    names = [f"link{k}" for k in range(n)] + ["front_left_wheel", "back_left_wheel"]
    links = "".join(f'<link name="{name}"/>' for name in names)
    joints = "".join(
        f'<joint name="j{k}" type="fixed"><parent link="{names[min(k, n - 1)]}"/><child link="{child}"/>'
        f'<origin xyz="{0.3 * (k == n - 1)} 0.1 0" rpy="0 0 0"/></joint>'
        for k, child in enumerate(names[1:])
    )
    return f'<robot name="car">{links}{joints}</robot>'


def _log(n: int) -> str:
    rows = [f"{0.05 * k:.2f},{0.1 * np.sin(k / 9):.3f},0.3,{0.1 * k:.2f},0,0,2,0\n" for k in range(n)]
    return "time_s,steering,throttle,x_m,y_m,yaw_rad,speed_mps,yaw_rate_radps\n" + "".join(rows)


def _drives(n: int) -> str:
    rows = [f"t{k},{('completed', 'failed')[k % 2]},me,2026-01-02,{(k % 2) * 0.2:.1f}\n" for k in range(n)]
    return "test_id,outcome,who,when,max_lateral_position\n" + "".join(rows)


def _proposed(folder: Path, n: int) -> Path:
    (folder / FOLDER).mkdir()
    names = [f"t{k}" for k in range(n)]
    rounds = [[{"test_id": name}] for name in names]
    (folder / FOLDER / PROPOSAL).write_text(json.dumps({"scale": 16.0, "population": names, "rounds": rounds}))
    return folder


def _tables(folder: Path, n: int) -> Path:
    rows = [(f"t{k}", k, (0.1, 0.5), None) for k in range(n)]
    columns = [*styled("text", "name"), *styled("number", "a", "b", "c")]
    keep_tables([Table(name="one", title="One", columns=columns, rows=rows)], folder / "tables.json")
    return folder / "tables.json"


def _comparison(folder: Path, n: int) -> Path:
    write_roads([_road(20, 1 + k / n) for k in range(n)], folder / "roads.json")
    found = [
        {"road_id": road.road_id, "failed": {"a": True, "b": False}, "max_lateral_position": {"a": 2.1, "b": 0.3}}
        for road in read_roads(folder / "roads.json")
    ]
    (folder / SIBLINGS).write_text(json.dumps({"simulators": {"a": {}, "b": {}}, "outcomes": found}))
    return folder


def _ranges(folder: Path, n: int) -> Path:
    numbers = {"end": 5.0, "share_of_range": 0.4, "start": 1e3, "first_fails": 40.0}
    row = {"condition": "visibility", "verdict": "fails", **numbers}
    (folder / RESULT).write_text(json.dumps({"thresholds": [row] * n, "seed": 1}))
    return folder


def as_text(text: Callable[[int], str], name: str) -> Callable[[Path, int], Path]:
    """Write a text of so many units."""

    def write(folder: Path, n: int) -> Path:
        (folder / name).write_text(text(n))
        return folder / name

    return write


def _damage_cells(path: Path, rng: Rng) -> None:
    """Damage a file of lines of values: mostly one to three values."""
    if rng.random() < 0.3:
        damaged_file(path, rng)
        return
    rows = [line.split(",") for line in path.read_text().split("\n")]
    for _ in range(int(rng.integers(1, 4))):
        row = rows[int(rng.integers(len(rows)))]
        row[int(rng.integers(len(row)))] = str(STRANGE[int(rng.integers(len(STRANGE)))])
    path.write_bytes("\n".join(map(",".join, rows)).encode("utf-8", "surrogatepass"))


def _damage_packed(path: Path, rng: Rng) -> None:
    inside = gzip.decompress(path.read_bytes())
    packed = gzip.compress(damaged_bytes(inside, rng))
    path.write_bytes(packed if rng.random() < 0.5 else damaged_bytes(packed, rng))


def dictionary_bomb(path: Path) -> None:
    """Write a Parquet file of some 100 kB whose only text of a megabyte is that of 20,000 rows."""
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(20_000, np.int32)), pa.array(["x" * 2**20]))
    pq.write_table(pa.table({"test_id": texts}), path, compression="zstd", dictionary_pagesize_limit=2**31 - 1)


def gzip_bomb(line: bytes) -> Callable[[Path], None]:
    """Write a compressed table of a gigabyte of the same line."""

    def write(path: Path) -> None:
        packer = zlib.compressobj(9, wbits=31)
        block = packer.compress(line * (2**24 // len(line))) + packer.flush(zlib.Z_FULL_FLUSH)
        plain = zlib.compressobj(9, wbits=-15)
        again = plain.compress(line * (2**24 // len(line))) + plain.flush(zlib.Z_FULL_FLUSH)
        path.write_bytes(block + again * 64)

    return write


def _many_columns(path: Path) -> None:
    path.write_bytes(b"a," * 300_000 + b"\n" + b"1," * 300_000)


BOMBS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "outcomes-parquet": ("dictionary", dictionary_bomb),
    "study": ("dictionary", lambda folder: dictionary_bomb(folder / "outcomes.parquet")),
    "outcomes-gz": ("lines", gzip_bomb(b"1,2,3,4,5,6\n")),
    "outcomes-csv": ("columns", _many_columns),
}
"""Kind -> what is many in a small file, and how it is written."""


def _import(path: Path) -> object:
    guess = guess_columns(path)
    columns = Columns() if guess is None else Columns.model_validate(guess.columns)
    return import_outcomes([path], columns).table()


def _read_drives(path: Path) -> object:
    return read_csv(path, {f"t{k}": 2.0 for k in range(10_000)}, scale=16.0)


_OUTCOMES = (OutcomeTableError,)
_START = (ParameterFileError,)


KINDS = [
    Kind("outcomes-csv", as_text(outcomes, "t.csv"), _damage_cells, _import, _OUTCOMES, 2000),
    Kind("outcomes-gz", _packed, _damage_packed, _import, _OUTCOMES, 2000),
    Kind("outcomes-parquet", _parquet, damaged_parquet, _import, _OUTCOMES, 2000),
    Kind("study", _study, damaged_table, lambda path: read_study(path).table(), _OUTCOMES, 1000),
    Kind("sbft-folder", _sbft, damaged_one_of, lambda path: read_competition([path]), _OUTCOMES, 100),
    Kind("track", as_text(_track, "track.csv"), _damage_cells, import_roads, (RoadError,), 10_000),
    Kind("opendrive", _opendrive, damaged_file, import_roads, (RoadError,), 90),
    Kind("commonroad", as_text(_commonroad, "road.xml"), damaged_file, import_roads, (RoadError,), 90),
    Kind("car-urdf", as_text(_urdf, "car.urdf"), damaged_file, read_start, _START, 400),
    Kind("log-table", as_text(_log, "log.csv"), _damage_cells, read_log, (LogError,), 3000),
    Kind("real-drives", as_text(_drives, "drives.csv"), _damage_cells, _read_drives, (RecordError,), 900),
    Kind("columns", as_text(lambda n: _COLUMNS, "columns.yaml"), damaged_file, read_columns, _OUTCOMES),
    Kind("car-myconfig", as_text(_myconfig, "myconfig.py"), damaged_file, read_start, _START, 400, small=1),
    Kind("cluster", as_text(lambda n: _CLUSTER, "cluster.yaml"), damaged_file, read_cluster, (ClusterError,)),
    Kind("proposed", _proposed, damaged_one_of, read_proposed, (RecordError, ValueError), 900, small=2),
    Kind("tables", _tables, damaged_file, read_tables, (TableError,), 1000, small=4),
    Kind("comparison", _comparison, damaged_one_of, table_of_comparison, (*_OUTCOMES, StoreError), 20, small=2),
    Kind("ranges", _ranges, damaged_one_of, read_ranges, (ConditionsError,), 2000, small=2),
]
