from .actuation import COMMAND_CONDITIONS, Actuation
from .loading import load
from .model import DEFAULT, FIELDS, Condition, Conditions, ConditionsError, NotApplicableError
from .text import format_conditions, parse_conditions

__all__ = [
    "Actuation",
    "COMMAND_CONDITIONS",
    "Condition",
    "Conditions",
    "ConditionsError",
    "DEFAULT",
    "FIELDS",
    "NotApplicableError",
    "format_conditions",
    "load",
    "parse_conditions",
]
