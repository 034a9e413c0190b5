# SPDX-License-Identifier: Apache-2.0
"""Evaluation of a campaign: its tables (paper 4.4), next to the numbers of the paper (4.2.2, 4.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import TypeAdapter

from ds_analysis.common.statistics import RESAMPLES, Array, caution_of
from ds_analysis.paper.correlation import (
    Correlation,
    PairedDifference,
    RobustnessCheck,
    check_robustness,
    evaluate,
    paired_differences,
)
from ds_analysis.paper.steering_error_stats import BINS, MERGED, RANGE, ErrorComparison, ErrorRobustnessCheck, densities
from ds_base.bounded_file import load_json
from ds_base.folder_files import StoreError, read_file
from ds_base.installation import ds_command
from ds_base.table import Column, Table, Value, styled
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.maps.feature_map import FeatureMap, MapId, map_ids
from ds_sim.registry import SimulatorName

Kind = Literal["sim", "real"]


class PaperRow(NamedTuple):
    """Row of the tables of RQ2 and RQ3: Pearson's r, its p-value, mostly as a power of ten, and AUC-PRC."""

    r: float
    p: float
    auc: float


def _rows(*rows: tuple[float, float, float]) -> dict[str, PaperRow]:
    return {who: PaperRow(*row) for who, row in zip(("DS1", "DS2", "DSS"), rows, strict=True)}


def _errors(*rows: tuple[float, float]) -> dict[str, tuple[float, float]]:
    return dict(zip(("DS1", "DS2", "DSS"), rows, strict=True))


RQ1: dict[tuple[str, Kind], dict[str, tuple[float, float]]] = {
    ("dave2", "sim"): _errors((0.04669, 0.101), (0.02648, 0.020), (0.03776, 0.053)),
    ("dave2", "real"): _errors((0.03250, 0.011), (0.02187, 0.078), (0.00951, 0.088)),
    ("chauffeur", "sim"): _errors((0.03989, 0.023), (0.02641, 0.047), (0.01208, 0.394)),
    ("chauffeur", "real"): _errors((0.04625, 0.011), (0.02145, 0.078), (0.01843, 0.334)),
    ("epoch", "sim"): _errors((0.06030, 0.011), (0.01634, 0.078), (0.02726, 0.053)),
    ("epoch", "real"): _errors((0.03374, 0.016), (0.02318, 0.078), (0.00989, 0.256)),
}
"""Of a network and a role: Wasserstein distance of the error densities, and p-value of the Wilcoxon test."""
RQ2: dict[tuple[str, Kind], dict[str, PaperRow]] = {
    ("dave2", "sim"): _rows((0.650, 1e-11, 0.654), (0.583, 1e-8, 0.512), (0.710, 1e-13, 0.684)),
    ("dave2", "real"): _rows((0.391, 1e-4, 0.403), (0.377, 1e-4, 0.306), (0.457, 1e-5, 0.398)),
    ("chauffeur", "sim"): _rows((0.733, 1e-16, 0.774), (0.588, 1e-10, 0.715), (0.700, 1e-14, 0.742)),
    ("chauffeur", "real"): _rows((0.417, 1e-4, 0.481), (0.337, 1e-3, 0.300), (0.422, 1e-4, 0.496)),
    ("epoch", "sim"): _rows((0.561, 1e-8, 0.599), (0.428, 1e-5, 0.604), (0.571, 1e-8, 0.622)),
    ("epoch", "real"): _rows((0.469, 1e-5, 0.586), (0.521, 1e-7, 0.565), (0.450, 1e-5, 0.641)),
}
RQ3: dict[tuple[str, Kind], dict[str, PaperRow]] = {
    ("dave2", "sim"): _rows((0.621, 1e-10, 0.659), (0.429, 1e-5, 0.496), (0.553, 1e-8, 0.659)),
    ("dave2", "real"): _rows((0.396, 1e-4, 0.513), (0.287, 1e-3, 0.351), (0.379, 1e-4, 0.626)),
    ("chauffeur", "sim"): _rows((0.798, 1e-21, 0.940), (0.625, 1e-11, 0.791), (0.792, 1e-21, 0.940)),
    ("chauffeur", "real"): _rows((0.399, 1e-4, 0.460), (0.260, 0.025, 0.359), (0.382, 1e-4, 0.460)),
    ("epoch", "sim"): _rows((0.511, 1e-7, 0.592), (0.355, 1e-4, 0.541), (0.491, 1e-6, 0.594)),
    ("epoch", "real"): _rows((0.554, 1e-8, 0.608), (0.389, 1e-3, 0.715), (0.529, 1e-7, 0.651)),
}
MEAN_SQUARED: dict[tuple[str, Kind], float] = {
    ("dave2", "sim"): 0.08,
    ("dave2", "real"): 0.07,
    ("chauffeur", "sim"): 0.07,
    ("chauffeur", "real"): 0.07,
    ("epoch", "sim"): 0.09,
    ("epoch", "real"): 0.07,
}
"""Mean squared steering error on the twin (4.2.2)."""


