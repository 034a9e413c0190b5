from .algorithms import SEARCHES, DeepHyperion, DeepHyperionCS, RandomSearch
from .archive import Archive, Elite
from .base import Candidate, Search, SearchSettings
from .condition_space import ConditionSpace, SearchedCondition
from .features import FEATURES, Cell, cell_of, feature_of
from .objectives import OBJECTIVES, Objective

__all__ = [
    "Archive",
    "Candidate",
    "Cell",
    "ConditionSpace",
    "DeepHyperion",
    "DeepHyperionCS",
    "Elite",
    "FEATURES",
    "OBJECTIVES",
    "Objective",
    "RandomSearch",
    "SEARCHES",
    "Search",
    "SearchSettings",
    "SearchedCondition",
    "cell_of",
    "feature_of",
]
