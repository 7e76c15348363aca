"""What a rotor can do, as it is published: its greatest and least thrust in N, or its speeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import TypeAdapter, ValidationError

from sb3_quad.base.quantities import Finite

OTHER_LIMITS = {
    "rotor_thrust_limits": "least and greatest thrust of one rotor, N",
    "rotor_speed_limits": "least and greatest speed of one rotor, rad/s",
}
DEFAULT_GRAVITY = 9.81  # m/s^2
_NUMBER, _PAIR = TypeAdapter(Finite), TypeAdapter(tuple[Finite, Finite])


def in_hover_thrusts(data: Mapping[str, Any]) -> dict[str, Any]:
    """A vehicle's keys with ``thrust_limits`` instead of ``rotor_thrust_limits`` or ``rotor_speed_limits`` (F = kF ω²).

    Keys that the conversion needs and that are missing or no numbers are left for the vehicle's own validation to name.

    :raises ValueError: limits given twice, or that are no two numbers of at least 0, the least first.
    """
    keys = dict(data)
    given = [key for key in ("thrust_limits", *OTHER_LIMITS) if key in keys]
    if len(given) > 1:
        raise ValueError(f"{' and '.join(given)}: give only one of them")
    if not given or given[0] == "thrust_limits":
        return keys
    name = given[0]
    try:
        least, most = _PAIR.validate_python(keys.pop(name))
    except ValidationError:
        raise ValueError(f"{name}: must be two numbers ({OTHER_LIMITS[name]})") from None
    if not 0.0 <= least < most:
        raise ValueError(f"{name} [{least:g}, {most:g}]: must rise, from at least 0 ({OTHER_LIMITS[name]})")
    try:
        lift = _NUMBER.validate_python(keys.get("thrust_coefficient")) if name == "rotor_speed_limits" else 1.0
        mass = _NUMBER.validate_python(keys.get("mass"))
        hover = mass * _NUMBER.validate_python(keys.get("gravity", DEFAULT_GRAVITY)) / 4.0
    except ValidationError:
        hover = lift = 0.0
    if hover <= 0.0 or lift <= 0.0:
        return {**keys, "thrust_limits": (0.0, 2.0)}  # any that pass: what is wrong is another key
    power = 2 if name == "rotor_speed_limits" else 1
    return {**keys, "thrust_limits": (lift * least**power / hover, lift * most**power / hover)}