Network = tuple[str, Kind]
"""Architecture and kind of images, as the paper's tables are divided."""
_TITLES = {
    "probability": ("rq2", "RQ2: failure probability against the twin's"),
    "quality_loss": ("rq3", "RQ3: quality loss against the twin's failure probability"),
}
_BOOTSTRAP = "Intervals: 95%, bootstrap over cells. AUC-PRC is the average precision."
NETWORKS = ("dave2", "chauffeur", "epoch")
"""Architectures that the paper tests."""


def paper_row(value: str, network: Network | None, role: str) -> PaperRow | None:
    """The paper's numbers of a role's map, for `probability` RQ2 and else RQ3; None for a network it does not test."""
    return None if network is None else (RQ2 if value == "probability" else RQ3).get(network, {}).get(role)


def role_of(simulator: str, siblings: Sequence[str]) -> str:
    """Name a simulator's role in the paper's tables: `DS1`, `DS2`, ... for siblings, `DSS` for their merge."""
    return f"DS{siblings.index(simulator) + 1}" if simulator in siblings else "DSS"


def cautions(correlations: Sequence[Correlation]) -> list[str]:
    """Collect the reasons why the numbers allow no conclusion, each once; empty if they allow one."""
    return list(dict.fromkeys(c.caution for c in correlations if c.caution))


def _caution_notes(reasons: Sequence[str]) -> list[str]:
    return [f"No conclusion: {reason} (Peduzzi et al. 1996). Intervals are left out." for reason in reasons]


def correlation_tables(
    correlations: Sequence[Correlation], siblings: Sequence[SimulatorName], twin: SimulatorName, network: Network | None
) -> list[Table]:
    """Tabulate RQ2 and RQ3 (paper 4.4.2, 4.4.3), beside the paper's numbers of a network."""
    tables = []
    for value, (name, title) in _TITLES.items():
        rows: list[list[Value]] = []
        compared = [c for c in correlations if c.value == value]
        notes = [*_caution_notes(cautions(compared)), _BOOTSTRAP]
        for c in compared:
            role, named = role_of(c.map.simulator, siblings), c.map.simulator or "merged"
            paper = paper_row(value, network, role)
            rows.append([role, named, c.cells, c.r, c.r_interval, c.p, c.auc, c.auc_interval])
            rows[-1] += paper or [None] * 3
            notes += [f"{role}: no r, {c.reason}."] * bool(c.reason)
            notes += [f"{role}: no AUC-PRC, {c.auc_reason}."] * bool(c.auc_reason)
        shares = {c.baseline for c in compared if c.baseline is not None}
        notes += [
            f"DT is {twin}, which fails in {share:.0%} of the cells: the AUC-PRC of a map without information."
            for share in sorted(shares)
        ]
        columns = [
            *styled("text", "vs DT", "simulator"),
            Column("cells", "count"),
            *styled("number", "r", "r, 95 %"),
            Column("p", "p"),
            *styled("number", "AUC-PRC", "AUC-PRC, 95 %", "paper: r"),
            Column("paper: p", "p"),
            Column("paper: AUC-PRC", "number"),
        ]
        tables.append(_without_paper(Table(name=name, title=title, columns=columns, rows=rows, notes=notes), 3))
    return tables


