"""Describes how two configurations of a campaign differ."""

from __future__ import annotations

import json
from typing import Any


def config_differences(known: str, given: str) -> str:
    """Describe the keys in which two configurations, as JSON text, differ, with both values.

    Raises:
        ValueError, RecursionError, AttributeError: a text is not the JSON object of a configuration.
    """
    old, new = _flat(json.loads(known)), _flat(json.loads(given))
    unset = "the default"
    keys = [key for key in new | old if old.get(key) != new.get(key)]
    return "; ".join(f"{key}: {old.get(key, unset)} there, {new.get(key, unset)} now" for key in keys)


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested keys, as in `search.runs`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
