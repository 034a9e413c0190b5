# SPDX-License-Identifier: Apache-2.0
"""`ds test`, `ds demo`, `ds campaign run, resume`: campaigns, from their configuration to their report."""

from __future__ import annotations

import tempfile
import time
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ds_base.folder_files import make_folder, write_whole
from ds_base.installation import ds_command
from ds_base.words import count, duration
from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, stopped, stopped_in, verb, warning
from ds_sim import registry

if TYPE_CHECKING:
    from ds_orchestrator.campaign.config import CampaignConfig
    from ds_orchestrator.engines.cluster import ClusterOptions
    from ds_studies.whole_campaign import CampaignOutcome

SIMULATORS = "bullet,softbody,donkey"
"""Those of `ds test`, and of `ds compare` for two networks, if it is not told otherwise."""

DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Only say how many drives, how long here and how much disk, from one drive.")
]

app = typer.Typer()
campaign_app = typer.Typer()


def campaign(
    config: CampaignConfig,
    out: Path,
    *,
    attach: bool = False,
    cluster: ClusterOptions | None = None,
    staged: bool = False,
) -> Result:
    """Run a campaign to its report, or resume it; staged: print a first answer from few tests, and go on."""
    from ds_cli.progress import ScreenListener
    from ds_orchestrator.campaign.folder import open_store
    from ds_orchestrator.campaign.status import driver_habits
    from ds_studies.whole_campaign import run_campaign

    started = time.monotonic()
    listener = ScreenListener()

    def first(outcome: CampaignOutcome) -> None:
        say(f"first answer after {duration(time.monotonic() - started)}, from {outcome.tests} of {config.tests} tests:")
        for line in filter(None, (outcome.answer.where, outcome.answer.believe, str(outcome.report))):
            say(f"  {line}")
        say("the test goes on, and replaces this answer")

    with stopped(lambda: _kept(out, listener.done)), listener:
        outcome = run_campaign(config, out, listener, attach=attach, cluster=cluster, first=first if staged else None)
    say(f"finished in {duration(time.monotonic() - started)}")
    with closing(open_store(out)) as store:
        for habit in driver_habits(store):
            say(warning(str(config.driver), habit))
    document = {
        "folder": str(out),
        "report": str(outcome.report),
        "executions": outcome.executions,
        "executions_in_error": outcome.executions_in_error,
        "correlations": [c.document() for c in outcome.correlations],
        "answer": asdict(outcome.answer),
    }

    def show() -> None:
        for sentence in filter(None, (outcome.answer.where, outcome.answer.believe, outcome.answer.next)):
            print(sentence)
        print(outcome.report)

    error = outcome.executions_in_error > 0
    return Result(document=document, show=show, error=error, next=outcome.answer.command)


def judged(result: Result, folder: Path, passing: options.CampaignCriteria, videos: Path | None = None) -> Result:
    """Check a finished campaign against pass criteria; write its outcomes as JUnit XML, and videos of failures."""
    if passing == options.CampaignCriteria() and videos is None:
        return result
    from ds_analysis.comparison.ci_results import cases_of_campaign, junit_of
    from ds_orchestrator.campaign.folder import read_folder

    data = read_folder(folder)
    if passing.junit is not None:
        write_whole(passing.junit, junit_of(str(data.config.driver), cases_of_campaign(data)))
    if videos is not None:
        from ds_studies.failure_videos import FailedDrive, write_failure_videos

        tests = {test.test_id: test for test in data.tests}
        lost = [(tests[one.test_id], one.simulator) for one in data.verdicts if one.outcome.is_failure]
        failed = [FailedDrive(test.test_id, name, test.scenario) for test, name in lost]
        write_failure_videos(data.driver, failed, videos)
    return replace(result, unmet=passing.criteria.unmet(data.failures))


def _kept(out: Path, done: int) -> str:
    if not (out / "campaign.sqlite").is_file():
        return ""
    finished = f"{done} finished execution{'s are' if done != 1 else ' is'} kept; " if done else ""
    return f"{finished}`{ds_command('campaign', 'resume', out)}` continues"


def stored_config(folder: Path, trust: list[str] | None) -> CampaignConfig:
    """Read the configuration of a campaign folder; the code that it names is shipped or trusted."""
    from ds_orchestrator.campaign.folder import config_of, open_store, with_kept_engine
    from ds_studies.whole_campaign import check_trust

    with closing(open_store(folder)) as store:
        config = with_kept_engine(folder, config_of(store))
    check_trust(config, trust or [])
    return config


