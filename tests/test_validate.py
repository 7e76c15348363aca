"""Validation: data becomes a frozen model, or one line says which key is wrong and how."""

from typing import Literal

import pytest
from pydantic import Field, PositiveFloat, ValidationError, field_validator

from sb3_quad.base.errors import CannotHover, ConfigError, ExpertError
from sb3_quad.base.validate import Frozen, validate


class Rotor(Frozen):
    thrust: float


class Craft(Frozen):
    mass: PositiveFloat
    count: int = 4
    length: float | Rotor | None = None
    rotors: tuple[Rotor, ...] = ()
    by_name: dict[str, Rotor] = Field(default_factory=dict)
    saved: Rotor | None = None
    shape: Literal["cross", "plus"] = "plus"
    fault: Literal["none", "hover", "expert"] = "none"
    second: Literal["none", "hover", "other"] = "none"

    @field_validator("fault", "second")
    @classmethod
    def _check(cls, value: str) -> str:
        if value == "hover":
            raise CannotHover("too weak")
        if value == "expert":
            raise ExpertError("of another kind")
        if value == "other":
            raise ValueError("other")
        return value


def test_data_become_a_frozen_model():
    craft = validate(Craft, {"mass": "8e-6", "rotors": [{"thrust": 1}]}, "x")
    assert craft.mass == 8e-6 and craft.rotors[0].thrust == 1.0  # YAML's 8e-6 is a string
    with pytest.raises(ValidationError):
        craft.mass = 2.0


@pytest.mark.parametrize(
    ("data", "key"),
    [
        ({}, "mass"),
        ({"mass": -1}, "mass"),
        ({"mass": "1 kg"}, "mass"),
        ({"mass": 1, "cuont": 4}, "'count'"),  # what may be meant
        ({"mass": 1, "rotors": [{"thrust": 1}, {"thrust": "x"}]}, "rotors.1.thrust"),
        ({"mass": 1, "rotors": [{"thrust": 1, "thurst": 2}]}, "thurst"),
        ({"mass": 1, "by_name": {"left": {}}}, "by_name.left.thrust"),
        ({"mass": 1, "saved": {}}, "saved.thrust"),
        ({"mass": 1, "length": [1]}, "length"),
        ({"count": "x", "mass": 1}, "count"),
        ({"mass": 1, "shape": "crss"}, "'cross'"),
        ([1], "x"),
    ],
)
def test_what_is_wrong_is_one_line_that_names_the_key(data, key):
    with pytest.raises(ConfigError) as caught:
        validate(Craft, data, "x")
    line = str(caught.value)
    assert line.startswith("x: ") and key in line and "\n" not in line


@pytest.mark.parametrize(
    ("faults", "kind"),
    [
        ({"fault": "hover"}, CannotHover),
        ({"fault": "hover", "second": "other"}, ConfigError),
        ({"fault": "expert"}, ConfigError),
    ],
)
def test_a_kind_of_its_own_is_raised_where_it_is_all_that_is_wrong(faults, kind):
    with pytest.raises(ConfigError) as caught:
        validate(Craft, {"mass": 1, **faults}, "x")
    assert type(caught.value) is kind
