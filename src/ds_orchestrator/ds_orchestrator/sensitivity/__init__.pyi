from .analysis import Sensitivity, analyse_sensitivity
from .factors import RESOLUTIONS, Factor, all_factors, factors_named
from .thresholds import Threshold

__all__ = ["RESOLUTIONS", "Factor", "Sensitivity", "Threshold", "all_factors", "analyse_sensitivity", "factors_named"]
