from .evidence import CellEvidence, evidence_of
from .refine import Refinement, refine

__all__ = ["CellEvidence", "Refinement", "evidence_of", "refine"]
