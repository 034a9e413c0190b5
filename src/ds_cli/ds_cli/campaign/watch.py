"""`ds watch`: a page that shows a campaign while it runs."""

from __future__ import annotations

from typing import Annotated

import typer

from ds_cli.options import Folder, Trust
from ds_cli.output import say

app = typer.Typer()


@app.command("watch")
def watch_command(
    folder: Folder,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of this machine's loopback interface; 0 for any free one.")
    ] = 8760,
    trust: Trust = None,
) -> None:
    """Show a campaign in the browser while it runs.

    What runs now, the latest drives with camera and trajectory, the feature maps filling up, progress and time left.
    The page is served to this machine only. The campaign's folder stays as it is, whatever engine writes it.
    """
    import asyncio

    from ds_report.watch.server import serve

    def ready(address: str) -> None:
        print(address, flush=True)
        say(f"shows {folder}, until Ctrl-C")

    asyncio.run(serve(folder, port=port, trusted=trust or (), ready=ready))
