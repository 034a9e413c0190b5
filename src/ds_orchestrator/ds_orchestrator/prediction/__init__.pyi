from .coverage import CellForecast, forecast_cells, forecasts_in_turn
from .outcome_table import (
    OutcomeTable,
    OutcomeTableError,
    State,
    table_of_campaign,
    table_of_comparison,
    table_of_outcomes,
)
from .predictor_scores import PredictorComparison, PredictorScore, compare_predictors, comparison_tables
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
    "State",
    "TestVerdict",
    "TwinPrediction",
    "Verdicts",
    "compare_predictors",
    "comparison_tables",
    "forecast_cells",
    "forecasts_in_turn",
    "judge",
    "predict_twin",
    "table_of_campaign",
    "table_of_comparison",
    "table_of_outcomes",
]
