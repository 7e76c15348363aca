"""YAML files by name or path: which of the two a text is, and one line for whatever is wrong."""

from pathlib import Path

import pytest

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.yaml_files import YamlFolder

VEHICLES = YamlFolder("vehicle", "sb3_quad.envs.vehicles")
SETTINGS = YamlFolder("settings", "sb3_quad.zoo_configs", ".yml", folders=("thesis",))

# A few hundred bytes that stand for a billion values.
ALIASES = b"a0: &a0 [1, 1]\n" + b"".join(
    b"a%d: &a%d [*a%d, *a%d, *a%d, *a%d, *a%d, *a%d, *a%d, *a%d]\n" % (n, n, *[n - 1] * 8)
    for n in range(1, 10)
)
MERGES = ALIASES.replace(b"[1, 1]", b"{x: 1}").replace(b"[", b"{<<: [").replace(b"]", b"]}")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("folder", "source", "is_path"),
    [
        (VEHICLES, "itm", False),
        (VEHICLES, "itm.yaml", True),
        (VEHICLES, "sub/itm", True),
        (VEHICLES, Path("itm"), True),
        (SETTINGS, "dagger.yml", False),
        (SETTINGS, "thesis/dagger.yml", False),
        (SETTINGS, Path("dagger.yml"), True),
    ],
)
def test_paths_are_distinguished_from_names(here, folder, source, is_path):
    assert folder.is_path(source) == is_path


def test_a_file_that_only_happens_to_be_called_as_a_vehicle_is_not_taken_for_it(here):
    (here / "itm").write_text("name: mine")
    assert not VEHICLES.is_path("itm")
    assert VEHICLES.read("itm")[0]["name"] == "itm"


def test_a_users_file_comes_before_the_packages_of_the_same_name(here):
    assert SETTINGS.read("dagger.yml")[0].keys() != {"mine"}
    (here / "dagger.yml").write_text("mine: 1")
    assert SETTINGS.read("dagger.yml") == ({"mine": 1}, "dagger.yml")


def test_aliases_are_read(here):
    (here / "mine.yaml").write_text("a: &a {x: 1}\nb: {<<: *a, y: *a}")
    assert VEHICLES.read("mine.yaml")[0]["b"] == {"x": 1, "y": {"x": 1}}


def test_what_messages_call_a_file(here):
    (here / "mine.yaml").write_text("a: 1")
    assert VEHICLES.text("mine.yaml") == ("a: 1", "mine.yaml")
    assert VEHICLES.read(here / "mine.yaml") == ({"a": 1}, str(here / "mine.yaml"))
    assert VEHICLES.text("itm")[1] == "itm.yaml"
    assert SETTINGS.text("thesis/dagger.yml")[1] == "thesis/dagger.yml"


@pytest.mark.parametrize(
    ("source", "content"),
    [
        ("imt", None),
        ("missing.yaml", None),
        ("bad.yaml", b"\xff\xfe\x00\x01"),
        ("bad.yaml", b"mass: [1, 2"),
        ("bad.yaml", b""),
        ("bad.yaml", ALIASES),
        ("bad.yaml", MERGES),
        ("bad.yaml", b"a: &a [*a]"),
    ],
)
def test_what_is_wrong_is_one_line_that_names_the_file(here, source, content):
    if content is not None:
        (here / source).write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        VEHICLES.read(source)
    assert source in str(caught.value) and "\n" not in str(caught.value)