def paired_difference_table(paired_differences: Sequence[PairedDifference], siblings: Sequence[SimulatorName]) -> Table:
    """Tabulate the differences between the merged map and each sibling's: the paper's claim, with an interval."""
    columns = [
        *styled("text", "question", "DSS minus"),
        Column("cells", "count"),
        *styled("number", "r", "r, 95 %", "AUC-PRC", "AUC-PRC, 95 %"),
    ]
    rows: list[list[Value]] = []
    for g in paired_differences:
        sibling = f"{role_of(g.over.simulator, siblings)} {g.over.simulator}"
        rows.append([_TITLES[g.value][0].upper(), sibling, g.cells, g.r, g.r_interval, g.auc, g.auc_interval])
    reasons = dict.fromkeys(caution_of(g.cells, g.failing) for g in paired_differences if g.failing is not None)
    notes = [
        *_caution_notes([reason for reason in reasons if reason]),
        "Above 0: the merged map predicts the twin better. Both maps see the same cells in every resample.",
    ]
    return Table(
        name="paired_differences", title="RQ2 and RQ3: what merging adds", columns=columns, rows=rows, notes=notes
    )


def robustness_table(robustness_checks: Sequence[RobustnessCheck], reasons: Sequence[str] = ()) -> Table:
    """Tabulate RQ2 and RQ3 computed in other ways, and the reasons why the numbers allow no conclusion."""
    columns = [
        *styled("text", "how", "map", "against", "value"),
        Column("cells", "count"),
        Column("r", "number"),
        Column("p", "p"),
        Column("AUC", "number"),
    ]
    rows: list[list[Value]] = [
        [v.what, v.map.name, v.against.name, v.value.replace("_", " "), v.cells, v.r, v.p, v.auc]
        for v in robustness_checks
    ]
    return Table(
        name="robustness_checks",
        title="RQ2 and RQ3 in other ways",
        columns=columns,
        rows=rows,
        notes=_caution_notes(reasons),
    )


def error_tables(
    comparisons: Sequence[ErrorComparison],
    robustness_checks: Sequence[ErrorRobustnessCheck],
    errors: Mapping[str, Array],
    siblings: Sequence[str],
    twin: str,
    network: Network | None,
) -> list[Table]:
    """Tabulate RQ1 (paper 4.4.1) beside the paper's numbers of a network: comparison, robustness checks, densities.

    `errors` are absolute steering errors of every simulator.
    """
    of_paper = RQ1.get(network or ("", "sim"), {})
    rows: list[list[Value]] = []
    for c in comparisons:
        role = role_of(c.name, siblings)
        alike = None if c.alike is None else "yes" if c.alike else "no"
        rows.append([role, "all siblings" if c.name == MERGED else c.name, c.images])
        rows[-1] += [c.mean_squared, c.distance, c.p, c.effect, c.power, c.enough and round(c.enough), alike]
        rows[-1] += of_paper.get(role, (None, None))
    columns = [
        *styled("text", "vs DT", "simulator"),
        Column("images", "count"),
        Column("MSE", "number"),
        Column("distance", "small"),
        Column("p", "p"),
        *styled("number", "Cohen's d", "power"),
        Column("enough images", "count"),
        Column("alike"),
        Column("paper: distance", "small"),
        Column("paper: p", "p"),
    ]
    own = errors[twin] ** 2
    notes = [
        f"DT is {twin}: {len(own)} images, mean squared error {own.mean():.3f}"
        + (f" (paper: {MEAN_SQUARED[network]:.2f})." if network in MEAN_SQUARED else "."),
        "Alike, by the paper's rule: p above 0.05 and a power of 0.8 or more.",
    ]
    main = Table(name="rq1", title="RQ1: steering errors against the twin's", columns=columns, rows=rows, notes=notes)
    others: list[list[Value]] = [
        [v.what, role_of(v.name, siblings), v.distance, v.p, v.power] for v in robustness_checks
    ]
    heads = [*styled("text", "how", "who"), Column("distance", "small"), Column("p", "p"), Column("power", "number")]
    names = [*siblings, twin]
    columns_of = {name: densities(errors[name]) for name in names}
    width = RANGE / BINS
    bins: list[list[Value]] = [
        [width * k, width * (k + 1), *(float(columns_of[name][k]) for name in names)] for k in range(BINS)
    ]
    edges = [Column("error from", "number"), Column("to", "number")]
    return [
        _without_paper(main, 2),
        Table(name="rq1_robustness_checks", title="RQ1 in other ways", columns=heads, rows=others),
        Table(
            name="rq1_densities",
            title="RQ1: densities of the steering errors",
            columns=[*edges, *(Column(name, "number") for name in names)],
            rows=bins,
        ),
    ]


