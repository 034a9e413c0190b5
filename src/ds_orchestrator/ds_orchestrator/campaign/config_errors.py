"""What is wrong with a configuration, in a user's words: the key, what it is now, and what is allowed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ValidationError

_EXPECTED: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "int_type": lambda _: "a whole number",
    "int_from_float": lambda _: "a whole number",
    "float_type": lambda _: "a number",
    "bool_type": lambda _: "true or false",
    "string_type": lambda _: "text",
    "list_type": lambda _: "a list, as in [a, b]",
    "model_type": lambda _: "keys with values",
    "literal_error": lambda context: f"one of {context['expected']}".replace("'", "").replace(" or ", ", "),
    "too_short": lambda context: f"at least {context['min_length']} of them",
    "greater_than_equal": lambda context: f"at least {context['ge']}",
    "less_than_equal": lambda context: f"at most {context['le']:g}",
    "greater_than": lambda context: f"above {context['gt']:g}",
    "less_than": lambda context: f"below {context['lt']}",
}
"""pydantic's kind of error -> what was expected."""


class _OneOfEachKey(yaml.SafeLoader):
    """YAML in which a key that comes twice is an error, not overwritten silently."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for name in names:
            if names.count(name) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"the key {name} comes twice", node.start_mark)
        return super().construct_mapping(node, deep)


def load_yaml(text: str) -> object:
    """What a YAML text says.

    Raises:
        yaml.YAMLError: it is no YAML, or a key comes twice.
    """
    return yaml.load(text, _OneOfEachKey)


def yaml_problem(error: Exception) -> str:
    """What keeps a text from being YAML, and in which line."""
    mark = getattr(error, "problem_mark", None)
    if mark is None:
        return " ".join(str(error).split())
    tab = " (a tab: indent with spaces)" if "\\t" in str(getattr(error, "problem", "")) else ""
    return f"line {mark.line + 1}, column {mark.column + 1}: {getattr(error, 'problem', error)}{tab}"


def problems(error: ValidationError, model: type[BaseModel]) -> str:
    """Every problem of a configuration of that model, in one line."""
    return "; ".join(_problem(dict(found), model) for found in error.errors())


def _problem(error: Mapping[str, Any], model: type[BaseModel]) -> str:
    place: tuple[int | str, ...] = error["loc"]
    where = f"{'.'.join(map(str, place))}: " if place else ""
    if error["type"] == "extra_forbidden":
        for part in place[:-1]:
            model = _model_of(model, str(part))
        return f"{where}there is no such key (keys: {', '.join(model.model_fields)})"
    expected = _EXPECTED.get(error["type"])
    if expected is None:
        return f"{where}{error['msg'].removeprefix('Value error, ')}"
    return f"{where}{_shown(error['input'])}, expected {expected(error.get('ctx', {}))}"


def _shown(value: object) -> str:
    """A value as YAML has it, short."""
    if value is None:
        return "nothing there"
    if isinstance(value, dict | list) and (len(value) > 3 or not value):
        return f"{'an empty' if not value else 'a'} {'list' if isinstance(value, list) else 'mapping'}"
    return str(yaml.safe_dump(value, default_flow_style=True, width=10_000)).removesuffix("\n...\n").strip()


def _model_of(model: type[BaseModel], key: str) -> type[BaseModel]:
    annotation = model.model_fields[key].annotation
    found = [a for a in (annotation, *get_args(annotation)) if isinstance(a, type) and issubclass(a, BaseModel)]
    return found[0] if found else model
