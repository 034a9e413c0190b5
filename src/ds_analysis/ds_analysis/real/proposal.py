# SPDX-License-Identifier: Apache-2.0
"""Proposes drives on a real car, drawn at random, and remembers what was proposed in which order."""

from __future__ import annotations

import math
import zlib
from collections.abc import Collection
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path, PurePath
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ds_analysis.common.outcome_table import MOST_TESTS, OutcomeTable, RoadTable, State
from ds_analysis.common.statistics import Indices
from ds_analysis.prediction.mixture import Prediction
from ds_analysis.real.records import FOLDER, MOST_ROWS, RecordError, Text
from ds_base.errors import InputError
from ds_base.folder_files import read_file, write_json
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions
from ds_sim.conditions.text import format_3sf, format_conditions

PROPOSAL = "proposal.json"
SCALE = 16.0
"""Metres of the road per metre of the car's: the twin is a car of 1:16 (paper 4.1)."""
_SEED = 23
"""Seed of the order in which tests are drawn, with their names; any number does."""


class BudgetError(InputError):
    """A number of drives that cannot be proposed."""


class _Row(BaseModel):
    """A proposed drive; `gain` is of files in which some tests were chosen, and null for those that were drawn."""

    model_config = ConfigDict(extra="allow")

    test_id: Text
    drawn: bool | None = None
    gain: float | None = 0.0


class Proposed(BaseModel):
    """What was proposed for a folder so far."""

    # Metres of the road per metre of the car's; None before the first proposal.
    scale: Annotated[float, Field(ge=1.0, le=100.0)] | None = None
    # Tests from which all rounds are drawn; () before the first proposal, and in files of 0.2.
    population: Annotated[list[Text], Field(max_length=MOST_TESTS)] = []
    rounds: Annotated[list[list[_Row]], Field(max_length=MOST_ROWS)] = []  # proposals, each in the order of its drives
    # Of each round, the tests that the car had driven by then without being proposed.
    before: Annotated[list[list[Text]], Field(max_length=MOST_ROWS)] = []

    @property
    def tests(self) -> list[str]:
        """Proposed tests, each once."""
        return list(dict.fromkeys(row.test_id for row in chain.from_iterable(self.rounds)))

    def in_order(self) -> list[tuple[str, bool]]:
        """Tests in the order in which the car was to drive them, each once, and whether they were drawn by a round."""
        tests: dict[str, bool] = {}
        for k, rows in enumerate(self.rounds):
            for test_id in self.before[k] if k < len(self.before) else []:
                tests.setdefault(test_id, False)
            for row in rows:
                tests.setdefault(row.test_id, row.gain is None if row.drawn is None else row.drawn)
        return list(tests.items())


def read_proposed(folder: Path) -> Proposed:
    """Read what was proposed for a folder; nothing if there is no file."""
    try:
        proposed = Proposed.model_validate_json(read_file(folder, PurePath(FOLDER, PROPOSAL)), strict=True)
    except FileNotFoundError:
        return Proposed()
    except ValidationError:
        proposed = Proposed()
    if not {"scale", "rounds"} <= proposed.model_fields_set or sum(map(len, proposed.rounds)) > MOST_ROWS:
        path = folder / FOLDER / PROPOSAL
        raise RecordError(f"{path} cannot be read: restore it, or remove it and propose again")
    return proposed


def candidates_of(table: OutcomeTable) -> Indices:
    """Rows of the tests that a car can be asked to drive: judged by a sibling, excluded on none."""
    excluded = (table.states[:, : len(table.siblings)] == State.EXCLUDED).any(axis=1)
    return np.flatnonzero(table.on_a_sibling & ~excluded)


@dataclass(frozen=True, kw_only=True)
class ProposedDrive:
    """A test to drive on the car."""

    test_id: str
    road: Road | None  # road to tape out; None if the test is known by its imported features alone
    conditions: Conditions
    features: dict[str, float]
    scale: float  # metres of the road per metre of the car's
    probability: float  # predicted probability that the car fails
    drawn: bool  # whether it was drawn from all tests that were left, so that it certifies something
    siblings: dict[str, str]  # simulator -> outcome of this test there: `failed`, `completed` or `not driven`

    @property
    def to_set(self) -> dict[str, str]:
        """Condition -> its value as a person sets it, to three digits: lengths and speeds at the car's scale."""
        return {name: _as_set(name, value, self.scale) for name, value in self.conditions.changed.items()}

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        fields = {key: value for key, value in asdict(self).items() if key not in ("road", "conditions", "scale")}
        return {**fields, "conditions": format_conditions(self.conditions)}