@verb(app, "test")
def search_command(
    network: Annotated[
        str,
        typer.Argument(
            help="Network: a name, a .safetensors or .yaml file, or module:Class.",
            autocompletion=options.complete_driver,
        ),
    ],
    sims: Annotated[
        str,
        typer.Option(
            help=f"Siblings, then the twin, separated by commas: of {', '.join(registry.SIMULATORS)}; or none."
        ),
    ] = SIMULATORS,
    size: Annotated[str, typer.Option(help="Search: small, medium or paper.")] = "small",
    sensitivity: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Search the two most sensitive conditions of this `ds sensitivity --out`, too."
        ),
    ] = None,
    min_angle: Annotated[
        int | None, typer.Option(min=1, max=360, help="Degrees; larger: more winding roads, such as 200.")
    ] = None,
    max_angle: Annotated[
        int | None, typer.Option(min=1, max=360, help="Degrees; smaller: gentler roads, such as 60.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Campaign folder; NETWORK_test if left out. A test that was stopped there is resumed."),
    ] = None,
    *,
    driving: options.Driving,
    seed: Annotated[
        int, typer.Option(min=0, max=2**32 - 1, help="Seed of the search: another one drives other roads.")
    ] = 1,
    dry_run: DryRun = False,
    passing: options.CampaignCriteria,
) -> Result:
    """Search roads on which a network fails, and report where and why.

    A search makes roads on which the network drives badly on a sibling. All of them are then driven on every simulator.
    A first answer, from few of them, comes on standard error. The last line is the path of the HTML report;
    campaign.yaml in the folder is the configuration. It drives without ROS unless --engine says otherwise.

    Example: ds test my_net.yaml --out out
    """
    from ds_analysis.sensitivity import read_ranges
    from ds_base.bounded_file import read_words
    from ds_orchestrator.campaign.config import ConfigError, read_config, rebase_paths
    from ds_orchestrator.campaign.template import template
    from ds_orchestrator.engines.start import check_driver

    passing.check()
    names = options.simulators_of(sims.removesuffix(",none"), default=sims == SIMULATORS)
    check_driver(options.driver_named(network), names)
    siblings, twin = (names[:-1], names[-1]) if len(names) > 1 and not sims.endswith(",none") else (names, None)
    folder = out or Path(f"{registry.label_of(Path(network).stem or network)}_test")
    named = rebase_paths({"driver": network, "siblings": siblings, "twin": twin}, Path(), folder)
    ranges = read_ranges(sensitivity) if sensitivity else None
    text = template(**named, size=size, ranges=ranges, min_angle=min_angle, max_angle=max_angle, seed=seed)
    file = folder / "campaign.yaml"
    make_folder(folder)
    if file.exists() and read_words(file) != text:
        raise ConfigError(f"{folder} holds another test: choose another --out")
    write_whole(file, text)
    config = read_config(file).model_copy(update=driving.without_ros())
    if dry_run:
        following = ds_command("campaign", "run", file, "--out", folder, "--engine", config.engine)
        return _dry_run(config, folder, None, following)
    else:
        return judged(campaign(config, folder, staged=True), folder, passing)


@verb(campaign_app, "run")
def campaign_run_command(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.yaml", help="Configuration of the campaign.")],
    out: options.OutFolder,
    driver: Annotated[str | None, typer.Option(help="Network instead of the configuration's.")] = None,
    dry_run: DryRun = False,
    *,
    passing: options.CampaignCriteria,
    videos: options.Videos = None,
    driving: options.DrivingAnywhere,
    attach: options.AttachFlag = False,
) -> Result:
    """Run a campaign; resume it if the folder holds one with the same configuration.

    Example: ds campaign run my.yaml --out out --workers 2
    """
    from ds_orchestrator.campaign.config import ConfigError, read_config
    from ds_orchestrator.engines.start import check_driver

    passing.check()
    if dry_run and attach:
        raise ConfigError("--dry-run starts the engine itself: leave out --attach")
    changed = read_config(config).model_copy(update=driving.chosen())
    if driver:
        network = options.driver_named(driver)
        check_driver(network, changed.simulators, attach=attach)
        changed = changed.model_copy(update={"driver": network})
    if dry_run:
        following = ds_command("campaign", "run", config, "--out", out)
        return _dry_run(changed, out, driving.cluster_options(), following)
    else:
        result = campaign(changed, out, attach=attach, cluster=driving.cluster_options())
        return judged(result, out, passing, videos)


