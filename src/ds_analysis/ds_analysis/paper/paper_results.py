"""Results of the paper, for comparison: its tables of RQ1, RQ2 and RQ3 (4.4) and of the networks (4.2.2).

Keys: network; image kind (`sim` for plain simulator images, `real` for translated ones); and what is compared with the
twin: `DS1` (BeamNG), `DS2` (Udacity) or `DSS`, both together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["sim", "real"]


@dataclass(frozen=True)
class PaperRow:
    """One row of the tables of RQ2 and RQ3.

    Attributes:
        r: Pearson correlation with the twin's failure probability.
        p: p-value of r; the paper gives most as powers of ten.
        auc: AUC-PRC.
    """

    r: float
    p: float
    auc: float


@dataclass(frozen=True)
class PaperErrors:
    """One row of the table of RQ1.

    Attributes:
        distance: Wasserstein distance of the error densities.
        p: p-value of the Wilcoxon test.
        powerful: whether the paper marks its power as above 0.8.
    """

    distance: float
    p: float
    powerful: bool = False


def _rows(*rows: tuple[float, float, float]) -> dict[str, PaperRow]:
    return {who: PaperRow(*row) for who, row in zip(("DS1", "DS2", "DSS"), rows, strict=True)}


def _errors(*rows: tuple[float, float] | tuple[float, float, bool]) -> dict[str, PaperErrors]:
    return {who: PaperErrors(*row) for who, row in zip(("DS1", "DS2", "DSS"), rows, strict=True)}


RQ1: dict[tuple[str, Kind], dict[str, PaperErrors]] = {
    ("dave2", "sim"): _errors((0.04669, 0.101), (0.02648, 0.020), (0.03776, 0.053, True)),
    ("dave2", "real"): _errors((0.03250, 0.011), (0.02187, 0.078), (0.00951, 0.088, True)),
    ("chauffeur", "sim"): _errors((0.03989, 0.023), (0.02641, 0.047), (0.01208, 0.394, True)),
    ("chauffeur", "real"): _errors((0.04625, 0.011), (0.02145, 0.078, True), (0.01843, 0.334, True)),
    ("epoch", "sim"): _errors((0.06030, 0.011), (0.01634, 0.078, True), (0.02726, 0.053, True)),
    ("epoch", "real"): _errors((0.03374, 0.016), (0.02318, 0.078, True), (0.00989, 0.256, True)),
}
RQ2: dict[tuple[str, Kind], dict[str, PaperRow]] = {
    ("dave2", "sim"): _rows((0.650, 1e-11, 0.654), (0.583, 1e-8, 0.512), (0.710, 1e-13, 0.684)),
    ("dave2", "real"): _rows((0.391, 1e-4, 0.403), (0.377, 1e-4, 0.306), (0.457, 1e-5, 0.398)),
    ("chauffeur", "sim"): _rows((0.733, 1e-16, 0.774), (0.588, 1e-10, 0.715), (0.700, 1e-14, 0.742)),
    ("chauffeur", "real"): _rows((0.417, 1e-4, 0.481), (0.337, 1e-3, 0.300), (0.422, 1e-4, 0.496)),
    ("epoch", "sim"): _rows((0.561, 1e-8, 0.599), (0.428, 1e-5, 0.604), (0.571, 1e-8, 0.622)),
    ("epoch", "real"): _rows((0.469, 1e-5, 0.586), (0.521, 1e-7, 0.565), (0.450, 1e-5, 0.641)),
}
RQ3: dict[tuple[str, Kind], dict[str, PaperRow]] = {
    ("dave2", "sim"): _rows((0.621, 1e-10, 0.659), (0.429, 1e-5, 0.496), (0.553, 1e-8, 0.659)),
    ("dave2", "real"): _rows((0.396, 1e-4, 0.513), (0.287, 1e-3, 0.351), (0.379, 1e-4, 0.626)),
    ("chauffeur", "sim"): _rows((0.798, 1e-21, 0.940), (0.625, 1e-11, 0.791), (0.792, 1e-21, 0.940)),
    ("chauffeur", "real"): _rows((0.399, 1e-4, 0.460), (0.260, 0.025, 0.359), (0.382, 1e-4, 0.460)),
    ("epoch", "sim"): _rows((0.511, 1e-7, 0.592), (0.355, 1e-4, 0.541), (0.491, 1e-6, 0.594)),
    ("epoch", "real"): _rows((0.554, 1e-8, 0.608), (0.389, 1e-3, 0.715), (0.529, 1e-7, 0.651)),
}
MEAN_SQUARED: dict[tuple[str, Kind], float] = {
    ("dave2", "sim"): 0.08,
    ("dave2", "real"): 0.07,
    ("chauffeur", "sim"): 0.07,
    ("chauffeur", "real"): 0.07,
    ("epoch", "sim"): 0.09,
    ("epoch", "real"): 0.07,
}
"""Mean squared steering error on the twin (4.2.2)."""
