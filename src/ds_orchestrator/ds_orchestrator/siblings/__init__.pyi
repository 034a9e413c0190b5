from .analysis import SiblingAnalysis, analyse, analysis_tables
from .baseline import Baseline
from .information import AddedInformation
from .outcomes import ROAD_FEATURES, Outcomes, outcomes_of_campaign, outcomes_of_runs
from .residuals import ResidualCorrelation

__all__ = [
    "ROAD_FEATURES",
    "AddedInformation",
    "Baseline",
    "Outcomes",
    "ResidualCorrelation",
    "SiblingAnalysis",
    "analyse",
    "analysis_tables",
    "outcomes_of_campaign",
    "outcomes_of_runs",
]
