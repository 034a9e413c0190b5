"""Steering errors of a driver on recorded images: their size, their density, and how far apart two groups' are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wasserstein_distance

from ds_orchestrator.evaluation.open_loop import Answers

Array = NDArray[np.float64]
BINS = np.linspace(-2.0, 2.0, 201)
"""Edges of the density's bins: every possible error, in steps of 0.02; chosen: a hundredth of the range of steering."""


@dataclass(frozen=True, kw_only=True)
class ErrorSummary:
    """One group of recordings.

    Attributes:
        group: its name.
        images: that were shown.
        answered: of them that were answered.
        compared: of them that have a steering to compare with.
        mean: of the errors, positive to the right; None without errors, as the next four.
        mean_absolute: mean size.
        root_mean_square: of the errors.
        median_absolute: median size.
        largest: size of the largest.
        outputs_apart: Wasserstein distance between answered and recorded steering as distributions.
    """

    group: str
    images: int
    answered: int
    compared: int
    mean: float | None
    mean_absolute: float | None
    root_mean_square: float | None
    median_absolute: float | None
    largest: float | None
    outputs_apart: float | None


def pooled_errors(answers: Sequence[Answers]) -> dict[str, Array]:
    """Group -> the errors of its recordings one after the other; groups without errors are left out."""
    groups: dict[str, list[Array]] = {}
    for one in answers:
        groups.setdefault(one.group, []).append(one.errors)
    pooled = {group: np.concatenate(parts) for group, parts in groups.items()}
    return {group: errors for group, errors in pooled.items() if errors.size}


def summarise(answers: Sequence[Answers]) -> list[ErrorSummary]:
    """Each group in the order of its first recording."""
    return [
        _summary(group, [a for a in answers if a.group == group]) for group in dict.fromkeys(a.group for a in answers)
    ]


def _summary(group: str, answers: Sequence[Answers]) -> ErrorSummary:
    errors = np.concatenate([one.errors for one in answers])
    recorded = np.concatenate([one.recorded for one in answers])
    answered = np.concatenate([one.answered for one in answers])
    both = np.isfinite(recorded) & np.isfinite(answered)
    size = np.abs(errors)
    known = bool(errors.size)
    return ErrorSummary(
        group=group,
        images=sum(one.images for one in answers),
        answered=int(np.isfinite(answered).sum()),
        compared=int(errors.size),
        mean=float(errors.mean()) if known else None,
        mean_absolute=float(size.mean()) if known else None,
        root_mean_square=float(np.sqrt(np.mean(errors**2))) if known else None,
        median_absolute=float(np.median(size)) if known else None,
        largest=float(size.max()) if known else None,
        outputs_apart=float(wasserstein_distance(answered[both], recorded[both])) if known else None,
    )


def density(errors: Array) -> Array:
    """(200,) share of the errors in each of `BINS` over the bin's width, so that the area is 1 (paper 4.3.1)."""
    return np.asarray(np.histogram(errors, BINS, density=True)[0], np.float64)


def distances(errors: Mapping[str, Array]) -> list[tuple[str, str, float]]:
    """Wasserstein distance between the errors themselves, without bins, of every two groups; in units of steering."""
    return [(one, two, float(wasserstein_distance(errors[one], errors[two]))) for one, two in combinations(errors, 2)]
