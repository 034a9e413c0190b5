# SPDX-License-Identifier: Apache-2.0
"""`ds campaign`, `test`, `compare`, `suite`, `watch` and `report`: collected from this folder."""

from __future__ import annotations

import typer

from ds_cli.campaign import compare, inspection, run, suites

app = typer.Typer()
campaign_app = typer.Typer(help="Run, resume and inspect campaigns.", no_args_is_help=True)
for part in (run.campaign_app, inspection.campaign_app):
    campaign_app.add_typer(part)
app.add_typer(campaign_app, name="campaign")
for part in (run.app, inspection.app, compare.app, suites.app):
    app.add_typer(part)
