# SPDX-License-Identifier: Apache-2.0
"""The typer application behind `ds`: imports each verb when it is typed, and turns every error into one line."""

from __future__ import annotations

import errno
import shlex
import sqlite3
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from tempfile import NamedTemporaryFile
from typing import Any

import typer
from typer import completion, core
from typer.core import TyperGroup
from typer.main import get_group

from ds_base.errors import DsError, RunError
from ds_base.progress import lines_to
from ds_base.words import did_you_mean
from ds_cli.output import Interrupted, say
from ds_cli.verbs import COMPLETION_VARIABLE, PACKAGE, VERBS, overview
from ds_orchestrator.graph import signals

_UsageError: Any = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "UsageError")


BUG = 70
"""Exit status of a bug of ours: EX_SOFTWARE of BSD's sysexits."""
DEBUG = "--debug"
"""Before or after any verb: print the traceback of a bug, too."""


class LazyGroup(TyperGroup):
    """Every verb of `ds`; the module of one is imported when it is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of all verbs."""
        return list(VERBS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Import a verb; None if there is none of this name."""
        verb = VERBS.get(cmd_name)
        if verb is None or not verb.module:
            return None
        module = import_module(f"{PACKAGE}.{verb.module}")
        if not verb.verbs:
            return _with_joined_lines(get_group(module.app).commands[cmd_name])
        group = get_group(getattr(module, f"{cmd_name}_app"))
        group.name, group.help, group.no_args_is_help = cmd_name, verb.summary, True
        return _with_joined_lines(group)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the verb that was typed, or name the nearest one."""
        if args[0] not in VERBS:
            ctx.fail(f"unknown verb {args[0]!r}{did_you_mean(args[0], VERBS)}")
        return super().resolve_command(ctx, args)

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Candidates for the verb, without importing any."""
        item = core.CompletionItem  # type: ignore[attr-defined]
        return [item(name, help=verb.summary) for name, verb in VERBS.items() if name.startswith(incomplete)]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the overview."""
        print(overview())


def _with_joined_lines(command: Any) -> Any:
    """Let the terminal's width break the lines of a help text, not those of the docstring."""
    paragraphs = (command.help or "").split("\n\n")
    command.help = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
    for one in getattr(command, "commands", {}).values():
        _with_joined_lines(one)
    return command


def make_app() -> TyperGroup:
    """The application."""
    app = LazyGroup(name="ds", context_settings={"help_option_names": ["-h", "--help"]})
    completion.completion_init()  # type: ignore[attr-defined]
    return app


def run(arguments: Sequence[str]) -> int:
    """Run a verb, and return the exit status."""
    try:
        with lines_to(say):
            status = make_app().main(
                args=[one for one in arguments if one != DEBUG],
                prog_name="ds",
                complete_var=COMPLETION_VARIABLE,
                standalone_mode=False,
            )
        sys.stdout.flush()
    except _UsageError as error:
        # A verb such as `bag` without another one has printed its help already.
        return 2 if type(error).__name__ == "NoArgsIsHelpError" else _fail(_usage_problem(error), 2)
    except Interrupted as stopped:
        return _stopped(str(stopped))
    except (KeyboardInterrupt, typer.Abort):
        return _stopped("")
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        sys.stdout = None  # type: ignore[assignment]
        return 0
    except RunError as error:
        return _fail(_one_line(error), 1)
    except (DsError, OSError, sqlite3.Error) as error:
        return _fail(_one_line(error), 2)
    except RecursionError:
        return _fail("a file is nested too deeply: expected a few levels", 2)
    except ModuleNotFoundError as error:  # an extra of the wheel, or an incomplete installation
        from ds_base.installation import missing_module

        return _fail(missing_module(str(error.name)), 1)
    except Exception as error:
        return _bug(error, arguments)
    if status == 130:  # typer's answer to an interruption
        return _stopped("")
    return status if isinstance(status, int) else 0


def _fail(problem: str, status: int) -> int:
    print(f"error: {problem}", file=sys.stderr)
    return status


def _bug(error: Exception, arguments: Sequence[str]) -> int:
    """Keep the traceback of what no user can have caused, and say where."""
    from ds_base.installation import versions

    text = "".join(traceback.format_exception(error))
    if DEBUG in arguments:
        print(text, file=sys.stderr, end="")
    with NamedTemporaryFile("w", prefix="ds-bug-", suffix=".log", delete=False) as log:
        log.write(f"ds {shlex.join(arguments)}\n{versions()}\n\n{text}")
    return _fail(f"this is a bug of ds ({type(error).__name__}), not of your input: please report {log.name}", BUG)


def _stopped(kept: str) -> int:
    print(f"stopped{': ' if kept else ''}{kept}", file=sys.stderr)
    return signals.exit_status()


def _one_line(error: BaseException) -> str:
    text: Any = error.strerror if isinstance(error, OSError) and error.strerror else error
    where = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    advice = ": free some space, then run the same command again" if full else ""
    return f"{where}{' '.join(str(text).split())}{advice}"


def _usage_problem(error: Any) -> str:
    """What is wrong with the arguments, and for a missing one what it takes, in one line."""
    context = error.ctx
    path = context.command_path if context is not None else "ds"
    problem = " ".join(error.format_message().split()).rstrip(".")
    parameter = getattr(error, "param", None)
    takes = getattr(parameter, "help", None) if type(error).__name__ == "MissingParameter" else None
    if takes:
        problem += f" ({takes.rstrip('.')})"
    return f"{path}: {problem[:1].lower()}{problem[1:]}; see {path} --help"
