# SPDX-License-Identifier: Apache-2.0
"""Models of files with keys, and error messages for invalid ones: key, value, and what is allowed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from ds_base.bounded_file import FileError
from ds_base.bounded_yaml import read_yaml

_EXPECTED: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "int_type": lambda _: "a whole number",
    "int_from_float": lambda _: "a whole number",
    "float_type": lambda _: "a number",
    "finite_number": lambda _: "a finite number",
    "string_pattern_mismatch": lambda context: f"text like {context['pattern']}",
    "bool_type": lambda _: "true or false",
    "string_type": lambda _: "text",
    "list_type": lambda _: "a list, as in [a, b]",
    "model_type": lambda _: "keys with values",
    "path_not_file": lambda _: "a file that exists",
    "literal_error": lambda context: f"one of {context['expected']}".replace("'", "").replace(" or ", ", "),
    "too_short": lambda context: f"at least {context['min_length']} of them",
    "too_long": lambda context: f"at most {context['max_length']} of them",
    "greater_than_equal": lambda context: f"at least {context['ge']}",
    "less_than_equal": lambda context: f"at most {context['le']:g}",
    "greater_than": lambda context: f"above {context['gt']:g}",
    "less_than": lambda context: f"below {context['lt']}",
}
"""pydantic's kind of error -> what was expected."""
MOST = 10
"""Problems in one message; chosen: as many as are fixed in one go."""
_LONGEST = 60
"""Characters of a value or a key in a message."""


class Keys(BaseModel):
    """Base of what a file states: unknown keys are errors, and values stay."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def read_keys(path: Path, refusal: type[ValueError]) -> Any:
    """Read the value of a YAML file; raise `refusal`, with one line, if it cannot be read."""
    try:
        return read_yaml(path)
    except OSError as error:
        raise refusal(f"{path}: cannot be read ({error.strerror}): check the path") from None
    except FileError as error:
        raise refusal(f"{path}: not YAML: {error}") from None


def problems(error: ValidationError, model: type[BaseModel]) -> str:
    """Describe the validation errors of a model in one line, the first `MOST` in words."""
    errors = error.errors(include_url=False)
    more = [f"and {len(errors) - MOST} more"] if len(errors) > MOST else []
    return "; ".join([*(_problem(dict(one), model) for one in errors[:MOST]), *more])


def first_problem(error: ValidationError, name: str) -> str:
    """Describe the first of some validation errors in one line, as that of a value with a name."""
    return _problem({**error.errors(include_url=False)[0], "loc": (name,)}, BaseModel)


def _problem(error: Mapping[str, Any], model: type[BaseModel]) -> str:
    place: tuple[int | str, ...] = error["loc"]
    where = f"{'.'.join(_one_line(str(part)) for part in place)}: " if place else ""
    if error["type"] == "extra_forbidden":
        for part in place[:-1]:
            model = _model_of(model, str(part)) if part in model.model_fields else model  # or of a list or mapping
        return f"{where}there is no such key (keys: {', '.join(model.model_fields)})"
    expected = _EXPECTED.get(error["type"])
    if expected is None:
        return f"{where}{_one_line(error['msg'].removeprefix('Value error, '), 10 * _LONGEST)}"
    return f"{where}{_shown(error['input'])}, expected {expected(error.get('ctx', {}))}"


def _shown(value: object) -> str:
    """Format a value as YAML, shortened."""
    if value is None:
        return "nothing there"
    if isinstance(value, dict | list) and (len(value) > 3 or not value):
        return f"{'an empty' if not value else 'a'} {'list' if isinstance(value, list) else 'mapping'}"
    return _one_line(yaml.safe_dump(value, default_flow_style=True, width=10_000).removesuffix("\n...\n").strip())


def _one_line(text: str, longest: int = _LONGEST) -> str:
    printable = "".join(c if c.isprintable() else "?" for c in " ".join(text.split()))
    return printable if len(printable) <= longest else f"{printable[:longest]}..."


def _model_of(model: type[BaseModel], key: str) -> type[BaseModel]:
    annotation = model.model_fields[key].annotation
    models = [a for a in (annotation, *get_args(annotation)) if isinstance(a, type) and issubclass(a, BaseModel)]
    return models[0] if models else model
