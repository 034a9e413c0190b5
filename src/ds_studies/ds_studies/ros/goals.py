# SPDX-License-Identifier: Apache-2.0
"""What the orchestrator's goals ask, done with the engines of the command line."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ds_interfaces.action import RunCampaign
from rclpy.action.server import ServerGoalHandle

from ds_base.bounded_yaml import BoundedYamlError, load_yaml
from ds_base.config_errors import read_keys
from ds_base.installation import ds_command
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError, parse_config, rebase_paths
from ds_orchestrator.campaign.executor import StopSwitch
from ds_orchestrator.campaign.folder import config_of, open_store, with_kept_engine
from ds_orchestrator.engines.drive_tests import Callbacks, drive_tests
from ds_orchestrator.store.model import Test
from ds_sim.messages import road_from_message
from ds_sim.ros.conversions import conditions_from_messages
from ds_sim.ros.requests import GoalServer
from ds_sim.scenario import Scenario
from ds_studies.ros.campaign_view import StateListener, outcome_message
from ds_studies.whole_campaign import check_trust, run_campaign

ENGINES = tuple(getattr(RunCampaign.Goal, f"ENGINE_{name}") for name in ("ATTACH", "GRAPH", "LOCAL", "DASK", "AUTO"))
"""attach: nodes that run; the others start their own."""

Work = Callable[["Job", Collection[str]], None]
"""Drives what a goal asks, and fills in its result; takes the names that may run code of their own."""


@dataclass(kw_only=True)
class Job:
    """Goal that drives."""

    goal: ServerGoalHandle
    server: GoalServer
    folder: Path
    work: Work
    result: Any
    listener: StateListener
    stop: StopSwitch = field(default_factory=StopSwitch)


def run_campaign_goal(job: Job, trusted: Collection[str]) -> None:
    """Run or resume the campaign of a goal of `RunCampaign`, and fill in its result."""
    request = job.goal.request
    config = _config_of(request.config, job.folder, trusted)
    engine = request.engine or config.engine
    attach = engine == RunCampaign.Goal.ENGINE_ATTACH
    changed: dict[str, object] = (
        {"engine": "graph", "workers": 1}
        if attach
        else {"engine": engine, "workers": request.workers or config.workers}
    )
    if request.conditions and request.default_conditions:
        raise ConfigError("conditions, and default_conditions: expected one of both")
    if request.conditions or request.default_conditions:
        changed["conditions"] = conditions_from_messages(request.conditions)
    if request.seed:
        changed["seed"] = int(request.seed[0])
    result = run_campaign(
        parse_config(config.model_dump() | changed, "the goal", received=True),
        job.folder,
        job.listener,
        attach=attach,
        stop=job.stop,
    )
    job.result.report = str(result.report)
    job.result.executions, job.result.errors = result.executions, result.executions_in_error


def _config_of(text: str, folder: Path, trusted: Collection[str]) -> CampaignConfig:
    if not text:
        with closing(open_store(folder)) as store:
            config = with_kept_engine(folder, config_of(store))
    elif "\n" in text or ":" in text:
        try:
            raw = load_yaml(text, unique_keys=True)
        except BoundedYamlError as error:
            raise ConfigError(f"the goal's config: not YAML: {error}") from None
        config = parse_config(raw, "the goal's config", received=True)
    else:
        try:
            raw = rebase_paths(read_keys(Path(text), ConfigError), Path(text).parent, Path())
            config = parse_config(raw, text, received=True)
        except ConfigError:  # a goal that names a file does not get to read it
            check = f"check it with `{ds_command('campaign', 'run', text, '--dry-run')}`"
            raise ConfigError(f"{text!r:.200} is no configuration that can be read: {check}") from None
    check_trust(config, trusted)
    return config


def drive_tests_goal(job: Job, trusted: Collection[str]) -> None:
    """Drive what a goal of `DriveTests` lists, and fill in its result."""
    request = job.goal.request
    if not request.roads or not request.simulators or len(request.seeds) not in (0, len(request.roads)):
        raise ConfigError("expected at least one road and one simulator, and a seed for each road or none")
    names, attach = list(dict.fromkeys(request.simulators)), request.engine == RunCampaign.Goal.ENGINE_ATTACH
    # What a campaign of these may be, a list of tests may be: one check of names and numbers.
    raw = {
        "siblings": names,
        "twin": None,
        "driver": request.driver,
        "engine": "graph" if attach else request.engine or "local",
        "workers": request.workers or 1,
    }
    config = parse_config(raw, "the goal", received=True)
    check_trust(config, trusted)
    settings = config.drive_settings(attach=attach)
    conditions = conditions_from_messages(request.conditions)
    seeds = request.seeds or range(len(request.roads))
    tests = [
        Test(f"given-0-{number:04d}", Scenario(road_from_message(road), conditions, seed=seed))
        for number, (road, seed) in enumerate(zip(request.roads, seeds, strict=True))
    ]
    callbacks = Callbacks(listen=lambda: nullcontext(job.listener), stop=job.stop)
    results = drive_tests(settings, dict.fromkeys(settings.siblings, tests), job.folder, callbacks)
    for test in tests:
        for name in settings.siblings:
            key = (test.test_id, name)
            one = results.executions.get(key) or (results.gates.get(key) if key in results.excluded else None)
            message = outcome_message(request.folder, *key, one)
            if key in results.errors:
                message.message = str(results.errors[key])
            job.result.outcomes.append(message)
