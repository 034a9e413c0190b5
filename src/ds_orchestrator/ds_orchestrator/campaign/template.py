# SPDX-License-Identifier: Apache-2.0
"""A commented configuration for somebody's network, to be edited."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import yaml

from ds_base.bounded_yaml import load_yaml
from ds_orchestrator.campaign.config import ConfigError, SearchConfig, parse_config
from ds_orchestrator.maps.algebra import OPERATORS
from ds_orchestrator.search.algorithms import SEARCHES
from ds_orchestrator.search.features import FEATURES
from ds_sim.conditions.text import format_3sf
from ds_sim.registry import SIMULATORS, SimulatorName

WINDING = 150
"""Smallest maximum angle of a new campaign's random roads, degrees; chosen: half of the largest, as gentle roads
make no network fail."""
SIZES = {
    "small": SearchConfig(population=6, iterations=6, runs=1, min_angle=WINDING),
    "medium": SearchConfig(population=12, iterations=48, runs=1, min_angle=WINDING),
    "paper": SearchConfig(),
}
"""Size -> search: that of the tutorial, with as many random roads as mutants, as only the former are independent; five
times as long; the paper's study of one network (4.2.4)."""
MOST_SEARCHED = 2
"""Conditions that a new campaign searches; chosen: with more of them at once nearly every test fails."""


def template(
    driver: str,
    siblings: Sequence[SimulatorName],
    twin: SimulatorName | None,
    size: str,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    min_angle: int | None = None,
    max_angle: int | None = None,
    seed: int = 1,
) -> str:
    """Write a configuration as YAML, with a comment on every key; ConfigError if it would make no campaign.

    Of the conditions to search, the most sensitive ones first, those after `MOST_SEARCHED` become comments. Angles are
    those of the size where they are not given.
    """
    if size not in SIZES:
        raise ConfigError(f"size {size!r:.60}: expected one of {', '.join(SIZES)}")
    search = SIZES[size]
    largest = max_angle or search.max_angle
    text = _TEXT.format(
        driver=_scalar(driver),
        siblings=f"[{', '.join(map(_scalar, siblings))}]",
        twin=_scalar(twin or "none"),
        population=search.population,
        min_angle=min_angle or min(search.min_angle, largest),
        max_angle=largest,
        conditions=_conditions(ranges or {}),
        iterations=search.iterations,
        runs=search.runs,
        seed=f"# seed: {seed}" if seed == 1 else f"seed: {seed}",
        simulators=", ".join(SIMULATORS),
        searches=" or ".join(SEARCHES),
        features=", ".join(list(FEATURES)[:6]),
        operators=", ".join(OPERATORS),
    )
    config = parse_config(load_yaml(text), "the template")
    drives, simulators = config.executions_at_most, len(config.simulators)
    return f"# {config.tests} tests, each on {simulators} simulators: {drives} drives.\n{text}"


def _conditions(ranges: Mapping[str, tuple[float, float]]) -> str:
    if not ranges:
        return "  # conditions: {}    # operating conditions to search, as visibility: {low: 20, high: 200}"
    lines = ["  conditions:    # to search, up to where the median simulator fails; the most sensitive ones first"]
    for number, (name, ends) in enumerate(ranges.items()):
        comment = "" if number < MOST_SEARCHED else "# "
        lines.append("    {}{}: {{low: {}, high: {}}}".format(comment, name, *map(format_3sf, ends)))
    return "\n".join(lines)


def _scalar(text: str) -> str:
    """Text as one YAML value within a flow sequence."""
    return yaml.safe_dump([str(text)], default_flow_style=True, width=10_000).strip()[1:-1]


_TEXT = """\
# How long it takes here, and how much disk:  ds campaign run THIS_FILE --out DIR --dry-run
# Run it, and run it again after a stop:      ds campaign run THIS_FILE --out DIR
# docs/configuration.md explains every key; a line that begins with # is the default.

driver: {driver}    # network: a name, .safetensors, a .yaml that describes an ONNX or other file, or module:Class
siblings: {siblings}    # any of {simulators}, or module:Class
twin: {twin}    # the simulator to be predicted, or none

search:    # on every sibling
  population: {population}    # random roads at the beginning
  iterations: {iterations}    # mutants after them
  runs: {runs}    # searches with different seeds
  # method: deephyperion    # {searches}
  min_angle: {min_angle}    # degrees; larger: more winding roads at the beginning
  max_angle: {max_angle}    # smaller: gentler roads
  # extent: 6    # m, largest change of a mutant
{conditions}
  # mutate_conditions: 0.5    # share of mutations that change a condition

# conditions: none    # of every test, as visibility=60,line_contrast=0.4
# gates: conditions    # all: the autopilot must complete every test before the network is judged by it
# lane: right    # or left
# features: [turns_count, curvature]    # axes of the maps: {features}, ...
# migration: all    # elites: only the worst test of each cell drives on the other simulators
# operators: {{probability: product, quality_loss: minimum, compare: []}}    # {operators}
# sim2real: false    # or generators that translate every image
# maxitwo_compatible: false    # true: reproduce known quirks of the authors' package
{seed}
# engine: auto     # local: without ROS, faster; dask: many machines; the same results
# workers: 1    # drives at the same time; results do not depend on it
# retries: 2    # further attempts after an error
# command_timeout: 10.0    # s to wait for an answer of the network
# record: telemetry    # bag of every drive: none, telemetry, compressed (with images), raw
"""
