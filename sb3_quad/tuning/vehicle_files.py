"""Vehicle files with other gains; everything else in them, comments too, stays as it is written."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import yaml

from sb3_quad.base.errors import ConfigError
from sb3_quad.vehicles.gains import GeometricGains
from sb3_quad.vehicles.vehicle import load_vehicle

BLOCK = "geometric_gains"
COMMENT = "of GeometricExpert, found by search; what each means: sb3_quad/dynamics/gains.py"


def vehicle_text(source: str | Path) -> str:
    """The YAML of a vehicle, by name or path.

    :raises ConfigError: as :func:`~sb3_quad.vehicles.vehicle.load_vehicle`.
    """
    load_vehicle(source)  # whatever is wrong with it
    path = Path(source)
    if path.suffix in (".yaml", ".yml"):
        return path.read_text(encoding="utf-8")
    return resources.files("sb3_quad.vehicles").joinpath(f"{source}.yaml").read_text(encoding="utf-8")


def with_gains(text: str, gains: GeometricGains) -> str:
    """A vehicle's YAML with these gains instead of those it has, if any.

    :raises ConfigError: a file that holds its gains in a form that cannot be cut out of it.
    """
    kept: list[str] = []
    inside = False
    for line in text.splitlines():
        inside = line.startswith(f"{BLOCK}:") or (inside and (not line.strip() or line[0].isspace()))
        if not inside:
            kept.append(line)
    head = "\n".join(kept).rstrip("\n") + "\n"
    if BLOCK in (yaml.safe_load(head) or {}):
        raise ConfigError(f"{BLOCK} is written in a form that cannot be replaced; remove it from the vehicle's file")
    values = {key: value for key, value in gains.model_dump(mode="json").items() if value is not None}
    measured = values.pop("measured", None)
    lines = [f"{BLOCK}:".ljust(45) + f"# {COMMENT}", *(f"  {key}: {value:g}" for key, value in values.items())]
    if measured is not None:
        lines.append("  measured:".ljust(45) + "# on fresh episodes, target 10 m away")
        lines.extend(f"    {key}: {value}" for key, value in measured.items())
    return head + "\n".join(lines) + "\n"
