# SPDX-License-Identifier: Apache-2.0
from .common.driven_road import DrivenRoad
from .common.outcome_table import (
    ROAD_FEATURES,
    OutcomeTable,
    OutcomeTableError,
    State,
    table_of_campaign,
    table_of_comparison,
    table_of_runs,
)
from .comparison.analysis import (
    CellComparison,
    Comparison,
    SimulatorComparison,
    advice_of,
    answer_of,
    cautions_of,
    compare_networks,
    sentences_of,
)
from .comparison.ci_results import Criteria, MaxFailures
from .comparison.paired_drives import (
    ComparedTest,
    ComparisonError,
    DriveOutcome,
    Network,
    PairedCounts,
    PairedDrive,
    adjusted,
    difference_interval,
)
from .comparison.tables import markdown_of
from .outcomes.reading import read_table
from .paper.campaign_contents import maps_of
from .paper.correlation import (
    Correlation,
    PairedDifference,
    RobustnessCheck,
    check_robustness,
    correlate,
    evaluate,
    paired_differences,
)
from .prediction.car import CarPrediction, predict_car
from .prediction.mixture import Drive, Prediction, predict
from .prediction.predictors import PredictorComparison, PredictorScore, compare_predictors, comparison_tables
from .prediction.verdicts import CellVerdict, TestVerdict, Verdicts, judge
from .sensitivity import RESOLUTIONS, Factor, Sensitivity, Threshold, all_factors, factors_named
from .siblings.analysis import PairComparison, SiblingAnalysis, analyse, analysis_tables
from .siblings.beyond_features import AddedInformation, Baseline, ResidualCorrelation

__all__ = [
    "AddedInformation",
    "Baseline",
    "CarPrediction",
    "CellComparison",
    "CellVerdict",
    "ComparedTest",
    "Comparison",
    "ComparisonError",
    "Correlation",
    "Criteria",
    "Drive",
    "DriveOutcome",
    "DrivenRoad",
    "Factor",
    "MaxFailures",
    "Network",
    "OutcomeTable",
    "OutcomeTableError",
    "PairComparison",
    "PairedCounts",
    "PairedDifference",
    "PairedDrive",
    "Prediction",
    "PredictorComparison",
    "PredictorScore",
    "RESOLUTIONS",
    "ROAD_FEATURES",
    "ResidualCorrelation",
    "RobustnessCheck",
    "Sensitivity",
    "SiblingAnalysis",
    "SimulatorComparison",
    "State",
    "TestVerdict",
    "Threshold",
    "Verdicts",
    "adjusted",
    "advice_of",
    "all_factors",
    "analyse",
    "analysis_tables",
    "answer_of",
    "cautions_of",
    "check_robustness",
    "compare_networks",
    "compare_predictors",
    "comparison_tables",
    "correlate",
    "difference_interval",
    "evaluate",
    "factors_named",
    "judge",
    "maps_of",
    "markdown_of",
    "paired_differences",
    "predict",
    "predict_car",
    "read_table",
    "sentences_of",
    "table_of_campaign",
    "table_of_comparison",
    "table_of_runs",
]
