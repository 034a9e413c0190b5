# SPDX-License-Identifier: Apache-2.0
"""Constants of the study of when two siblings are better than one, fixed before its first drive; see `PLAN.md`."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from benchmarks.replication.drive import NETWORKS, WEIGHTS

HERE, TABLES = Path("benchmarks/when_to_merge"), Path("docs/data/when_to_merge")
CAMPAIGN = NETWORKS
BACKEND = "openvino"
"""Single precision, for every drive of this study."""
SHIPPED = {"residual": "residual", "recurrent": "recurrent", "dave2_b": "dave2_b", "chauffeur_full": "chauffeur"}
DRIVERS = {**{name: f"{WEIGHTS / name}.safetensors" for name in CAMPAIGN}, **SHIPPED}
"""Network -> driver without the back end: the campaign's six, and four that nobody selected by success."""
SHA256 = {
    "dave2": "4493cb213e19de4bd415740ed367cc4e9fdce9596e829f7e9d417dd9686f6afc",
    "chauffeur": "6e291940c85192745ea8d929df90861e28d400a1a883d2854341d3d6d6fe5575",
    "epoch": "6535db502154a5d9d9955c60fe7980d71948f667db1754b355ba45632da55677",
    "dave2_real": "42a5089f03517c01b0d5be9d5b3add95a9cbd4a6d71fcb2207ee5b2f53bd5510",
    "chauffeur_real": "c677405381c98e6573c263c7f4522ad7021cd80fb2797821a0ec3777d0dc65b0",
    "epoch_real": "0c55f4cef486f591c74a4862b119fc9e1894774c94e5ecf993ef703282befdca",
    "residual.onnx": "2ad9e0dd8989fc52e9fbfdebf6c514ddd8e57d12711a72ce2f5e6b41dd7ad1c2",
    "recurrent.onnx": "42f83d7e9f3932182379bb496000942aaae6c400ae206ded10bae0bdf5bb69da",
    "dave2_b.safetensors": "b6f2edb459112c5c08b206f2fe5fbbec57eb7e4b9d0f8f3c1bf6817fbb6a24a9",
    "chauffeur.safetensors": "60c095e922ae7de73f4e87718728913f8909d2e5d25963d34e66cdaea834e9b1",
}
"""Network of the campaign, or file of a shipped one -> digest of its weights."""
TORCS_NETWORKS = ("dave2", "chauffeur", "epoch")

SIBLINGS = ("bullet", "softbody", "panda")
ORIGINS = SIBLINGS[:2]
"""Siblings whose searches made the tests of parts A and B; in part C all three search."""
TWINS = ("nominal", "easier", "harder", "haze")
SIMULATORS = dict.fromkeys(("nominal", "haze"), "donkey") | {
    name: f"donkey@{HERE / name}.yaml" for name in ("easier", "harder")
}
"""Name in this study -> simulator, where they differ."""
HAZE = "visibility=182"
"""Half-way from 1,000 m to 100 m, the mild limits, in the extinction of the air, which is the search's scale."""
CONFIGS = {False: Path("src/ds_bringup/config/paper.yaml"), True: Path("src/ds_bringup/config/conditions_mild.yaml")}
"""Whether conditions are mild -> campaign, driven with one run on each sibling and seed 1."""
TESTS = 120
"""Tests of a network, in A and B and again in C, drawn in equal numbers from its searches."""
PASSES = 2
"""Times that tests without a verdict are tried, with two retries each, before they are left out."""

FEWEST = 5
"""Failures, and passes, that each of a case's three simulators needs."""
FEWEST_NETWORKS = 5
"""Networks that a decision needs; for a contrast, with both kinds of cases."""
RESAMPLES, SEED = 1000, 20261127
DRIVES, DRAWS = 10, 200
"""Drives on the twin by which an operator is chosen, and how often they are drawn."""


class Part(NamedTuple):
    """Drives of a network on a simulator, stored at once when they are whole: a search's there, or of other tests."""

    block: str
    network: str
    where: str
    searches: bool = False

    @property
    def name(self) -> str:
        """Stem of the part's table."""
        return f"{'mild_' * (self.block == 'C')}{self.network}_{'search_' * self.searches}{self.where}"

    @property
    def expected(self) -> int:
        """Number of drives."""
        searching = SIBLINGS if self.block == "C" else ORIGINS
        if self.searches:
            return 80 if self.block == "C" else 170
        return TESTS // len(searching) * (len(searching) - (self.where in searching))


def _parts() -> Iterator[Part]:
    yield from (Part("A", network, twin) for network in CAMPAIGN for twin in TWINS[1:])
    yield from (Part("A", network, "panda") for network in CAMPAIGN if network not in TORCS_NETWORKS)
    for network in SHIPPED:
        yield from (Part("A", network, sibling, searches=True) for sibling in ORIGINS)
        yield from (Part("A", network, where) for where in (*ORIGINS, *TWINS, "panda"))
    yield from (Part("A", network, "nominal") for network in CAMPAIGN)
    yield from (Part("B", network, "torcs") for network in TORCS_NETWORKS)
    for network in DRIVERS:
        yield from (Part("C", network, sibling, searches=True) for sibling in SIBLINGS)
        yield from (Part("C", network, where) for where in (*SIBLINGS, "nominal"))


PARTS = tuple(_parts())
"""In the order in which they are driven."""


def drawn(searched_on: Mapping[str, str]) -> frozenset[str]:
    """Draw the tests that count, from a network's tests -> sibling that searched; their order does not matter."""
    searching = sorted(set(searched_on.values()))
    rng = np.random.default_rng(SEED)
    return frozenset(
        str(test)
        for sibling in searching
        for test in rng.choice(
            sorted(test for test, on in searched_on.items() if on == sibling), TESTS // len(searching), replace=False
        )
    )


def check_weights() -> None:
    """Stop if a network's weights are not those of the plan."""
    for name, digest in SHA256.items():
        file = WEIGHTS / f"{name}.safetensors" if name in CAMPAIGN else Path("src/ds_driver/ds_driver/models") / name
        if hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            sys.exit(f"{file} has changed since the plan was made: restore it")
