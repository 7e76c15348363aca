"""Experts by name, as YAML and the command line give them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_quad.agents.pretrained import agent_path, pretrained_names
from sb3_quad.agents.zips import load_model, refuse_settings
from sb3_quad.base.errors import ConfigError, ExpertError, raised_as, unknown
from sb3_quad.base.imports import import_name
from sb3_quad.envs.simulation.settings import KEY
from sb3_quad.envs.vehicles.vehicle import VehicleSource, first_vehicle

# Experts by name, and their factories, which are imported when they are asked for.
EXPERTS = {
    "pid": "sb3_quad.experts.pid:PIDExpert",
    "geometric": "sb3_quad.experts.geometric:GeometricExpert",
    "privileged_geometric": "sb3_quad.experts.geometric:privileged_geometric",
    "privileged_derived": "sb3_quad.experts.geometric:privileged_derived",
}
DEFAULT_EXPERT = "pid"
"""The expert that is imitated by default: the thesis's."""


def resolve_expert(
    spec: Any,
    vehicle: VehicleSource | Sequence[Any] = "itm",
    kind: str = "expert",
    layout: VehicleSource | None = None,
    action: str = "thrusts",
) -> Any:
    """Return the expert that ``spec`` names.

    :param spec: a name of ``EXPERTS``, such as ``"pid"``; the path of an SB3 ``.zip`` model, or the
        name of a policy that comes with the package (:func:`sb3_quad.pretrained_path`);
        ``"package.module:factory"``, where ``factory(vehicle)`` returns an expert; or an expert
        itself, returned as it is.
    :param vehicle: the vehicle that a named expert is designed for; of several, the first.
    :param kind: the word for it in messages.
    :param layout: ``rotor_layout`` of the environments that it flies in.
    :param action: what the actions of an expert of ``EXPERTS`` command, as there.
    :raises ConfigError: an unknown name, a missing or unreadable file, a factory that cannot be
        imported.
    :raises ExpertError: a factory that fails.
    """
    if not isinstance(spec, (str, Path)):
        return spec
    text = str(spec)
    # The name of a policy of the package and a run folder stand for a zip.
    path = agent_path(text)
    if path.endswith(".zip"):
        model = load_model(path)
        # Flights here have no wrappers. An agent with flight settings had none either.
        if not hasattr(model, KEY):
            refuse_settings(path)
        return model
    factory = import_factory(text, kind)
    keywords = {"action": action} if text in EXPERTS else {}
    with raised_as(ExpertError, f"{kind} {text}: the factory failed"):
        return factory(first_vehicle(vehicle, layout), **keywords)


def import_factory(text: str, kind: str) -> Any:
    """Return the factory of a named expert, or the one at ``package.module:factory``.

    :raises ConfigError: an unknown name, or a factory that cannot be imported.
    :raises MissingExtra: the factory needs a package that is not installed.
    """
    location = EXPERTS.get(text, text)
    if ":" not in location:
        if text and Path(text).is_dir():
            raise ConfigError(f"{kind} {text}: no run with an agent in this folder")
        valid = [*EXPERTS, *pretrained_names()]
        raise ConfigError(
            unknown(kind, text, valid) + ", or path/to/model.zip, or package.module:factory"
        )
    return import_name(location, kind)
