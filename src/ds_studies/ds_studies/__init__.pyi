# SPDX-License-Identifier: Apache-2.0
from .comparison.compare import GivenTests, compare, random_tests, tests_of_campaign, tests_of_campaigns
from .same_roads import drive_same_roads
from .sensitivity.analysis import Sensitivity, analyse_sensitivity
from .sensitivity.factors import RESOLUTIONS, Factor, all_factors, factors_named
from .sensitivity.measurement import Threshold
from .suite.suite_file import (
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
    "Factor",
    "GivenTests",
    "RESOLUTIONS",
    "Sensitivity",
    "Suite",
    "SuiteError",
    "SuiteOutcome",
    "SuiteTest",
    "Threshold",
    "all_factors",
    "analyse_sensitivity",
    "compare",
    "drive_same_roads",
    "settings_of_suite",
    "factors_named",
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
