from .common.heatmap import draw_map, write_maps
from .common.paired_statistics import PairedCounts, adjusted, difference_interval
from .common.table import Table, write_tables
from .comparison.analysis import CellComparison, Comparison, SimulatorComparison, compare_networks
from .comparison.criteria import Criteria, MaxFailures
from .comparison.drives import ComparedTest, ComparisonError, DriveOutcome, Network, PairedDrive
from .comparison.markdown import markdown_of
from .comparison.summary import advice_of, answer_of, cautions_of, sentences_of
from .paper.campaign_evaluation import maps_of
from .paper.correlation import Correlation, PairedDifference, correlate, evaluate, paired_differences
from .paper.robustness_checks import RobustnessCheck, check_robustness
from .paper.simulator_agreement import DrivenRoad, PairComparison
from .prediction.coverage import CellForecast, forecast_cells
from .prediction.outcome_table import (
    OutcomeTable,
    OutcomeTableError,
    State,
    table_of_campaign,
    table_of_comparison,
    table_of_outcomes,
)
from .prediction.predictor_scores import PredictorComparison, PredictorScore, compare_predictors, comparison_tables
from .prediction.self_check import SelfCheck, check_in_turn
from .prediction.twin_prediction import MarginDrive, TwinPrediction, predict_twin
from .prediction.verdicts import CellVerdict, TestVerdict, Verdicts, judge
from .siblings.analysis import SiblingAnalysis, analyse, analysis_tables
from .siblings.baseline import Baseline
from .siblings.information import AddedInformation
from .siblings.outcomes import ROAD_FEATURES, Outcomes, outcomes_of_campaign, outcomes_of_runs
from .siblings.residuals import ResidualCorrelation

__all__ = [
    "AddedInformation",
    "Baseline",
    "CellComparison",
    "CellForecast",
    "CellVerdict",
    "ComparedTest",
    "Comparison",
    "ComparisonError",
    "Correlation",
    "Criteria",
    "DriveOutcome",
    "DrivenRoad",
    "MarginDrive",
    "MaxFailures",
    "Network",
    "OutcomeTable",
    "OutcomeTableError",
    "Outcomes",
    "PairComparison",
    "PairedCounts",
    "PairedDifference",
    "PairedDrive",
    "PredictorComparison",
    "PredictorScore",
    "ROAD_FEATURES",
    "ResidualCorrelation",
    "RobustnessCheck",
    "SelfCheck",
    "SiblingAnalysis",
    "SimulatorComparison",
    "State",
    "Table",
    "TestVerdict",
    "TwinPrediction",
    "Verdicts",
    "adjusted",
    "advice_of",
    "analyse",
    "analysis_tables",
    "answer_of",
    "cautions_of",
    "check_in_turn",
    "check_robustness",
    "compare_networks",
    "compare_predictors",
    "comparison_tables",
    "correlate",
    "difference_interval",
    "draw_map",
    "evaluate",
    "forecast_cells",
    "judge",
    "maps_of",
    "markdown_of",
    "outcomes_of_campaign",
    "outcomes_of_runs",
    "paired_differences",
    "predict_twin",
    "sentences_of",
    "table_of_campaign",
    "table_of_comparison",
    "table_of_outcomes",
    "write_maps",
    "write_tables",
]
