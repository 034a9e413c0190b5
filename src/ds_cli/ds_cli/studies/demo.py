# SPDX-License-Identifier: Apache-2.0
"""`ds demo`: what this project does, with a shipped network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import typer

from ds_cli import options
from ds_cli.output import Result, ScreenProgress, say, stopped_in, verb

DEMO_WORKERS = 2
"""Graphs of the demo; chosen: with one, the twin drives alone at the end, on one core of two."""

app = typer.Typer()


@verb(app, "demo")
def demo_command(
    out: options.OutFolder = Path("demo"),
    *,
    driving: options.Driving,
) -> Result:
    """See where a shipped network fails, why, and what to do next.

    Drives one road in clear air and in fog, finds what else breaks the network, runs a campaign under these conditions,
    and writes its report.

    Example: ds demo --out demo
    """
    from ds_base.folder_files import make_folder
    from ds_base.installation import ds_command
    from ds_cli.campaign.run import campaign
    from ds_report.sensitivity_page import SensitivityPage
    from ds_studies import demo

    workers = driving.workers or DEMO_WORKERS
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
        sensitivity = demo.measure_sensitivity(fog, place, workers, progress=ScreenProgress(), watch=page.write)
    ranges = demo.searched(sensitivity)
    say(f"3 of 4: a campaign that searches roads and conditions: {demo.searched_in_words(ranges) or 'none broke it'}")
    config = demo.campaign_config(ranges, fog["siblings"])
    result = campaign(config.model_copy(update={"workers": workers, **driving.chosen()}), out)
    result.document["fog"], result.document["searched"] = fog, ranges

    answer = result.show

    def show() -> None:
        answer()
        print(f"4 of 4: open {out / 'report.html'}, which begins with the answer")
        print(f"   with your own network: {ds_command('check', 'my_net.onnx')}")

    return replace(result, show=show)
