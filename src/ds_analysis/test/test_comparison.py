# SPDX-License-Identifier: Apache-2.0
"""Two networks on the same tests: statistics against other computations, verdicts, summaries, criteria, JUnit."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.stats import binomtest

from ds_analysis.comparison.analysis import (
    Comparison,
    advice_of,
    answer_of,
    cautions_of,
    compare_networks,
    is_sure,
    sentences_of,
)
from ds_analysis.comparison.ci_results import Criteria, MaxFailures, cases_of, junit_of
from ds_analysis.comparison.paired_drives import (
    ComparedTest,
    DriveOutcome,
    Network,
    PairedCounts,
    PairedDrive,
    adjusted,
    difference_interval,
    fewest_changes,
    sequential_evidence,
)
from ds_analysis.comparison.tables import cell_table, document_of, markdown_of
from ds_base.palette import FAIL, PASS, rgb
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import ConfigError
from ds_report.comparison_page import grids_of, style_of_difference, write_comparison_page
from ds_road import Road, generate
from ds_sim import BULLET, DONKEY, SimulatorName
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome


@cache
def road(number: int) -> Road:
    """A random road, which is no mutant of another one."""
    return generate(np.random.default_rng(number))


OLD, NEW = Network(driver=DriverName("old"), sha256="a" * 64), Network(driver=DriverName("new"), sha256="b" * 64)


def outcome(failed: bool, *, key: str = "") -> DriveOutcome:
    return DriveOutcome(
        outcome=Outcome.OUT_OF_BOUNDS if failed else Outcome.COMPLETED,
        fitness=-0.2 if failed else 0.5,
        trajectory_sha256=hashlib.sha256(key.encode()).hexdigest() if key else "",
        path=np.array([[125.0, 25.0], [125.0, 60.0]]),
    )


def pairs(simulator: str, counts: tuple[int, int, int, int], *, unsearched: Sequence[int] = ()) -> list[PairedDrive]:
    """Drives with so many newly failing, fixed, failing and passing tests; the tests at some places are unsearched."""
    kinds = [(False, True), (True, False), (True, True), (False, False)]
    changes = [kind for kind, number in zip(kinds, counts, strict=True) for _ in range(number)]
    return [
        PairedDrive(
            test=ComparedTest(
                name=f"test-0-{number:04d}",
                scenario=Scenario(road(number), seed=number),
                cell=(number % 2, 10),
                unsearched=number in unsearched,
            ),
            simulator=SimulatorName(simulator),
            reference=outcome(before),
            candidate=outcome(after),
        )
        for number, (before, after) in enumerate(changes)
    ]


def compared(drives: list[PairedDrive], **more: Any) -> Comparison:
    names = list(dict.fromkeys(drive.simulator for drive in drives)) or [BULLET]
    given: dict[str, Any] = {"origin": "random", "source": "made up", "simulators": names, **more}
    return compare_networks(drives, reference=OLD, candidate=NEW, **given)


@pytest.mark.parametrize("changes", [(0, 0), (1, 0), (5, 0), (3, 9), (12, 4), (30, 28)])
def test_p_is_that_of_a_fair_coin_over_the_tests_that_change(changes: tuple[int, int]) -> None:
    counts = PairedCounts(newly_fail=changes[0], fixed=changes[1], both_fail=7, both_pass=40)
    expected = binomtest(changes[0], sum(changes), 0.5).pvalue if sum(changes) else 1.0
    assert counts.p == pytest.approx(expected)


@pytest.mark.parametrize("counts", [(12, 4, 10, 74), (30, 28, 20, 122), (3, 15, 40, 60)])
def test_the_interval_is_close_to_that_of_agresti_and_min(counts: tuple[int, int, int, int]) -> None:
    """Their closed form adds half an observation to each of the four outcomes (Statistics in Medicine 24, 2005)."""
    worse, better, *_ = (n + 0.5 for n in counts)
    n = sum(counts) + 2.0
    middle = (worse - better) / n
    half = 1.959964 * math.sqrt(worse + better - (worse - better) ** 2 / n) / n
    assert difference_interval(*counts) == pytest.approx((middle - half, middle + half), abs=0.012)


@pytest.mark.parametrize("counts", [(1, 0, 0, 0), (0, 2, 0, 0), (0, 0, 1, 0)])
def test_the_interval_contains_the_observed_difference(counts: tuple[int, int, int, int]) -> None:
    low, high = difference_interval(*counts)
    assert low <= (counts[0] - counts[1]) / sum(counts) <= high


def test_the_fewest_changes_are_the_first_that_reach_significance() -> None:
    for family in (1, 3, 6):
        needed = fewest_changes(family)
        assert 2 * 0.5**needed * family < 0.05 <= 2 * 0.5 ** (needed - 1) * family


def test_p_values_are_adjusted_as_their_authors_do() -> None:
    """Holm 1979: (n - rank) p, never falling; Benjamini and Hochberg 1995, table 1: four of fifteen stay below 5%."""
    assert adjusted([0.01, 0.04, 0.03], "holm") == pytest.approx([0.03, 0.06, 0.06])
    values = "0.0001 0.0004 0.0019 0.0095 0.0201 0.0278 0.0298 0.0344 0.0459 0.3240 0.4262 0.5719 0.6528 0.7590 1.0"
    thrombolysis = [float(value) for value in values.split()]
    assert sum(p < 0.05 for p in adjusted(thrombolysis, "fdr_bh")) == 4
    assert adjusted([], "holm") == []


def test_a_network_that_newly_fails_often_is_worse_and_is_not_merged() -> None:
    found = compared([*pairs("bullet", (12, 1, 3, 24)), *pairs("donkey", (1, 1, 3, 35))], twin="donkey")
    assert [row.verdict for row in found.simulators] == ["worse", "not significant"]
    assert advice_of(found) == "do not merge" and answer_of(found) == "Merge? No: it is worse."
    # Two comparisons: Holm doubles the smaller p.
    assert found.simulators[0].p_adjusted == pytest.approx(2 * binomtest(12, 13, 0.5).pvalue)
    first, second = sentences_of(found)
    assert first.startswith("bullet: 12 of 40 tests passed and now fail, 1 the other way: on these it is worse. ")
    assert "Other such roads: worse, too (p = 0.007 after Holm)." in first
    assert second.startswith("donkey (twin): 1 of 40 tests passed and now fails, 1 the other way: on these it is nei")


def test_one_newly_failing_test_asks_for_a_look() -> None:
    found = compared(pairs("bullet", (1, 0, 0, 9)))
    assert advice_of(found) == "look first"
    assert answer_of(found).startswith("Merge? Look first: 1 drive newly fails, none is")
    assert "Too few tests change" in cautions_of(found)[-1]


def test_what_happened_is_said_before_what_is_significant() -> None:
    """Six of six tests that newly fail are no accident, as drives repeat; six are too few for other roads."""
    found = compared([*pairs("bullet", (6, 0, 0, 0)), *pairs("donkey", (0, 0, 6, 0))])
    assert answer_of(found) == "Merge? Look first: 6 drives newly fail, none is fixed: on these tests it is worse."
    said = "bullet: 6 of 6 tests passed and now fail, none the other way: on these it is worse. Whether that holds for "
    assert sentences_of(found)[0].startswith(said + "other such roads: p = 0.062 after Holm, so it is open; 95%: ")
    assert sentences_of(found)[1].startswith(
        "donkey: the same outcomes on 6 tests. Other such roads: no difference is shown; 95%"
    )
    assert 2 * binomtest(6, 6, 0.5).pvalue == pytest.approx(0.0625)
    better = compared(pairs("bullet", (0, 1, 0, 0)))
    assert sentences_of(better)[0].startswith("bullet: 1 of 1 test failed and now passes, none the other way: on these")
    for text in (markdown_of(found, {}), json.dumps(document_of(found, {}), ensure_ascii=False)):
        assert "6 of 6 tests passed and now fail" in text


def test_tests_that_were_searched_against_the_reference_show_no_improvement() -> None:
    """All that changes is fixed; only where random roads are fixed, too, is the candidate better."""
    fixed = pairs("bullet", (0, 20, 5, 15))
    assert compared(fixed).simulators[0].verdict == "better"
    assert re.fullmatch(r"Merge\? Yes: .* at least [1-9]\d* fewer fail on each simulator\.", answer_of(compared(fixed)))
    searched = compared(fixed, origin="reference")
    assert searched.simulators[0].verdict == "not significant"
    assert "Nothing speaks against it: no drive newly fails; at most 0 more" in answer_of(searched)
    assert "no evidence that the candidate is better" in cautions_of(searched)[0]
    with_random = compared(pairs("bullet", (0, 20, 5, 15), unsearched=range(20)), origin="reference")
    assert with_random.simulators[0].verdict == "better"


def test_mutants_of_one_road_count_together() -> None:
    """Twelve tests that newly fail are evidence; twelve variants of three roads are none."""
    alone = pairs("bullet", (12, 0, 0, 12))
    root = [generate(np.random.default_rng(50 + k // 4)) for k in range(24)]
    scenarios = [Scenario(road, seed=1) for road in root]
    mutants = [replace(one, test=replace(one.test, scenario=s)) for one, s in zip(alone, scenarios, strict=True)]
    assert PairedCounts.of(alone).p < 0.001 and PairedCounts.of(mutants).p > 0.2
    assert compared(alone, origin="both").simulators[0].verdict == "worse"
    assert compared(mutants, origin="both").simulators[0].verdict == "not significant"


def test_too_few_tests_decide_nothing_and_more_of_them_bound_what_may_be_worse() -> None:
    """With one simulator six tests could show a worse network, with five none could."""
    assert advice_of(compared(pairs("bullet", (0, 1, 0, 4)))) == "not decided"
    assert "too few tests" in answer_of(compared(pairs("bullet", (0, 0, 0, 5))))
    found = compared(pairs("bullet", (0, 0, 2, 58)))
    assert advice_of(found) == "merge"
    bound = int(answer_of(found).split("at most ")[1].split()[0])
    assert bound == math.ceil(100 * difference_interval(0, 0, 2, 58)[1]) and 2 < bound < 6


def test_missing_drives_are_never_a_reason_to_merge() -> None:
    found = compared(pairs("bullet", (0, 0, 0, 9)), left_out=[("test-0-0009", "bullet", "SIM_ERROR: gone")])
    assert advice_of(found) == "not decided" and answer_of(found) == "Merge? Not decided: drives are missing."
    assert advice_of(compared([])) == "not decided"


def test_identical_drives_are_said_to_be_identical() -> None:
    (failing,) = pairs("bullet", (0, 0, 1, 0))
    same = outcome(True, key="same")
    found = compared([replace(failing, reference=same, candidate=same)])
    assert "identically, to the bit" in sentences_of(found)[0]
    assert answer_of(found) == "Merge? Nothing changes: every drive is the same."


def test_cells_pool_their_own_tests_on_each_simulator() -> None:
    found = compared([*pairs("bullet", (2, 0, 0, 4)), *pairs("donkey", (0, 0, 0, 6))])
    numbers = {(one.simulator, one.cell[0]): (one.counts.newly_fail, one.counts.tests) for one in found.cells}
    assert numbers == {("bullet", 0): (1, 3), ("bullet", 1): (1, 3), ("donkey", 0): (0, 3), ("donkey", 1): (0, 3)}
    # One changed test says nothing, however many cells there are.
    assert all(one.p_adjusted == 1.0 for one in found.cells)
    assert len(cell_table(found).rows) == 2


def test_bets_multiply_as_their_definition_says() -> None:
    """Against no difference, a newly failing test pays 1 + c to who bets on it, 1 - c to who bets against it."""
    stakes = (0.2, 0.5, 0.95)
    capital = [sum((1 + c) ** n + (1 - c) ** n for c in stakes) / 6 for n in range(4)]
    assert sequential_evidence((1, 1, 1))[0] == pytest.approx(1 / max(capital))
    assert sequential_evidence(()) == (1.0, (-1.0, 1.0))
    p, (low, high) = sequential_evidence((-1,) * 12)
    assert p < 0.05 and low == -1.0 and high < 0.0
    assert sequential_evidence((1,) * 9 + (0,) * 100)[0] < 0.05  # what was sure stays sure


@pytest.mark.parametrize(("newly", "fixed"), [(0.0, 0.0), (0.1, 0.1), (0.3, 0.3), (0.3, 0.0), (0.05, 0.2)])
def test_the_truth_is_hardly_ever_missed_by_who_stops_when_it_suits(newly: float, fixed: float) -> None:
    """Looking after each of 60 tests, and stopping at the worst moment: at most 5%, and the noise of 400 series."""
    rng = np.random.default_rng(37)
    draws = rng.choice([1, -1, 0], size=(400, 60), p=[newly, fixed, 1 - newly - fixed])
    missed = false = 0
    for series in draws:
        looks = [sequential_evidence(tuple(map(int, series[:n]))) for n in range(5, 61, 5)]
        missed += any(not low - 0.005 <= newly - fixed <= high + 0.005 for _, (low, high) in looks)
        false += newly == fixed and any(p < 0.05 for p, _ in looks)
    assert missed <= 400 * 0.08 and false <= 400 * 0.08


def test_an_answer_is_sure_when_it_is_worse_somewhere_or_bounded_everywhere() -> None:
    def sure_answer(*counts: tuple[int, int, int, int]) -> tuple[bool, str]:
        drives = [drive for k, one in enumerate(counts) for drive in pairs(f"sim{k}", one)]
        found = compared(drives, sequential=True)
        return is_sure(found), answer_of(found)

    assert sure_answer((15, 0, 0, 5), (0, 0, 0, 20)) == (True, "Merge? No: it is worse.")
    assert not sure_answer((3, 0, 0, 17), (0, 0, 0, 20))[0]
    assert not sure_answer((0, 0, 2, 18))[0]
    sure, answer = sure_answer((0, 0, 2, 78), (0, 0, 0, 80))
    assert sure and "Nothing speaks against it" in answer
    assert "at most 10 more" in answer or int(answer.split("at most ")[1].split()[0]) <= 10


def test_criteria_name_what_they_miss() -> None:
    tally = {BULLET: (2, 40), DONKEY: (3, 40)}
    assert Criteria().unmet(tally) == []
    assert Criteria(fail_on="failure").unmet(tally) == ["tests fail: 2 on bullet, 3 on donkey"]
    assert Criteria(fail_on="regression").unmet(tally, newly_failing=0) == []
    assert Criteria(fail_on="regression").unmet(tally, newly_failing=1) == ["1 drive newly fails"]
    assert Criteria(fail_on="worse").unmet(tally, newly_failing=9) == []
    assert Criteria(fail_on="worse").unmet(tally, newly_failing=9, worse=["donkey"])
    # 5% of 40 tests are 2.
    limit = Criteria(max_failures=MaxFailures.parse("5%"))
    assert limit.unmet(tally) == ["3 of 40 tests fail on donkey, expected 5% at most"]
    assert Criteria(max_failures=MaxFailures.parse("3")).unmet(tally) == []


@pytest.mark.parametrize("text", ["-1", "101%", "5 %", "nan", "inf%", "", "1.5", "5%%", "1e3", "99999999999"])
def test_a_threshold_without_sense_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ConfigError, match="expected a share from 0% to 100%, or a number of tests") as error:
        MaxFailures.parse(text)
    assert "\n" not in str(error.value)


def test_a_criterion_without_its_reference_is_refused() -> None:
    with pytest.raises(ConfigError, match="needs outcomes to compare with"):
        Criteria(fail_on="regression").check(has_reference=False)


def test_junit_counts_a_known_failure_as_skipped_and_an_error_as_an_error() -> None:
    found = compared(pairs("bullet", (1, 1, 2, 3)), left_out=[("test-0-0009", "bullet", "SIM_ERROR: \x00 <gone>")])
    root = ElementTree.fromstring(junit_of("new & old", cases_of(found)).encode())
    suite = root.find("testsuite")
    assert suite is not None and suite.get("name") == "bullet"
    counts = {key: int(suite.get(key, "")) for key in ("tests", "failures", "errors", "skipped")}
    assert counts == {"tests": 8, "failures": 1, "errors": 1, "skipped": 2}
    assert [case.get("name") for case in suite.iter("testcase") if case.find("failure") is not None] == ["test-0-0000"]
    driven = sum(drive.candidate.simulated_seconds for drive in found.drives)
    times = [float(case.get("time", "")) for case in suite.iter("testcase")]
    assert sum(times) == pytest.approx(driven, abs=0.01) and float(root.get("time", "")) == pytest.approx(sum(times))
    assert {case.get("classname") for case in suite.iter("testcase")} == {"bullet"}
    error = next(suite.iter("error"))
    assert error.get("message") == "error: SIM_ERROR: ? <gone>"


def test_the_markdown_answers_first_and_escapes_names() -> None:
    found = compared(pairs("bullet", (12, 1, 3, 24)), source="Tests of my_campaign|x")
    text = markdown_of(found, {"test-0-0000": "worse/test-0-0000.json"}, ["12 tests newly fail"])
    lines = [line for line in text.splitlines() if line]
    assert lines[1] == "**Merge? No: it is worse.**"
    assert lines[2].startswith("- bullet: 12 of 40 tests passed and now fail")
    assert "my\\_campaign\\|x" in text
    assert "ds drive --sim bullet --driver new --road worse/test-0-0000.json --video test-0-0000-bullet.mp4" in text
    rows = [line for line in lines if line.startswith("|")]
    assert all(row.replace("\\|", "").count("|") == rows[0].count("|") for row in rows[:3])


def test_the_markdown_lists_cells_only_where_one_changed_significantly() -> None:
    few, many = (markdown_of(compared(pairs("bullet", (n, 0, 2, 10))), {}) for n in (1, 30))
    assert "No kind of road stands out: over 2 cells" in few and "p (BH)" not in few
    assert "No kind of road" not in many and "p (BH)" in many


def test_the_page_shows_newly_failing_roads_and_the_map(tmp_path: Path) -> None:
    found = compared([*pairs("bullet", (2, 1, 1, 4)), *pairs("<b>donkey", (0, 0, 0, 8))])
    page = tmp_path / "page.html"
    road_files = {"test-0-0000": str(tmp_path / "worse/test-0-0000.json")}
    write_comparison_page(found, page, road_files, ["2 tests newly fail"])
    text = page.read_text("utf-8")
    assert text.count("data:image/png;base64,") == 2 and "&lt;b&gt;donkey" in text and "<b>donkey" not in text
    assert "Pass criterion not met: 2 tests newly fail" in text and "2 of 8 tests passed and now fail, 1 the" in text
    grid = grids_of(found)[0]
    assert [[cell.text for cell in cells] for _, cells in grid.rows] == [["+1 −1/4", "+1/4"]]
    again = tmp_path / "again.html"
    write_comparison_page(found, again, road_files, ["2 tests newly fail"])
    assert again.read_bytes() == page.read_bytes()


def test_no_difference_has_the_colour_of_the_page_and_the_ends_are_those_of_failure_and_pass() -> None:
    assert "/ 0%)" in style_of_difference(0.0) and "color" not in style_of_difference(0.5)
    for difference, colour in ((1.0, FAIL), (-1.0, PASS)):
        assert "background: rgb({} {} {} / 100%); color".format(*rgb(colour)) in style_of_difference(difference)