def _without_paper(table: Table, columns: int) -> Table:
    """Drop the paper's columns if all are empty, because the paper does not test this network."""
    if any(value is not None for row in table.rows for value in row[-columns:]):
        return table
    return replace(table, columns=table.columns[:-columns], rows=[row[:-columns] for row in table.rows])


CORRELATIONS = Path("maps/correlations.json")
"""File with the comparison with the twin, relative to the campaign folder."""
_RENAMED_VALUES = {"quality": "quality_loss"}
"""Value in files of earlier versions -> present name."""


def evaluate_campaign(
    config: CampaignConfig, maps: Mapping[MapId, FeatureMap]
) -> tuple[list[Correlation], list[PairedDifference], list[Table]]:
    """Compute RQ2, RQ3 and paired differences, and tabulate them with robustness checks; empty without a twin."""
    if config.twin is None:
        return [], [], []
    compared = maps, config.siblings, config.twin
    correlations, differences = evaluate(*compared, resamples=RESAMPLES), paired_differences(*compared)
    tables = [
        *correlation_tables(correlations, config.siblings, config.twin, network_of(config.driver)),
        *([paired_difference_table(differences, config.siblings)] if differences else []),
        robustness_table(check_robustness(*compared), cautions(correlations)),
    ]
    return correlations, differences, tables


def read_correlations(folder: Path, config: CampaignConfig) -> list[Correlation]:
    """Read correlations that this version or an earlier one wrote; `StoreError` if the file is damaged."""
    by_name = {map_id.name: map_id for map_id in map_ids(config.siblings, config.twin)}
    keys = {field.name for field in fields(Correlation)}
    try:
        rows: list[dict[str, Any]] = load_json(read_file(folder, CORRELATIONS))
        correlations = []
        for row in rows:
            values = {key: value for key, value in row.items() if key in keys}
            value = _RENAMED_VALUES.get(row["value"], row["value"])
            correlations.append({**values, "map": by_name[row["name"]], "value": value})
        return TypeAdapter(list[Correlation]).validate_python(correlations)
    except (FileNotFoundError, ValueError, KeyError, TypeError, AttributeError):
        raise StoreError(
            f"{folder / CORRELATIONS} cannot be read: `{ds_command('report', folder)}` writes it again"
        ) from None


def network_of(driver: DriverName) -> Network | None:
    """Find the paper's heading for a network, M_S if it sees plain images, M_R translated ones; None for any other."""
    from ds_driver.networks.network_driver import sees_translated
    from ds_driver.networks.weights import architecture_in, shipped_networks

    architecture = architecture_in(shipped_networks().get(driver.network, Path(driver.network)))
    return (architecture, "real" if sees_translated(driver) else "sim") if architecture in NETWORKS else None