def _as_set(name: str, value: float, scale: float) -> str:
    unit = FIELDS[name].unit
    own = f"{format_3sf(value)} {unit}".rstrip()
    if unit == "rad":
        return f"{format_3sf(math.degrees(value))} degrees"
    if unit in ("m", "m/s") and scale != 1.0:
        return f"{format_3sf(value / scale)} {unit} ({own} at full scale)"
    return own


def propose(
    folder: Path,
    table: OutcomeTable,
    prediction: Prediction,
    driven: Collection[str],
    drives: int,
    *,
    scale: float | None = None,
    spread: bool = False,
) -> list[ProposedDrive]:
    """Draw the next tests for the car, and remember them; what was proposed before stays proposed.

    The order of all tests is drawn once, by a seed and their names; each call continues it, past what was `driven`
    meanwhile. So every proposed test is a uniform draw from all that were left, as the certificate needs it. With
    `spread`, the tests left are sorted by predicted probability and cut into as many groups of like size as there are
    `drives`; one of each group is drawn, which tells more, and certifies nothing.

    `scale` is metres of the road per metre of the car's, that of earlier proposals, or `SCALE`, if None. `BudgetError`
    if fewer tests are left, `RecordError` if another scale was proposed before, or the file of proposals is damaged.
    """
    proposed = read_proposed(folder)
    if proposed.scale is not None and scale not in (None, proposed.scale):
        raise RecordError(
            f"drives of a car of 1:{proposed.scale:g} were proposed before, not 1:{scale:g}: keep the scale, or copy "
            "the folder for another car"
        )
    scale = proposed.scale or (scale or SCALE if isinstance(table, RoadTable) else 1.0)
    population = proposed.population or [table.test_ids[row] for row in candidates_of(table)]
    order = np.random.default_rng([_SEED, zlib.crc32("\n".join(population).encode())]).permutation(len(population))
    taken = {*driven, *proposed.tests}
    place = table.rows
    left = [population[k] for k in order if population[k] not in taken and population[k] in place]
    if drives > len(left):
        raise BudgetError(
            f"{drives} drives: {len(left)} tests can be proposed, expected a budget of at most {len(left)}"
        )
    if spread:  # the first of each group in the random order
        probabilities = prediction.probabilities()
        ranked = sorted(left, key=lambda test_id: float(probabilities[place[test_id]]))
        left = [min(group, key=left.index) for group in np.array_split(ranked, drives)]
    proposals = [_proposed(table, prediction, place[test_id], scale, drawn=not spread) for test_id in left[:drives]]
    document = proposed.model_dump(exclude_defaults=True)
    rounds = [*document.get("rounds", []), [one.document() for one in proposals]]
    before = [*proposed.before, [test_id for test_id in driven if test_id not in proposed.tests]]
    content = {"scale": scale, "population": population, "rounds": rounds, "before": before}
    write_json(folder / FOLDER / PROPOSAL, content)
    return proposals


def _proposed(table: OutcomeTable, prediction: Prediction, row: int, scale: float, *, drawn: bool) -> ProposedDrive:
    words = {State.FAILED: "failed", State.COMPLETED: "completed"}
    features = dict(zip(table.feature_names, table.features[row].tolist(), strict=True))
    return ProposedDrive(
        test_id=table.test_ids[row],
        road=table.roads[row] if isinstance(table, RoadTable) else None,
        conditions=table.conditions[row] if isinstance(table, RoadTable) else DEFAULT,
        features={} if isinstance(table, RoadTable) else features,
        scale=scale,
        probability=float(prediction.probabilities(np.array([row]))[0]),
        drawn=drawn,
        siblings={
            name: words.get(State(table.states[row, table.column(name)]), "not driven") for name in table.siblings
        },
    )
