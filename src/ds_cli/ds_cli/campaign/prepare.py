"""`ds campaign init`, and `ds campaign run --dry-run`: before a campaign starts."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ds_cli.options import SHIPPED_SIMULATORS
from ds_cli.output import Interrupted, Result, duration, say

if TYPE_CHECKING:
    from ds_orchestrator.campaign.config import CampaignConfig
    from ds_orchestrator.engines.cluster import ClusterOptions

DRIVER, SIMULATORS, SIZE = "dave2", "bullet,softbody,donkey", "small"
"""Answers if somebody only presses Enter."""

campaign_app = typer.Typer()


def write_template(file: Path, driver: str, sims: str, size: str, *, force: bool) -> None:
    """Write a configuration; the last simulator is the twin if there are several.

    Raises:
        ds_orchestrator.campaign.config.ConfigError: the file exists, or an answer makes no campaign.
        ValueError: the driver cannot be used.
    """
    from ds_cli.options import simulators_of
    from ds_orchestrator.campaign.config import ConfigError
    from ds_orchestrator.campaign.template import template
    from ds_orchestrator.engines.preflight import check_driver

    if file.exists() and not force:
        raise ConfigError(f"{file} exists already: choose another file, or --force")
    names = simulators_of(sims)
    check_driver(driver, names)
    siblings, twin = (names[:-1], names[-1]) if len(names) > 1 else (names, None)
    file.write_text(template(driver, siblings, twin, size), "utf-8")


@campaign_app.command("init")
def campaign_init_command(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="Configuration to write.")] = Path("campaign.yaml"),
    driver: Annotated[
        str | None, typer.Option(help="Network: a name, a .safetensors or .yaml file, or module:Class.")
    ] = None,
    sims: Annotated[
        str | None,
        typer.Option(help=f"Siblings, then the twin, separated by commas: of {', '.join(SHIPPED_SIMULATORS)}."),
    ] = None,
    size: Annotated[str | None, typer.Option(help="Search: small, medium or paper.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file.")] = False,
) -> None:
    """Write a commented configuration for a network, after three questions or from three options.

    Without a terminal nothing is asked, and what is left out takes the value that Enter would give.
    """
    ask = sys.stdin.isatty()
    driver = driver or (typer.prompt("Network", DRIVER, err=True) if ask else DRIVER)
    sims = sims or (typer.prompt("Simulators: siblings, then the twin", SIMULATORS, err=True) if ask else SIMULATORS)
    size = size or (typer.prompt("Search: small, medium or paper", SIZE, err=True) if ask else SIZE)
    write_template(file, driver, sims, size, force=force)
    print(file)
    say(f"next: ds campaign run {shlex.quote(str(file))} --out {shlex.quote(file.stem)} --dry-run")


def dry_run(config: CampaignConfig, out: Path, cluster: ClusterOptions) -> Result:
    """Forecast a campaign from one drive on every simulator; nothing is written.

    Raises:
        Interrupted: the user stopped it.
    """
    import tempfile
    import time

    from ds_orchestrator.campaign.forecast import measure
    from ds_orchestrator.engines.preflight import preflight
    from ds_orchestrator.engines.start import running_engine

    settings = config.drive_settings(cluster=cluster)
    preflight(settings)
    say(f"{config.executions_at_most} drives at most; measuring one on {', '.join(config.simulators)} each")
    began = time.monotonic()
    try:
        with (
            tempfile.TemporaryDirectory(prefix="ds_forecast_") as logs,
            running_engine(settings, logs=Path(logs), say=say) as engine,
        ):
            found = measure(config, engine, out, start_seconds=time.monotonic() - began)
    except KeyboardInterrupt:
        raise Interrupted from None
    document = {
        **asdict(found),
        "engine": config.engine,
        "workers": config.workers,
        "seconds": round(found.seconds, 1),
        "disk": found.disk,
    }

    def show() -> None:
        gates = f", and {found.gate_drives} of the autopilot for the gates" if found.gate_drives else ""
        workers = f"{config.workers} worker{'' if config.workers == 1 else 's'}"
        print(f"{found.drives} drives at most{gates}, engine {config.engine}, {workers}.")
        print(
            f"About {duration(found.seconds)} on this machine as it is now: "
            + ", ".join(f"{one.simulator} took {duration(one.seconds)}" for one in found.measured)
            + f" for one drive beside the others, and the engine {duration(found.start_seconds)} to start. "
            "Drives that fail are shorter."
        )
        print(f"About {_size(found.disk)} in {out}, report not included; {_size(found.free)} are free.")
        if found.disk > found.free:
            print("That does not fit: free some space, or set record: none.")

    return Result(document=document, show=show)


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"
