# SPDX-License-Identifier: Apache-2.0
"""Commands that verbs name exist with their options."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ds_cli
from ds_cli.application import make_app
from ds_cli.verbs import VERBS

MODULES = sorted(Path(ds_cli.__file__).parent.rglob("*.py"))


def named_commands() -> Iterator[tuple[str, list[str]]]:
    """Literal words of each `ds_command(...)`, both sides of a choice; what is no literal is skipped."""
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "ds_command":
                ways: list[list[str]] = [[]]
                for word in node.args:
                    sides = [word.body, word.orelse] if isinstance(word, ast.IfExp) else [word]
                    texts = [
                        side.value for side in sides if isinstance(side, ast.Constant) and isinstance(side.value, str)
                    ]
                    ways = [[*way, text] for way in ways for text in texts] if texts else ways
                yield from ((f"{path.stem}:{node.lineno}", way) for way in ways if is_whole(way))


def is_whole(words: list[str]) -> bool:
    """Whether literal words name a verb, and where it has verbs, one of them."""
    return bool(words) and words[0] in VERBS and len(words) > bool(VERBS[words[0]].verbs)


def command_of(words: list[str]) -> tuple[Any, list[str]]:
    """The command that words name, and the words after it."""
    verb = VERBS[words[0]]
    application: Any = make_app()
    command = application.get_command(None, words[0])
    return (command.commands[words[1]], words[2:]) if verb.verbs else (command, words[1:])


def test_commands_that_verbs_name_exist_with_their_options() -> None:
    named = list(named_commands())
    assert len(named) > 30
    for where, words in named:
        command, rest = command_of(words)
        options = {option for parameter in command.params for option in parameter.opts} | {"--help"}
        assert {word for word in rest if word.startswith("-")} <= options, (where, words)
