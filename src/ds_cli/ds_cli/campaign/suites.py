# SPDX-License-Identifier: Apache-2.0
"""`ds suite`: freezes the most informative tests of a campaign, and drives them with another network in minutes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from ds_base.installation import ds_command
from ds_cli import options
from ds_cli.campaign.compare import network_named, write_comparison
from ds_cli.output import Result, say, stopped_in, verb

suite_app = typer.Typer()


@verb(suite_app, "make")
def suite_make_command(
    folder: options.Folder,
    out: Annotated[Path, typer.Option(metavar="SUITE.json", help="File to write.")] = Path("suite.json"),
    tests: Annotated[int, typer.Option(min=1, max=2000, help="Largest number of tests.")] = 30,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file.")] = False,
) -> Result:
    """Freeze the most informative tests of a campaign: failing ones, boundary ones, and one of every cell.

    The file holds their roads with digests, seeds, conditions, and the outcomes of the campaign's network.

    Example: ds suite make out --out suite.json
    """
    from ds_base.words import count
    from ds_orchestrator.campaign.folder import read_folder
    from ds_orchestrator.search.features import feature_of
    from ds_studies.suite_file import SuiteError, suite_of, write_suite

    options.check_writable(out)
    if out.exists() and not force:
        raise SuiteError(f"{out} exists already: choose another --out, or --force")
    data = read_folder(folder)
    suite = suite_of(folder, data, most=tests)
    write_suite(suite, out)
    reasons = [reason for test in suite.tests for reason in test.why]
    counts = {reason: reasons.count(reason) for reason in ("failing", "boundary", "cell")}
    drives = sum(len(test.outcomes) for test in suite.tests)
    document = {"suite": str(out), "tests": len(suite.tests), "drives": drives, "why": counts}

    def show() -> None:
        axes = [feature_of(name) for name in suite.features]
        table = Table("test", "why", "cell", *suite.simulators)
        for test in suite.tests:
            bins = zip(axes, test.cell or (), strict=False)
            cell = ",".join(axis.label(bin_) for axis, bin_ in bins)
            outcomes = (f"{test.outcomes[name].fitness:+.2f} m" for name in suite.simulators)
            table.add_row(test.name, ", ".join(test.why), cell, *outcomes)
        Console().print(table)
        sizes = f"{count(len(suite.tests), 'test')}, {count(drives, 'drive')}"
        print(f"{sizes}, with the margins of {suite.driver}; below 0 it fails.")
        print(out)

    following = ds_command("suite", "run", out, suite.driver)
    return Result(document=document, show=show, next=following)


@verb(suite_app, "run")
def suite_run_command(
    suite: Annotated[Path, typer.Argument(metavar="SUITE.json", help="Suite of `ds suite make`.")],
    driver: options.DriverText,
    backend: options.Backend = "auto",
    out: Annotated[
        Path, typer.Option(help="Folder for drives and results; a run that was stopped there is resumed.")
    ] = Path("suite_run"),
    stop_early: Annotated[
        bool, typer.Option("--stop-early", help="End as soon as --fail-on or --max-failures cannot be met any more.")
    ] = False,
    *,
    passing: options.ComparisonCriteria,
    videos: options.Videos = None,
    update: Annotated[
        Path | None,
        typer.Option(metavar="SUITE.json", help="Write the suite with this network's outcomes, to be expected now."),
    ] = None,
    driving: options.DrivingAnywhere,
    trust: options.Trust = None,
) -> Result:
    """Drive a suite's tests with a network, and compare with the outcomes in the suite.

    It drives without ROS unless --engine says otherwise. Exit status: 0 done, 1 a drive ended in an error, 2 bad input,
    3 a pass criterion is not met.

    Example: ds suite run suite.json --driver next.yaml --out suite_run --fail-on regression
    """
    from ds_base.folder_files import make_folder
    from ds_cli.progress import ScreenListener
    from ds_orchestrator.engines.drive_tests import Callbacks
    from ds_orchestrator.engines.fingerprint import code_sha256
    from ds_sim.registry import received_simulator
    from ds_studies import suite_file
    from ds_studies.comparison import BATCH
    from ds_studies.failure_videos import FailedDrive, write_failure_videos

    network = options.driver_named(driver, backend)
    passing.check(passing.markdown, update)
    if stop_early and (update is not None or (passing.fail_on in (None, "worse") and passing.max_failures is None)):
        raise suite_file.SuiteError(
            "--stop-early needs --fail-on failure or regression, or --max-failures, and no --update"
        )
    tests = suite_file.read_suite(suite)
    for name in tests.simulators:
        received_simulator(name, confirmed=trust or [])
    candidate = network_named(network, tests.simulators)
    code = code_sha256()
    source = f"The {len(tests.tests)} tests of the suite {suite.name} on {', '.join(tests.simulators)}"
    if tests.code_sha256 != code:
        say("the simulators' code has changed since the suite was made: some outcomes may have changed with it")
        source += ", made with other code of the simulators"
    make_folder(out)
    settings = replace(suite_file.settings_of_suite(tests, network), **driving.without_ros())
    of_simulator = {name: sum(name in one.outcomes for one in tests.tests) for name in tests.simulators}
    sizes = [*range(BATCH, len(tests.tests), BATCH)] if stop_early else []
    for last in [*sizes, len(tests.tests)]:
        some = tests.model_copy(update={"tests": tests.tests[:last]})
        with stopped_in(out):
            comparison, executions = suite_file.run_suite(
                some, settings, candidate, out / "drives", Callbacks(listen=ScreenListener), source=source
            )
        # Whatever the outcomes of the remaining tests: so many of all fail already.
        failing = {name: (count, of_simulator[name]) for name, (count, _) in comparison.tally().items()}
        if last in sizes and passing.criteria.unmet(failing, newly_failing=len(comparison.newly_failing)):
            say(f"ended after {last} of {len(tests.tests)} tests: a pass criterion cannot be met any more")
            break
    if update is not None and not comparison.left_out:
        suite_file.write_suite(suite_file.with_outcomes(tests, candidate, executions, code), update)
        say(f"{update} expects the outcomes of {network}")
    following = ds_command("test", network)
    result = write_comparison(comparison, out, passing, following)
    if videos is not None:
        lost = [one for one in comparison.drives if one.candidate.outcome.is_failure]
        failed = [FailedDrive(d.test.name, d.simulator, d.test.scenario) for d in lost if d.test.scenario is not None]
        write_failure_videos(network, failed, videos)
    return result
