"""The command `ds`: every verb of the project, for people and for programs.

Results go to standard output, with `--json` as one JSON document and nothing else; everything else goes to standard
error. Exit status: 0 done, 1 a run ended in an error, 2 bad input.
"""

from __future__ import annotations

import errno
import sqlite3
import sys
from typing import Any

import typer

from ds_orchestrator.cli.output import Interrupted
from ds_orchestrator.graph import signals as stopping


def make_app() -> typer.Typer:
    """Every verb; what they import takes a second or more, in which Ctrl-C is understood already."""
    from ds_orchestrator.cli import bags, campaigns, drives, evaluations, networks, roads, siblings, twin

    app = typer.Typer(
        help="Test a driving network on digital siblings.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    for part in (campaigns, evaluations, drives, bags, roads, networks, siblings, twin):
        app.add_typer(part.app)
    return app


def _one_line(error: BaseException) -> str:
    text: Any = error.strerror if isinstance(error, OSError) and error.strerror else error
    where = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    advice = ": make room, and give the same command again" if full else ""
    return f"{where}{' '.join(str(text).split())}{advice}"


def _end_stopped() -> None:
    print("stopped: what was finished is kept, the same command goes on from there", file=sys.stderr)
    sys.exit(stopping.exit_status())


def main() -> None:
    """Run `ds`; whatever goes wrong ends in one line on standard error."""
    stopping.listen()
    try:
        make_app()(prog_name="ds")
    except (Interrupted, KeyboardInterrupt):
        _end_stopped()
    except SystemExit as end:
        if end.code == 130:  # typer's answer to an interruption
            _end_stopped()
        raise
    except (ValueError, OSError, sqlite3.Error) as error:
        print(f"error: {_one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except RuntimeError as error:
        print(f"error: {_one_line(error)}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
