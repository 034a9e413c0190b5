from .campaign_evaluation import maps_of
from .correlation import Correlation, PairedDifference, correlate, evaluate, paired_differences
from .robustness_checks import RobustnessCheck, check_robustness
from .simulator_agreement import PairComparison
from .table import Table, write_tables

__all__ = [
    "Correlation",
    "PairComparison",
    "PairedDifference",
    "RobustnessCheck",
    "Table",
    "correlate",
    "evaluate",
    "paired_differences",
    "check_robustness",
    "maps_of",
    "write_tables",
]
