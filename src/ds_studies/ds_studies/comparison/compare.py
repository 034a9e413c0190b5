"""Drives what two networks lack on the same tests, and compares them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from ds_analysis.comparison.analysis import Comparison, Origin, compare_networks
from ds_analysis.comparison.drives import ComparedTest, ComparisonError, DriveOutcome, Network, PairedDrive
from ds_driver.networks.pilot import DriverError
from ds_orchestrator.engines.drive_tests import GivenDrives, Key, Progress, drive_tests
from ds_orchestrator.store.model import Execution, Test
from ds_studies.comparison.compared_tests import Drives, GivenTests

Role = Literal["reference", "candidate"]


def compare(
    sets: Sequence[GivenTests],
    reference: Network,
    candidate: Network,
    *,
    origin: Origin,
    source: str,
    out: Path,
    progress: Progress,
    recheck: bool = True,
) -> Comparison:
    """Compare two networks on given tests; drives that are not known are driven.

    Args:
        sets: tests, all of one configuration apart from the driver.
        reference: the network that is known.
        candidate: the network that may replace it.
        origin: how the tests were chosen.
        source: where they come from, in words.
        out: folder for the drives; a comparison that was stopped goes on there.
        progress: who hears of it.
        recheck: drive one known test again on each simulator, to find out whether drives are repeatable here.

    Raises:
        ComparisonError: a known drive does not come out the same again.
    """
    pairs: list[PairedDrive] = []
    left_out: list[tuple[str, str, str]] = []
    excluded = 0
    checked: set[Role] = set()
    for tests in sets:
        sides: dict[Role, GivenDrives] = {}
        roles: tuple[tuple[Role, Network, Drives], ...] = (
            ("reference", reference, tests.reference),
            ("candidate", candidate, tests.candidate),
        )
        for role, network, known in roles:
            if recheck and known and role not in checked:
                checked.add(role)
                _recheck(tests, role, network, known, out, progress)
            sides[role] = _complete(tests, role, network, known, out, progress)
        known_excluded = {key for key, gate in tests.gates.items() if not gate.is_valid}
        excluded += len(known_excluded | sides["reference"].excluded | sides["candidate"].excluded)
        found, missing = _paired(tests, sides)
        pairs += found
        left_out += missing
    settings = sets[0].settings
    return compare_networks(
        pairs,
        reference=reference,
        candidate=candidate,
        origin=origin,
        source=source,
        simulators=settings.simulators,
        features=sets[0].features,
        twin=settings.twin,
        excluded=excluded,
        left_out=left_out,
    )


def _complete(
    tests: GivenTests, role: Role, network: Network, known: Drives, out: Path, progress: Progress
) -> GivenDrives:
    """Known drives, and those that are driven now."""
    missing = {name: [test for test in of if (test.test_id, name) not in known] for name, of in tests.work.items()}
    missing = {name: of for name, of in missing.items() if of}
    if not missing:
        return GivenDrives(executions=known)
    if network.sha256 and (reason := _cannot_drive(network)):
        raise ComparisonError(
            f"{network.driver} has to drive {sum(map(len, missing.values()))} tests, but {reason}: restore it, or "
            "compare its campaign with a network, as in `ds campaign compare A --driver B`"
        )
    settings = replace(tests.settings, driver=network.driver)
    progress.say(f"{role} {network.driver}: {sum(map(len, missing.values()))} drives")
    found = drive_tests(settings, missing, out / "drives" / f"{role}_on_{tests.name}", progress, gates=tests.gates)
    return GivenDrives(
        executions={**known, **found.executions}, gates=found.gates, errors=found.errors
    )  # fmt: skip


def _recheck(tests: GivenTests, role: Role, network: Network, known: Drives, out: Path, progress: Progress) -> None:
    """Drive the shortest known test of each simulator again: its outcome counts only if it is repeatable here.

    The known outcomes of a network whose files have changed or are gone are taken as they are.
    """
    settings = replace(tests.settings, driver=network.driver)
    work: dict[str, list[Test]] = {}
    for name, of in tests.work.items():
        driven = [test for test in of if (test.test_id, name) in known]
        if driven:
            work[name] = [min(driven, key=lambda test: (known[test.test_id, name].steps, test.test_id))]
    if reason := _cannot_drive(network):
        progress.say(f"{role} {network.driver}: its known outcomes were not checked: {reason}")
        return
    progress.say(f"{role} {network.driver}: drives one known test on each simulator again, to check that it repeats")
    found = drive_tests(settings, work, out / "drives" / f"{role}_again_{tests.name}", progress, gates=tests.gates)
    for key, execution in found.executions.items():
        if execution.trajectory_sha256 != known[key].trajectory_sha256:
            raise ComparisonError(
                f"{network.driver} drives test {key[0]} on {key[1]} differently than before: the simulators' code or "
                "this machine has changed, so old and new outcomes do not compare; --again drives the reference again"
            )


def _cannot_drive(network: Network) -> str:
    """Why a network cannot be driven as it was; "" if it can."""
    from ds_driver.control.autopilot import AUTOPILOT
    from ds_driver.networks.network_driver import driver_sha256

    if network.driver == AUTOPILOT:
        return ""
    try:
        return "" if driver_sha256(network.driver) == network.sha256 else "its files have changed since"
    except (DriverError, ValueError, OSError) as error:
        return " ".join(str(error).split())


def _paired(
    tests: GivenTests, sides: Mapping[Role, GivenDrives]
) -> tuple[list[PairedDrive], list[tuple[str, str, str]]]:
    """Pairs with a verdict of both, and pairs that lack one by an error."""
    pairs, left_out = [], []
    for name, of in tests.work.items():
        for test in of:
            key: Key = (test.test_id, name)
            compared = ComparedTest(
                name=tests.prefix + test.test_id,
                road=test.road,
                seed=test.seed,
                conditions=test.conditions,
                cell=tests.cells.get(test.test_id),
                unsearched=test.test_id in tests.unsearched,
            )
            both: dict[Role, Execution] = {
                role: side.executions[key] for role, side in sides.items() if key in side.executions
            }
            errors = [f"{role}: {side.errors[key]}" for role, side in sides.items() if key in side.errors]
            if len(both) == len(sides):
                reference, candidate = (DriveOutcome.of(both[role]) for role in ("reference", "candidate"))
                pairs.append(PairedDrive(test=compared, simulator=name, reference=reference, candidate=candidate))
            elif errors:
                left_out.append((compared.name, name, "; ".join(errors)))
    return pairs, left_out
