from .run_suite import config_of_suite, run_suite, with_outcomes
from .selection import select, suite_of
from .suite_file import Suite, SuiteError, SuiteOutcome, SuiteTest, read_suite, write_suite

__all__ = [
    "Suite",
    "SuiteError",
    "SuiteOutcome",
    "SuiteTest",
    "config_of_suite",
    "read_suite",
    "run_suite",
    "select",
    "suite_of",
    "with_outcomes",
    "write_suite",
]
