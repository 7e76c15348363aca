"""The controllers of an evaluation, from what a command line names: labels, records, and how the
agents among them fly.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.pretrained import agent_path
from sb3_quad.controllers.resolve import EXPERTS, import_factory
from sb3_quad.controllers.zips import saved_algorithm
from sb3_quad.evaluation.results import ControllerRecord, file_name
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.vehicles.vehicle import Vehicle, first_vehicle, load_vehicle


@dataclass(frozen=True)
class ControllerSpec:
    """A controller as named.

    :param label: heads its column.
    :param spec: ``pid``, ``geometric``, the path of an SB3 zip, or ``package.module:factory``.
    """

    label: str
    spec: str

    @property
    def is_zip(self) -> bool:
        """Whether it is an agent in a zip."""
        return self.spec.endswith(".zip")

    @cached_property
    def own(self) -> FlightSettings | None:
        """How the agent in a zip says that it flies; None: experts, factories, and zips that say
        nothing.

        :raises ConfigError: see :func:`agent_settings`.
        """
        settings, source = agent_settings(self.spec) if self.is_zip else (None, None)
        return settings if source else None

    @property
    def observed(self) -> dict[str, Any]:
        """What goes with the agent wherever it flies, see :attr:`FlightSettings.observed`; also
        where its rotors are.
        """
        return (
            FlightSettings().observed
            if self.own is None
            else {**self.own.observed, "rotor_layout": self.own.layout}
        )

    def notice(self, vehicle: str | Path | Vehicle) -> str:
        """A warning if the agent was trained on another vehicle than ``vehicle``, or does not say
        on which; else empty.

        :raises ConfigError: it cannot fly the vehicle, whose rotors are elsewhere.
        """
        flown = load_vehicle(vehicle)
        if self.own is None:
            silent = f"{self.label}: {self.spec} does not say how its agent flies; it flies"
            return f"{silent} {flown.name}, with the scaling of Table A.2" if self.is_zip else ""
        flown.in_layout_of(self.own.layout)
        return unlike_trained(self.label, self.own, flown)


def unlike_trained(label: str, own: FlightSettings, flown: Vehicle) -> str:
    """A warning if an agent with ``own`` settings was trained on another vehicle than ``flown``;
    else empty.
    """
    known = first_vehicle(own.vehicle)
    if own.vehicles is not None or known.flies_as(
        flown
    ):  # an agent of many vehicles knows none of them
        return ""
    same = " of other parameters" if known.name == flown.name else ""
    return f"{label}: was trained on the vehicle {known.name} and flies {flown.name}{same}"


def parse_controllers(texts: Sequence[str]) -> list[ControllerSpec]:
    """Controllers from ``spec`` or ``label=spec``; a label left out is the spec, of a zip the
    file's name.

    :raises ConfigError: two controllers of the same label.
    """
    found = [ControllerSpec(*_label_and_spec(text)) for text in texts]
    files = [file_name(entry.label) for entry in found]
    for file, entry in zip(files, found, strict=True):
        if not entry.label.isprintable():
            raise ConfigError(
                f"controller {entry.label!r}: holds control characters; label it: name={entry.spec}"
            )
        if files.count(file) > 1:
            raise ConfigError(
                f"controller {entry.label!r}: two are called so; label them: name={entry.spec}"
            )
    return found


def describe(spec: ControllerSpec) -> ControllerRecord:
    """Who a controller is.

    :raises ConfigError: an unknown name, a missing file, a module that cannot be imported.
    """
    path = Path(spec.spec)
    if spec.is_zip:
        algorithm, content = saved_algorithm(path), hashlib.sha256(path.read_bytes()).hexdigest()
        return ControllerRecord(
            label=spec.label, spec=path.name, kind="model", algorithm=algorithm, content=content
        )
    import_factory(spec.spec, "controller")  # says what is wrong
    return ControllerRecord(
        label=spec.label, spec=spec.spec, kind="expert" if spec.spec in EXPERTS else "factory"
    )


def _label_and_spec(text: str) -> tuple[str, str]:
    label, equals, spec = text.partition("=")
    if not equals or "/" in label or "\\" in label:  # an equals sign further on belongs to the path
        path = agent_path(text)
        return Path(text).name if path != text else Path(path).stem if path.endswith(
            ".zip"
        ) else path, path
    if not label or not spec:
        raise ConfigError(f"controller {text!r}: write name=path, or the path alone")
    return label, agent_path(spec)
