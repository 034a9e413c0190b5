# SPDX-License-Identifier: Apache-2.0
"""The verbs of `ds`: the overview that `ds --help` prints, and tab completion.

Standard library only: both have to work before anything is installed, and at once. The completion scripts ask `ds`
itself for candidates, through the protocol of typer: `_DS_COMPLETE` names the shell.
"""

from __future__ import annotations

import os
import shlex
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

PACKAGE = "ds_cli"


class Verb(NamedTuple):
    """A verb: its module in this package, the first line of its help text, and the verbs within one such as `bag`.

    The module has the verb in `app`, or the verbs within it in `NAME_app`.
    """

    name: str
    module: str
    summary: str
    within: str = ""

    @property
    def verbs(self) -> tuple[str, ...]:
        """The verbs within it, in order."""
        return tuple(self.within.split())


GROUPS: dict[str, tuple[Verb, ...]] = {
    "Your network": (
        Verb("check", "diagnosis", "Show what a network sees, and say what is wrong with how it is connected."),
        Verb("drive", "drives", "Drive one road with one driver on one simulator."),
        Verb("test", "campaign.run", "Search roads on which a network fails, and report where and why."),
        Verb("sensitivity", "diagnosis", "Find how strong each operating condition must be for a driver to fail."),
        Verb("compare", "campaign.compare", "Compare two networks on the same tests: what got worse, what got better?"),
        Verb("report", "campaign.inspection", "Rebuild the report of a campaign, or write one of imported outcomes."),
    ),
    "Campaigns and suites": (
        Verb("demo", "campaign.run", "See where a shipped network fails, why, and what to do next."),
        Verb("campaign", "campaign.inspection", "Run, resume and inspect campaigns.", "run resume status roads export"),
        Verb("watch", "campaign.inspection", "Show a campaign in the browser while it runs."),
        Verb("suite", "campaign.suites", "Freeze tests into a regression suite, and run it.", "make run"),
        Verb("explain", "diagnosis", "Find out why tests of a campaign fail."),
        Verb("maps", "maps", "Show a campaign's feature maps, or those of imported outcomes, as coloured grids."),
    ),
    "The real car": (
        Verb("predict", "prediction.predict", "Predict where a car, or a simulator that was never driven, fails."),
        Verb("real", "prediction.real", "Propose, record and use a few drives on a real car.", "propose record update"),
        Verb(
            "outcomes",
            "outcomes",
            "Import outcomes of any simulators and cars, and export outcomes of `ds`.",
            "import export",
        ),
        Verb(
            "recording",
            "recordings",
            "Test a network on a recording of your car: its track, a twin and a sibling.",
            "test locate calibrate roads",
        ),
        Verb("twin", "recordings", "Fit the digital twin to recorded drives.", "fit"),
        Verb("sim2real", "networks", "Make simulated images look like photographs of a real track.", "train translate"),
    ),
    "Train": (
        Verb("collect", "networks", "Collect labelled driving data with the autopilot."),
        Verb("import", "networks", "Import recorded drives of a real car into a data set."),
        Verb("train", "networks", "Train one network for all simulators of a data set."),
        Verb("models", "networks", "List the shipped networks and their success rates."),
    ),
    "Roads, recordings, simulators": (
        Verb(
            "road",
            "roads",
            "Generate, check, draw, export, import and cut roads.",
            "generate check show export import cut",
        ),
        Verb("bag", "bags", "Inspect, re-simulate and repair rosbag2 recordings.", "info recover redrive drive"),
        Verb("serve", "drives", "Serve a simulator to clients of the Donkey simulator.", "donkey"),
        Verb("siblings", "siblings", "Compare how the simulators behave.", "compare"),
        Verb(
            "evaluate",
            "prediction.predict",
            "Compute how well the siblings predict the twin (RQ2, RQ3; RQ1 with data).",
        ),
    ),
    "This installation": (
        Verb("doctor", "", "Check the installation and print the command that fixes each problem."),
        Verb("completion", "", "Print the tab completion script for bash, zsh or fish."),
    ),
}
"""Heading of each group -> its verbs, in the order of the overview."""

VERBS = {verb.name: verb for verbs in GROUPS.values() for verb in verbs}


