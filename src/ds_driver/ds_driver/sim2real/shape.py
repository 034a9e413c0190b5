"""Size of a generator, known without PyTorch."""

from __future__ import annotations

from dataclasses import dataclass

EPSILON = 1e-5
"""Added to the variance of an instance normalisation (PyTorch's default)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorShape:
    """Size of a generator.

    Attributes:
        filters: channels of the first layer (paper: 64).
        blocks: residual blocks (paper: 9).
        rows: rows of the image, a multiple of 4.
        columns: columns of the image, a multiple of 4.
    """

    filters: int
    blocks: int
    rows: int
    columns: int

    @property
    def size(self) -> tuple[int, int]:
        """Return rows and columns."""
        return self.rows, self.columns
