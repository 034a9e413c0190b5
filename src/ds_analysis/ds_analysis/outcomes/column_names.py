# SPDX-License-Identifier: Apache-2.0
"""Guesses which column of a table of others is what, by names and by content; a verdict only where words say it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import pandas as pd

from ds_analysis.outcomes.columns import GUIDE, NO_VERDICT, WORDS, Columns, is_empty, text_of, word_of
from ds_analysis.outcomes.study import read_frame

FILE = "columns.yaml"
FAILED = r"(is_?)?(failed|fails?|failures?|crash(ed)?|critical|unsafe)"
VERDICT = r"(test_?)?(outcome|result|verdict|status)"
NAMES = {
    "test": r"(test|scenario|route|road|case)(_?(id|name|number))?|id",
    "simulator": r"sim(ulator)?(_?name)?|platform|engine",
    "repeat": r"rep(eat|etition)?|run(_?(id|number))?|trial|iteration|attempt",
    "family": r"family|parent(_?id)?",
    "passed": r"(is_?)?(pass(ed)?|success(ful)?|safe)",
    "margin": r"(max_?)?(abs_?)?(xte|cte|lateral|deviation|offset)(_.*)?",
}
"""What a column is -> names that it has, in any case."""
TRUTHS = {"true", "false", "1", "0", "yes", "no"}
"""Words that say whether a test failed only beside a name that says so."""
MOST_GROUPS = 20
"""Values of a column that may name simulators; chosen: more are tests."""


@dataclass
class Guess:
    """What the columns of a table seem to be."""

    columns: dict[str, Any] = field(default_factory=dict)  # content of the YAML file so far; `reasons` say why
    reasons: dict[str, str] = field(default_factory=dict)
    # Key that only a person can fill in -> lines for it, each with a question.
    asked: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    # Whether every key comes from a usual name that only one column has, and the verdict from known words.
    sure: bool = True
    only: str = ""  # name of the simulator where no column tells several apart

    def set(self, key: str, value: Any, reason: str, *, sure: bool) -> None:
        """Add a key."""
        self.columns[key], self.reasons[key] = value, reason
        self.sure &= sure

    def ask(self, key: str, line: str, question: str) -> None:
        """Leave a key to a person."""
        self.asked.setdefault(key, []).append((line, question))
        self.sure = False

    def text(self, source: str) -> str:
        """Content of the YAML file; what is guessed are its values, the rest comments to make values of."""
        lines = [f"# What the columns of {json.dumps(source)} seem to be. {GUIDE} shows what else can be said."]
        for key in sorted(self.columns, key=list(Columns.model_fields).index):
            lines += [f"# {self.reasons[key]}", f"{key}: {json.dumps(self.columns[key])}"]
        for key, asked in self.asked.items():
            for line, question in asked:
                of_one = f"simulators: {{{json.dumps(self.only)}: {{{line}}}}}"
                lines += [f"# {question}", f"# {of_one if self.only and key == 'failed' else line}"]
        return "\n".join([*lines, "# The simulator that the others are to predict, or a real car, if any:", _ROLES])


_ROLES = "# twin: NAME\n# car: NAME\n"


def guess_columns(path: Path) -> Guess | None:
    """Guess what the columns of a table are; None if they have the names that `ds outcomes export` gives them."""
    frame = read_frame(path)
    if {"test_id", "simulator"} <= set(frame) and ("failed" in frame or {"margin", "limit"} <= set(frame)):
        return None
    guess, named = Guess(), {key: list(_named(frame, pattern)) for key, pattern in NAMES.items()}
    for key in ("repeat", "family"):
        if len(named[key]) == 1:
            guess.set(key, named[key][0], "by its name", sure=True)
    wide = {name: one for one in frame for name in [_simulator_in(one)] if name and _says(frame[one], FAILED)}
    if len(wide) < 2 or named["simulator"] or any(_named(frame, FAILED)):
        wide = {}
    verdicts = [] if wide else _verdict(frame, named["passed"], guess)
    taken = {*wide.values(), *verdicts, *named["repeat"][:1], *named["family"][:1]}
    _test_and_simulator(frame, named, taken, guess, bool(wide))
    if wide:
        guess.set("simulators", {name: {"failed": one} for name, one in wide.items()}, "by their names", sure=False)
    elif "simulator" not in guess.columns:
        guess.only, guess.sure = path.stem, False
        if "failed" in guess.columns:
            said = "no column tells simulators apart, so all rows are of one: give it a name"
            guess.set("simulators", {path.stem: {"failed": guess.columns.pop("failed")}}, said, sure=False)
    if not wide and not verdicts:
        for one in named["margin"]:
            line = f"margin: {{column: {json.dumps(one)}, limit: LIMIT}}"
            guess.ask("failed", line, "Beyond which LIMIT is it a failure?")
        guess.ask("failed", "failed: COLUMN", "Which column says whether a test failed?")
    return guess


def _named(frame: pd.DataFrame, pattern: str) -> Iterator[str]:
    return (one for one in map(str, frame.columns) if re.fullmatch(pattern, one.strip(), re.IGNORECASE))


def _simulator_in(column: str) -> str:
    """Name of the simulator in a column of a wide table, such as `failed_beamng`; empty if there is none."""
    either = rf"({FAILED}|{VERDICT})"
    match = re.fullmatch(rf"{either}[_ .-](?P<first>.+)|(?P<last>.+)[_ .-]{either}", column.strip(), re.IGNORECASE)
    name = str(match["first"] or match["last"]) if match else ""
    return "" if re.fullmatch(r"is|test|id|type|reason|code|message|time", name, re.IGNORECASE) else name


def _says(column: pd.Series[Any], name: str) -> bool:
    """Whether the words of a column say which tests failed; of 1 and 0 if its own name contains another."""
    words = {word_of(one) for one in column[~is_empty(column)]}
    clear = re.search(name, str(column.name), re.IGNORECASE) is not None or not words & TRUTHS
    return clear and bool(words - NO_VERDICT) and words <= WORDS[True] | WORDS[False] | NO_VERDICT


def _verdict(frame: pd.DataFrame, passed: Sequence[str], guess: Guess) -> list[str]:
    """Set `failed` where a column's words say it; otherwise show the words of those that might."""
    failures = list(_named(frame, FAILED))
    candidates = [*failures, *_named(frame, VERDICT), *passed]
    clear = [one for one in candidates if _says(frame[one], rf"^{FAILED}$")]
    if clear:
        only = clear[:1] in (failures, candidates)
        guess.set("failed", clear[0], "by its name and words", sure=only)
        return clear
    for one in candidates:
        counts = frame[one].dropna().map(text_of).value_counts().to_dict()
        good = WORDS[False] - TRUTHS | ({"true", "1", "yes"} if one in passed else set())
        wanted = next((word for word in counts if word_of(word) in good), "WORD")
        if one in passed and {word_of(word) for word in counts} <= TRUTHS and wanted != "WORD":
            guess.set("failed", {"column": one, "is_not": wanted}, "the opposite of its name", sure=False)
            return [one]
        shown = ", ".join(f"{json.dumps(word)} {counts[word]}" for word in list(counts)[:6])
        line = f"failed: {{column: {json.dumps(one)}, is_not: {json.dumps(wanted)}}}"
        guess.ask("failed", line, f"Which words are failures? It says {shown}")
    return candidates