def overview(*, colour: bool = False) -> str:
    """The text of `ds --help`, with headings and names in bold by ANSI escapes if coloured."""

    def bold(text: str) -> str:
        return f"\033[1m{text}\033[0m" if colour else text

    width = max(map(len, VERBS)) + 4
    lines = [
        f"{bold('Usage:')} ds VERB [OPTIONS] [ARGUMENTS]",
        "",
        "Find out where a steering network leaves its lane: on several cheap simulators (the",
        "digital siblings), and on a digital twin of a small car.",
        "",
        "Begin with ds demo, or with your own: ds check NETWORK, then ds test NETWORK.",
    ]
    for heading, verbs in GROUPS.items():
        lines += ["", bold(f"{heading}:")]
        for verb in verbs:
            summary = verb.summary + (f" Verbs: {', '.join(verb.verbs)}." if verb.verbs else "")
            first, *rest = textwrap.wrap(summary, 88 - width)
            lines.append(f"  {bold(verb.name)}{' ' * (width - 2 - len(verb.name))}{first}")
            lines += [" " * width + line for line in rest]
    lines += [
        "",
        bold("Options:"),
        f"  {'-h, --help':<{width}}Show this overview, or with a verb its arguments and options.",
        f"  {'--version':<{width}}Show the version.",
        "",
        "Results go to standard output (with --json as one JSON document), progress to standard",
        "error. Exit status: 0 done, 1 a run ended in an error, 2 bad input, 3 a pass criterion such",
        "as --fail-on is not met, 70 a bug of ours.",
    ]
    return "\n".join(lines)


def uses_colour() -> bool:
    """True if standard output is a terminal that wants colours (https://no-color.org)."""
    return sys.stdout.isatty() and "NO_COLOR" not in os.environ and os.environ.get("TERM") != "dumb"


COMPLETION_VARIABLE = "_DS_COMPLETE"
"""Environment variable in which a shell asks for candidates."""

_BASH = """\
_ds_completion() {
    local typed="${COMP_LINE:0:COMP_POINT}" last="${COMP_WORDS[COMP_CWORD]}"
    local words=( $typed ) IFS=$'\\n'
    [[ $typed == *' ' ]] && words+=( '' )
    local whole="${words[-1]}"
    COMPREPLY=( $( env COMP_WORDS="${typed}" COMP_CWORD=$(( ${#words[@]} - 1 )) _DS_COMPLETE=complete_bash \\
        DS 2>/dev/null ) )
    COMPREPLY=( "${COMPREPLY[@]#"${whole%"${last#=}"}"}" )  # bash breaks words at =, and replaces the last part
    [[ ${COMPREPLY[0]} == *= ]] && compopt -o nospace 2>/dev/null
    return 0
}
complete -o default -F _ds_completion ds ./ds
"""
_ZSH = """\
#compdef ds
_ds_completion() {
  eval $(env _TYPER_COMPLETE_ARGS="${words[1,$CURRENT]}" _DS_COMPLETE=complete_zsh DS 2>/dev/null)
}
compdef _ds_completion ds ./ds
"""
_FISH = """\
complete --command ds --no-files --arguments "(env _DS_COMPLETE=complete_fish \
_TYPER_COMPLETE_FISH_ACTION=get-args _TYPER_COMPLETE_ARGS=(commandline -cp) DS 2>/dev/null)" \
--condition "env _DS_COMPLETE=complete_fish _TYPER_COMPLETE_FISH_ACTION=is-args \
_TYPER_COMPLETE_ARGS=(commandline -cp) DS 2>/dev/null"
"""
SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}
_COMPLETION_HELP = """\
Usage: ds completion bash|zsh|fish

Print the tab completion script of a shell. For this session:

  bash, zsh:  source <(./ds completion bash)
  fish:       ./ds completion fish | source

For every session, add that line to ~/.bashrc, ~/.zshrc or ~/.config/fish/config.fish, with the
path of this checkout's `ds`."""


def completion(arguments: Sequence[str], program: Path | None) -> int:
    """Print the script of a shell, which calls a checkout's `ds`, or the one on the PATH; returns the exit status."""
    if list(arguments) in (["-h"], ["--help"]):
        print(_COMPLETION_HELP)
        return 0
    if len(arguments) != 1 or arguments[0] not in SCRIPTS:
        shell = " ".join(arguments) or "no shell"
        print(f"error: ds completion: {shell}, expected one of {', '.join(SCRIPTS)}", file=sys.stderr)
        return 2
    print(SCRIPTS[arguments[0]].replace("DS 2>", f"{shlex.quote(str(program)) if program else 'ds'} 2>"), end="")
    return 0
