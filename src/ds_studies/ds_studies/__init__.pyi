from .comparison.compare import compare
from .comparison.compared_tests import GivenTests, random_tests, tests_of_campaign, tests_of_campaigns
from .same_roads import drive_same_roads
from .sensitivity.analysis import Sensitivity, analyse_sensitivity
from .sensitivity.factors import RESOLUTIONS, Factor, all_factors, factors_named
from .sensitivity.thresholds import Threshold
from .suite.run_suite import run_suite, settings_of_suite, with_outcomes
from .suite.selection import select, suite_of
from .suite.suite_file import Suite, SuiteError, SuiteOutcome, SuiteTest, read_suite, write_suite

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
