from .coverage import CellForecast, forecast_cells
from .outcome_table import (
    OutcomeTable,
    OutcomeTableError,
    State,
    table_of_campaign,
    table_of_comparison,
    table_of_outcomes,
)
from .predictor_scores import PredictorComparison, PredictorScore, compare_predictors, comparison_tables
from .self_check import SelfCheck, check_in_turn
from .twin_prediction import MarginDrive, TwinPrediction, predict_twin
from .verdicts import CellVerdict, TestVerdict, Verdicts, judge

__all__ = [
    "CellForecast",
    "CellVerdict",
    "MarginDrive",
    "OutcomeTable",
    "OutcomeTableError",
    "PredictorComparison",
    "PredictorScore",
    "SelfCheck",
    "State",
    "TestVerdict",
    "TwinPrediction",
    "Verdicts",
    "check_in_turn",
    "compare_predictors",
    "comparison_tables",
    "forecast_cells",
    "judge",
    "predict_twin",
    "table_of_campaign",
    "table_of_comparison",
    "table_of_outcomes",
]
