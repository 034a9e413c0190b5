"""Bags, packs, what killed writers left, Donkey Car tubs, and YAML as such."""

from __future__ import annotations

from pathlib import Path

from tests.fuzz.damage import damaged_file
from tests.fuzz.harness import Kind

from ds_sim.bounded_yaml import BoundedYamlError, read_yaml

_YAML = """\
name: a campaign
simulators: [donkey, bullet]
gains: {low: 0.5, high: 1.5e3, on: true, none: ~}
base: &base {seed: 7, roads: [[0, 1.5], [2, 3]]}
more: {<<: *base, seed: 8}
"""


def _write_yaml(folder: Path) -> Path:
    (folder / "file.yaml").write_text(_YAML)
    return folder / "file.yaml"


KINDS = [
    Kind(name="yaml", write=_write_yaml, damage=damaged_file, read=read_yaml, errors=(BoundedYamlError, OSError)),
]
