"""Validation: data becomes a frozen model, or one line says which key is wrong, how, and what it
means.
"""

from typing import Literal

import pytest
from pydantic import Field, PositiveFloat, ValidationError, field_validator

from sb3_quad.base.errors import CannotHover, ConfigError, ExpertError
from sb3_quad.base.validate import Frozen, validate


class Rotor(Frozen):
    thrust: float = Field(description="N")


class Craft(Frozen):
    mass: PositiveFloat = Field(description="m, kg")
    count: int = 4
    length: float | Rotor | None = None
    rotors: tuple[Rotor, ...] = ()
    by_name: dict[str, Rotor] = Field(default_factory=dict)
    saved: Rotor | None = None
    shape: Literal["cross", "plus"] = Field(default="plus", description="how it\nlooks")
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
    ("data", "message"),
    [
        ({}, "x: mass: is missing (m, kg)"),
        ({"mass": -1}, "x: mass: Input should be greater than 0 (m, kg)"),
        ({"mass": float("nan")}, "x: mass: Input should be a finite number (m, kg)"),
        ({"mass": "1 kg"}, "x: mass: '1 kg' must be a plain number, without a unit (m, kg)"),
        (
            {"mass": 1, "count": "four"},
            "x: count: 'four' must be a plain number, without a unit",
        ),
        (
            {"mass": 1, "cuont": 4},
            "x: unknown key 'cuont': did you mean 'count'? "
            "(valid: by_name, count, fault, length, mass, rotors, saved, second, shape)",
        ),
        (
            {"mass": 1, "rotors": [{"thrust": 1}, {"thrust": "x"}]},
            "x: rotors.1.thrust: 'x' must be a plain number",
        ),
        (
            {"mass": 1, "rotors": [{"thrust": 1, "thurst": 2}]},
            "x: rotors.0: unknown key 'thurst': did you mean 'thrust'?",
        ),
        (
            {"mass": 1, "by_name": {"left": {"thurst": 1}}},
            "x: by_name.thrust: is missing (N); by_name: unknown key 'thurst'",
        ),
        ({"mass": 1, "saved": {}}, "x: saved.thrust: is missing (N)"),
        ({"mass": 1, "length": [1]}, "x: length: Input should be a valid number"),
        (
            {"count": "x", "mass": 0},
            "x: mass: Input should be greater than 0 (m, kg); count: 'x' must",
        ),
        (
            {"mass": 1, "shape": "crss"},
            "x: shape: Input should be 'cross' or 'plus'; did you mean 'cross'? (how it looks)",
        ),
        ([1], "x: Input should be a valid dictionary"),
    ],
)
def test_what_is_wrong_is_one_line(data, message):
    with pytest.raises(ConfigError) as caught:
        validate(Craft, data, "x")
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)


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
