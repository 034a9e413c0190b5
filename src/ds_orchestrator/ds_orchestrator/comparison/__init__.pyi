from .analysis import CellComparison, Comparison, SimulatorComparison, compare_networks
from .compare import compare
from .compared_tests import GivenTests, random_tests, tests_of_campaign, tests_of_campaigns
from .criteria import Criteria, MaxFailures
from .drives import ComparedTest, ComparisonError, DriveOutcome, Network, PairedDrive
from .given_tests import Engine, drive_tests
from .markdown import markdown_of
from .paired_statistics import PairedCounts, adjusted, difference_interval
from .summary import advice_of, answer_of, cautions_of, sentences_of

__all__ = [
    "CellComparison",
    "ComparedTest",
    "Comparison",
    "ComparisonError",
    "Criteria",
    "DriveOutcome",
    "Engine",
    "GivenTests",
    "MaxFailures",
    "Network",
    "PairedCounts",
    "PairedDrive",
    "SimulatorComparison",
    "adjusted",
    "advice_of",
    "answer_of",
    "cautions_of",
    "compare",
    "compare_networks",
    "difference_interval",
    "drive_tests",
    "markdown_of",
    "random_tests",
    "sentences_of",
    "tests_of_campaign",
    "tests_of_campaigns",
]
