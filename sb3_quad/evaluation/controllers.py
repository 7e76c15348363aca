"""The controllers that a command line names: labels, records, and how agents fly."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from sb3_quad.agents.agent_settings import agent_settings, settings_of_model, unlike_trained
from sb3_quad.agents.pretrained import agent_path
from sb3_quad.agents.resolve import EXPERTS, import_factory
from sb3_quad.agents.zips import saved_algorithm
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import StrDict
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vehicles.vehicle import VehicleSource, first_vehicle, load_vehicle
from sb3_quad.evaluation.results import ControllerRecord, file_name


@dataclass(frozen=True)
class ControllerSpec:
    """A controller as named.

    :param label: heading of its column.
    :param spec: ``pid``, ``geometric``, the path of an SB3 zip, or ``package.module:factory``.
    """

    label: str
    spec: str

    @property
    def is_zip(self) -> bool:
        """Whether it is an agent in a zip."""
        return self.spec.endswith(".zip")

    @property
    def kind(self) -> Literal["expert", "model", "factory"]:
        """Its kind, as in :class:`~sb3_quad.evaluation.results.ControllerRecord`."""
        if self.is_zip:
            return "model"
        return "expert" if self.spec in EXPERTS else "factory"

    @cached_property
    def own(self) -> FlightSettings | None:
        """The settings in the agent's zip; None for experts, factories, and zips without settings.

        :raises ConfigError: see :func:`agent_settings`.
        """
        if self.is_zip:
            settings, source = agent_settings(self.spec)
            if source is not None:
                return settings
        return None

    @property
    def observed(self) -> StrDict:
        """Settings that go with the agent wherever it flies, see :attr:`FlightSettings.carried`."""
        if self.own is None:
            return FlightSettings().observed
        return self.own.carried

    def notice(self, vehicle: VehicleSource) -> str:
        """Return a warning if the agent was trained on another vehicle, or does not say on which.

        :return: the warning, in one line; empty if there is none.
        :raises ConfigError: it cannot fly the vehicle, whose rotors are in other places.
        """
        flown = load_vehicle(vehicle)
        if self.own is not None:
            # Raises if the rotors of the two do not fit.
            flown.in_layout_of(self.own.layout)
            return unlike_trained(self.label, self.own, flown)
        # Experts and factories are made for the vehicle that they fly.
        if not self.is_zip:
            return ""
        return (
            f"{self.label}: {self.spec} does not say how its agent flies; it flies {flown.name},"
            " with the scaling of Table A.2"
        )


def known_settings(controller: Any, model: Any) -> FlightSettings | None:
    """Return how a controller was trained to fly; None: it does not say.

    :param controller: as it was given, such as the path of a zip.
    :param model: what was loaded.
    """
    known = settings_of_model(model)
    # Zips of rl_zoo3 have their settings in a file of their own.
    if known is None and isinstance(controller, (str, Path)):
        known = ControllerSpec("", agent_path(str(controller))).own
    return known


def parse_controllers(texts: Sequence[str]) -> list[ControllerSpec]:
    """Read controllers from ``spec`` or ``label=spec``.

    Without a label, the label is the spec; for a zip, it is the file's name.

    :raises ConfigError: two controllers with the same label, or a label that cannot be printed.
    """
    # Different labels may still become the same file name.
    specs: dict[str, ControllerSpec] = {}
    for text in texts:
        label, equals, path = text.partition("=")
        # An equals sign after a slash belongs to the path.
        if not equals or {"/", "\\"} & {*label}:
            label = Path(text).name.removesuffix(".zip")
            path = text
        if not label or not path or not label.isprintable():
            raise ConfigError(
                f"controller {text!r}: write name=path with a printable name, or a path"
            )
        spec = ControllerSpec(label, agent_path(path))
        if specs.setdefault(file_name(label), spec) is not spec:
            raise ConfigError(
                f"controller {label!r}: two have this label; label them: name={spec.spec}"
            )
    return [*specs.values()]


def controller_record(spec: ControllerSpec) -> ControllerRecord:
    """Return the record of a controller for the results.

    :raises ConfigError: an unknown name, a missing file, a module that cannot be imported.
    """
    if not spec.is_zip:
        # Import it now, so that an error shows before anything flies.
        import_factory(spec.spec, "controller")
        return ControllerRecord(label=spec.label, spec=spec.spec, kind=spec.kind)
    path = Path(spec.spec)
    flown = spec.own or FlightSettings()
    return ControllerRecord(
        label=spec.label,
        spec=path.name,
        kind=spec.kind,
        algorithm=saved_algorithm(path),
        content=hashlib.sha256(path.read_bytes()).hexdigest(),
        vehicle=first_vehicle(flown.vehicle).name,
    )
