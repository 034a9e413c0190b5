# SPDX-License-Identifier: Apache-2.0
"""Every verb says what comes next, and the commands that verbs name exist with their options."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_group

import ds_cli
from ds_cli.output import Result
from ds_cli.verbs import GROUPS, PACKAGE, VERBS

SAYING = {"answer", "end", "say_next"}
"""Functions that print the line; `Result`, which the first two take, cannot be made without it."""
MODULES = sorted(Path(ds_cli.__file__).parent.rglob("*.py"))


def calls_in(node: ast.AST) -> set[str]:
    """Names of functions that are called by their names."""
    found = (one.func for one in ast.walk(node) if isinstance(one, ast.Call))
    return {one.id for one in found if isinstance(one, ast.Name)}


def commands() -> Iterator[tuple[str, set[str]]]:
    """Functions that are verbs, and what they call, by way of functions of their module too."""
    for path in MODULES:
        functions = {one.name: one for one in ast.parse(path.read_text()).body if isinstance(one, ast.FunctionDef)}
        called = {name: calls_in(function) for name, function in functions.items()}
        for name, function in functions.items():
            if any(
                isinstance(one, ast.Call) and ast.unparse(one.func).endswith(".command")
                for one in function.decorator_list
            ):
                reached, new = set(called[name]), set(called[name])
                while new := {inner for one in new for inner in called.get(one, ())} - reached:
                    reached |= new
                yield f"{path.stem}.{name}", reached


def test_every_verb_ends_with_what_comes_next() -> None:
    found = dict(commands())
    verbs = sum(max(len(verb.verbs), 1) for _, group in GROUPS for verb in group if verb.module)
    assert len(found) == verbs
    assert [name for name, reached in found.items() if not SAYING & reached] == []
    with pytest.raises(TypeError, match="next"):
        Result(document={}, show=lambda: None)  # type: ignore[call-arg]


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
    command: Any = get_group(import_module(f"{PACKAGE}.{verb.module}").app).commands[words[0]]
    return (command.commands[words[1]], words[2:]) if verb.verbs else (command, words[1:])


def test_commands_that_verbs_name_exist_with_their_options() -> None:
    named = list(named_commands())
    assert len(named) > 30
    for where, words in named:
        command, rest = command_of(words)
        options = {option for parameter in command.params for option in parameter.opts} | {"--help"}
        assert {word for word in rest if word.startswith("-")} <= options, (where, words)
