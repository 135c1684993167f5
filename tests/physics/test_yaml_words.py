"""Mistakes in a YAML file are told all at once, each with its line and in words of its own."""

from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, Field

from processing.yaml_file import ConfigError, parse_yaml
from processing.yaml_words import NAME_PATTERN


class Dog(BaseModel, extra="forbid"):
    kind: Literal["dog"]
    legs: int = Field(gt=0, le=4)


class Cat(BaseModel, extra="forbid"):
    kind: Literal["cat"]
    names: tuple[str, ...] = Field(min_length=1)


class Sweep(BaseModel, extra="forbid"):
    start_deg: float
    step_deg: float = Field(gt=0)


class House(BaseModel, extra="forbid"):
    name: str = Field(default="a", pattern=NAME_PATTERN)
    turned_deg: float | tuple[float, ...] | Sweep = 0.0
    address: str = Field(pattern="^[a-z]+$")
    area_m2: float = Field(allow_inf_nan=False)
    heated: bool
    colour: Literal["red", "green"]
    rooms: int | tuple[int, ...] | None = None
    pets: tuple[Annotated[Dog | Cat, Field(discriminator="kind")], ...]


MISTAKEN = """\
address: No. 5
area_m2: large
heated: perhaps
colour: blue
roof: flat
pets:
  - {kind: dog, legs: 5}
  - {kind: cow}
  - {kind: cat, names: []}
  - {kind: dog}
  - {legs: 4}
rooms: many
romms: 3
"""
TOLD = """\
x.yaml:1: address: must match ^[a-z]+$, not 'No. 5'
x.yaml:2: area_m2: must be a number, not 'large'
x.yaml:3: heated: must be true or false, not 'perhaps'
x.yaml:4: colour: must be 'red' or 'green', not 'blue'
x.yaml:12: rooms: must be a whole number, not 'many', or must be a list, not 'many'
x.yaml:7: pets.0.legs: must be 4 or less, not 5
x.yaml:8: pets.1: cow is none of 'dog', 'cat'
x.yaml:9: pets.2.names: needs 1 or more entries, has 0
x.yaml:10: pets.3.legs: is missing
x.yaml:11: pets.4: needs the key 'kind'
x.yaml:5: roof: unknown key
x.yaml:13: romms: unknown key; is 'rooms' meant?"""


def test_all_mistakes_at_once_in_words_of_our_own():
    with pytest.raises(ConfigError) as error:
        parse_yaml(MISTAKEN, House, "x.yaml")
    assert str(error.value) == TOLD


def test_a_list_whose_entries_are_wrong_is_not_empty():
    """To the library it is: it counts what could be read."""
    mistaken = "address: a\narea_m2: 1\nheated: yes\ncolour: red\npets:\n  - {kind: cat, names: [[], {}]}\n"
    with pytest.raises(ConfigError) as error:
        parse_yaml(mistaken, House, "x.yaml")
    assert str(error.value) == "x.yaml:6: pets.0.names.0: must be text\nx.yaml:6: pets.0.names.1: must be text"


def test_a_file_of_another_kind_is_told_by_that_alone():
    with pytest.raises(ConfigError) as error:
        parse_yaml("kind: cat\nnames: [a]\n", Dog, "x.yaml")
    assert str(error.value) == "x.yaml:1: kind: must be 'dog', not 'cat'; is it the right file?"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("turned_deg: {start_deg: 0, step_deg: 0}", "turned_deg.step_deg: must be more than 0.0, not 0"),
        ("turned_deg: {start_deg: 0}", "turned_deg.step_deg: is missing"),
        ("name: a/b", "name: may have letters, digits, - and _ only, not 'a/b'"),
        ("heated:", "heated: must be true or false, but nothing stands there"),
        ("turned_deg: {start_deg: 0,5}", "turned_deg.step_deg: is missing"),
        ("pets: [{kind: dog, legs: 0,7}]", "pets.0.7: unknown key; decimals take a point, not a comma"),
        ("area: 3", "area: unknown key; is 'area_m2' meant?"),
        ("legs: 4", "legs: unknown key; another section may have it"),
    ],
)
def test_words_of_one_mistake(line, message):
    good = {"address": "a", "area_m2": 1, "heated": "true", "colour": "red", "pets": "[]"}
    key = line.split(":")[0]
    text = line + "\n" + "".join(f"{name}: {value}\n" for name, value in good.items() if name != key)
    with pytest.raises(ConfigError) as error:
        parse_yaml(text, House, "x.yaml")
    assert f"x.yaml:1: {message}" in str(error.value).splitlines()


def test_a_tab_is_called_a_tab():
    with pytest.raises(ConfigError, match=r"x.yaml:2: a tab; YAML is indented with spaces"):
        parse_yaml("kind: cat\n\tnames: [a]\n", Dog, "x.yaml")