@verb(campaign_app, "resume")
def campaign_resume_command(
    folder: options.Folder,
    *,
    passing: options.CampaignCriteria,
    videos: options.Videos = None,
    driving: options.DrivingAnywhere,
    attach: options.AttachFlag = False,
    trust: options.Trust = None,
) -> Result:
    """Resume a campaign that was stopped; with any engine.

    Example: ds campaign resume out
    """
    passing.check()
    changed = stored_config(folder, trust).model_copy(update=driving.chosen())
    result = campaign(changed, folder, attach=attach, cluster=driving.cluster_options())
    return judged(result, folder, passing, videos)


def _dry_run(config: CampaignConfig, out: Path, cluster: ClusterOptions | None, following: str) -> Result:
    """Forecast a campaign from one drive on every simulator; nothing is written."""
    from ds_orchestrator.campaign.forecast import measure
    from ds_orchestrator.engines.start import preflight, running_engine

    settings = config.drive_settings(cluster=cluster)
    preflight(settings)
    say(f"{config.executions_at_most} drives at most; measuring one on {', '.join(config.simulators)} each")
    began = time.monotonic()
    with (
        tempfile.TemporaryDirectory(prefix="ds_forecast_") as logs,
        running_engine(settings, logs=Path(logs)) as engine,
    ):
        forecast = measure(config, engine, out, start_seconds=time.monotonic() - began)
    document = {
        **asdict(forecast),
        "engine": settings.engine,
        "workers": config.workers,
        "seconds": round(forecast.seconds, 1),
        "disk": forecast.disk,
    }

    def show() -> None:
        gates = f", and {forecast.gate_drives} of the autopilot for the gates" if forecast.gate_drives else ""
        workers = count(config.workers, "worker")
        print(f"{forecast.drives} drives at most{gates}, engine {settings.engine}, {workers}.")
        print(
            f"About {duration(forecast.seconds)} on this machine as it is now: "
            + ", ".join(f"{one.simulator} took {duration(one.seconds)}" for one in forecast.measured)
            + f" for one drive beside the others, and the engine {duration(forecast.start_seconds)} to start. "
            "Drives that fail are shorter."
        )
        print(f"About {_size(forecast.disk)} in {out}, report not included; {_size(forecast.free)} are free.")
        if forecast.disk > forecast.free:
            print("That does not fit: free some space, or set record: none.")

    return Result(document=document, show=show, next=following)


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


DEMO_WORKERS = 2
"""Graphs of the demo; chosen: with one, the twin drives alone at the end, on one core of two."""


@verb(app, "demo")
def demo_command(out: options.OutFolder = Path("demo"), *, driving: options.Driving) -> Result:
    """See where a shipped network fails, why, and what to do next.

    Drives one road in clear air and in fog, finds what else breaks the network, runs a campaign under these conditions,
    and writes its report.

    Example: ds demo --out demo
    """
    from ds_report.sensitivity_page import SensitivityPage
    from ds_studies import demo

    chosen = {"workers": DEMO_WORKERS} | driving.chosen()
    make_folder(out)
    say("1 of 4: one road, in clear air and in fog")
    fog = demo.drive_into_fog(out)
    say(f"   {demo.fog_in_words(fog)}\n   video: {out / 'fog.mp4'}")
    if fog["levels"] < demo.LEVELS:
        say(f"   this processor is slow: {fog['levels']} levels of strength instead of {demo.LEVELS}")
    place = out / "sensitivity"
    page = SensitivityPage(place / "sensitivity.html")
    say(f"2 of 4: what else breaks it? Open {page.path} in a browser: it fills while you watch")
    with stopped_in(place):
        sensitivity = demo.measure_sensitivity(
            fog, place, chosen["workers"], progress=ScreenProgress(), watch=page.write
        )
    ranges = demo.searched(sensitivity)
    say(f"3 of 4: a campaign that searches roads and conditions: {demo.searched_in_words(ranges) or 'none broke it'}")
    config = demo.campaign_config(ranges, fog["siblings"])
    result = campaign(config.model_copy(update=chosen), out)
    result.document["fog"], result.document["searched"] = fog, ranges

    def show() -> None:
        result.show()
        print(f"4 of 4: open {out / 'report.html'}, which begins with the answer")
        print(f"   with your own network: {ds_command('check', 'my_net.onnx')}")

    return replace(result, show=show)
