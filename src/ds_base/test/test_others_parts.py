# SPDX-License-Identifier: Apache-2.0
"""What comes from others: parts of installed packages, shared messages, and YAML, which is built within limits."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from installed_package import installed_package

from ds_base.bounded_yaml import BoundedYamlError, load_yaml
from ds_base.extension import ExtensionError, installed, load_installed
from ds_base.installation import share_folders


@pytest.fixture
def package(tmp_path: Path) -> Iterator[None]:
    """A package on the path, with one operator that is a number, one that is a text, and one that is missing."""
    (tmp_path / "more_parts.py").write_text("NUMBER, TEXT = 4, 'four'\n")
    operators = {name: f"more_parts:{name.upper()}" for name in ("number", "text", "missing")}
    with installed_package(tmp_path, "operators", operators):
        yield


@pytest.mark.usefixtures("package")
def test_a_part_of_an_installed_package_is_listed_with_its_package_and_loaded() -> None:
    entry = installed("operators")["number"]
    assert entry.dist is not None and (entry.dist.name, entry.dist.version) == ("theirs", "1.2")
    assert load_installed("number", "operators", int, "operator") == 4
    assert "number" not in installed("features")


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("text", "operator text is a str, expected a int"),
        ("missing", r"operator missing cannot be imported \(AttributeError: .*\): install theirs again"),
    ],
)
def test_a_part_that_is_none_is_named(name: str, told: str) -> None:
    with pytest.raises(ExtensionError, match=told):
        load_installed(name, "operators", int, "operator")


def test_a_checkout_without_a_workspace_has_its_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    assert any((folder / "msg/Road.msg").is_file() for folder in share_folders("ds_interfaces"))


LAUGHS = "a0: &a0 [lol]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12))
MERGES = "a0: &a0 {k: v}\n" + "".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 10)}]}}\n" for i in range(1, 9))


@pytest.mark.parametrize(
    "text",
    [
        "a: 1\nb: [1.5, .inf, yes, null, ~, text, '3', 0x1f, 1_000]\nc: {d: {}}\n",
        "base: &b {x: 1, y: [1, 2]}\nmore: {<<: *b, y: 3}\nagain: *b\n",
        "",
        "# nothing but this\n",
        "- {1: a, true: b, null: c}\n",
        '"\\u00fcber": |\n  line\n  line\n',
    ],
)
def test_ordinary_documents_are_what_the_safe_loader_makes_of_them(text: str) -> None:
    assert load_yaml(text) == load_yaml(text.encode(), unique_keys=True) == yaml.safe_load(text)


def test_a_date_stays_text() -> None:
    assert load_yaml("{a: 2024-02-30, b: 2024-02-03 10:00:00}") == {"a": "2024-02-30", "b": "2024-02-03 10:00:00"}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (LAUGHS, "aliases expanded"),
        (MERGES, "aliases expanded"),
        (f"a: &a {'x' * 10_000}\nb: [{', '.join(['*a'] * 1000)}]", "aliases expanded"),
        ("&a [*a]", "refers to nothing before it"),
        ("[" * 100_000, "nest"),  # PyYAML 6.0.4 has a limit of its own
        ("- " * 1_000 + "x", "nested deeper than 50 levels"),
        ("a: " + "9" * 400, "a whole number of 400 digits"),
        ("a: " + "9" * 100_000, "a whole number of 100000 digits"),
        ("a: 18446744073709551616", "of 64 bits"),
        ("a: !!python/object/apply:os.system [ls]", "is not allowed"),
        ("a: !!binary aGk=", "is not allowed"),
        ("a: !!float text", "is not of the type float"),
        ("a: !!bool [1]", "line 1, column 4"),
        ("!!map [a]", "expected keys with values"),
        ("? [a, b]\n: 1", "a key is a list"),
        ("a: 1\n\tb: 2", "line 2, column 1"),
        ("a: [1", "line 2, column 1: did not find"),
        ("a: 1\n---\nb: 2", "another document"),
        ("x" * (2**20 + 1), "longer than 1 MiB"),
        (b"\xff\xfe\x00", "not UTF-8"),
        ("a: \x00", "is not text"),
        ("a: \ud800", "is not text"),
    ],
)
def test_what_is_beyond_the_limits_is_refused_in_one_line_at_once(text: str | bytes, reason: str) -> None:
    begun = time.process_time()
    with pytest.raises(BoundedYamlError) as refused:
        load_yaml(text)
    assert reason in str(refused.value) and "\n" not in str(refused.value) and len(str(refused.value)) < 300
    assert time.process_time() - begun < 2.0


def test_a_key_that_comes_twice_is_refused_where_asked_also_among_many() -> None:
    many = "".join(f"k{i}: 1\n" for i in range(20_000))
    begun = time.process_time()
    assert len(load_yaml(many, unique_keys=True)) == 20_000
    assert time.process_time() - begun < 5.0
    assert load_yaml("{a: 1, a: 2}") == {"a": 2}
    with pytest.raises(BoundedYamlError, match="line 20001, column 1: the key k7 comes twice"):
        load_yaml(f"{many}k7: 2\n", unique_keys=True)
