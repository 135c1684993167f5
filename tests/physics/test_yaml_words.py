"""Mistakes in a YAML file are told all at once, each with its line and in words of its own."""

from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, Field

from processing.yaml_file import ConfigError, parse_yaml


class Dog(BaseModel, extra="forbid"):
    kind: Literal["dog"]
    legs: int = Field(gt=0, le=4)


class Cat(BaseModel, extra="forbid"):
    kind: Literal["cat"]
    names: tuple[str, ...] = Field(min_length=1)


class House(BaseModel, extra="forbid"):
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
x.yaml:7: pets.0.dog.legs: must be 4 or less, not 5
x.yaml:8: pets.1: cow is none of 'dog', 'cat'
x.yaml:9: pets.2.cat.names: needs 1 or more entries, has 0
x.yaml:10: pets.3.dog.legs: is missing
x.yaml:11: pets.4: needs the key 'kind'
x.yaml:5: roof: unknown key
x.yaml:13: romms: unknown key; is 'rooms' meant?"""


def test_all_mistakes_at_once_in_words_of_our_own():
    with pytest.raises(ConfigError) as error:
        parse_yaml(MISTAKEN, House, "x.yaml")
    assert str(error.value) == TOLD


def test_a_file_of_another_kind_is_told_by_that_alone():
    with pytest.raises(ConfigError) as error:
        parse_yaml("kind: cat\nnames: [a]\n", Dog, "x.yaml")
    assert str(error.value) == "x.yaml:1: kind: must be 'dog', not 'cat'; is it the right file?"
