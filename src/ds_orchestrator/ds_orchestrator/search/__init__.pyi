from .algorithms import SEARCHES, DeepHyperion, DeepHyperionCS, RandomSearch
from .archive import Archive, Elite
from .base import Search, SearchSettings
from .features import FEATURES, Cell, cell_of, feature_of

__all__ = [
    "Archive",
    "Cell",
    "DeepHyperion",
    "DeepHyperionCS",
    "Elite",
    "FEATURES",
    "RandomSearch",
    "SEARCHES",
    "Search",
    "SearchSettings",
    "cell_of",
    "feature_of",
]
