"""Options for continuous integration: pass criteria, JUnit and Markdown, and how they end a verb."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from ds_analysis.comparison.analysis import Comparison
    from ds_analysis.comparison.ci_results import Criteria
    from ds_orchestrator.campaign.folder import CampaignData

FailOn = Annotated[
    Literal["failure", "regression", "worse"] | None,
    typer.Option(
        help="Exit with 3 if any test fails (failure), if any newly fails (regression), or if the network is "
        "significantly worse on some simulator (worse)."
    ),
]
FailOnFailure = Annotated[Literal["failure"] | None, typer.Option(help="Exit with 3 if the driver fails on any test.")]
MaxFailures = Annotated[
    str | None,
    typer.Option(metavar="N|P%", help="Exit with 3 if more tests fail on some simulator, such as 5% or 3."),
]
Junit = Annotated[Path | None, typer.Option(metavar="FILE.xml", help="JUnit XML to write.")]
Markdown = Annotated[
    Path | None, typer.Option(metavar="FILE.md", help="Markdown summary to write, for a pull request.")
]


def criteria_of(fail_on: str | None, max_failures: str | None, *, has_reference: bool) -> Criteria:
    """The pass criteria that the options describe.

    Raises:
        ds_orchestrator.campaign.config.ConfigError: a threshold makes no sense.
    """
    from ds_analysis.comparison.ci_results import Criteria
    from ds_analysis.comparison.ci_results import MaxFailures as Limit

    limit = None if max_failures is None else Limit.parse(max_failures)
    criteria = Criteria(fail_on=fail_on, max_failures=limit)  # type: ignore[arg-type]
    criteria.check(has_reference=has_reference)
    return criteria


def unmet_by(criteria: Criteria, comparison: Comparison) -> list[str]:
    """Criteria that a comparison does not meet."""
    return criteria.unmet(
        comparison.tally(),
        newly_failing=len(comparison.newly_failing),
        worse=[row.simulator for row in comparison.simulators if row.verdict == "worse"],
    )


def unmet_in_campaign(criteria: Criteria, data: CampaignData) -> list[str]:
    """Criteria that a campaign does not meet."""
    tally = {}
    for name in data.config.simulators:
        failed = [one.outcome.is_failure for one in data.verdicts if one.simulator == name]
        tally[name] = (sum(failed), len(failed))
    return criteria.unmet(tally)


def check_writable(*paths: Path | None) -> None:
    """Refuse files that could not be written at the end, before anything is driven.

    Raises:
        OSError: a folder is missing, or the file is a folder.
    """
    for path in paths:
        if path is not None and path.is_dir():
            raise IsADirectoryError(21, "is a folder, expected a file to write", str(path))
        if path is not None and not path.absolute().parent.is_dir():
            raise FileNotFoundError(2, "there is no such folder: create it first", str(path.absolute().parent))