def _test_and_simulator(
    frame: pd.DataFrame, named: dict[str, list[str]], taken: set[str], guess: Guess, wide: bool
) -> None:
    """Set `test` and `simulator`: columns of usual names, or the first that tell all rows apart."""
    repeat, tests, simulators = (named[key][:1] for key in ("repeat", "test", "simulator"))
    others = [one for one in frame if one not in {*taken, *tests, *simulators} and frame[one].dtype.kind != "f"]
    if not tests:
        tests = _telling(frame, others, [*simulators, *repeat])
    elif not (simulators or wide or _tells(frame, [*tests, *repeat])):
        few = [one for one in others if 1 < frame[one].nunique() <= MOST_GROUPS]
        simulators = _telling(frame, few, [*tests, *repeat])
    told = _tells(frame, [*tests, *simulators, *repeat])
    for key, names in (("test", tests), ("simulator", simulators)):
        if names:
            by = "by its name" if named[key] else "as it tells rows apart"
            guess.set(key, names if len(names) > 1 else names[0], by, sure=told and len(named[key]) == 1)
    if not tests:
        guess.ask("test", "test: COLUMN", "Which column, or list of columns, names the test?")


def _telling(frame: pd.DataFrame, candidates: Sequence[str], beside: Sequence[str]) -> list[str]:
    """First column, or two, that tell rows apart together with others; none if there are no such."""
    for count in (1, 2):
        for chosen in combinations(candidates[:MOST_GROUPS], count):
            if _tells(frame, [*chosen, *beside]):
                return list(chosen)
    return []


def _tells(frame: pd.DataFrame, columns: list[str]) -> bool:
    """Whether no two rows have the same values, rows with an empty one apart."""
    return not frame[columns].dropna().duplicated().any()
