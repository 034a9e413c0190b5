# SPDX-License-Identifier: Apache-2.0
from .comparison import GivenTests, compare, random_tests, tests_of_campaign, tests_of_campaigns
from .same_roads import drive_same_roads
from .sensitivity import analyse_sensitivity
from .suite_file import (
    Suite,
    SuiteError,
    SuiteOutcome,
    SuiteTest,
    read_suite,
    run_suite,
    select,
    settings_of_suite,
    suite_of,
    with_outcomes,
    write_suite,
)

__all__ = [
    "GivenTests",
    "Suite",
    "SuiteError",
    "SuiteOutcome",
    "SuiteTest",
    "analyse_sensitivity",
    "compare",
    "drive_same_roads",
    "settings_of_suite",
    "random_tests",
    "read_suite",
    "run_suite",
    "select",
    "suite_of",
    "tests_of_campaign",
    "tests_of_campaigns",
    "with_outcomes",
    "write_suite",
]
