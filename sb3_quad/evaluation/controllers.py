"""The controllers of an evaluation, from what a command line names: labels, records, and what is ready to fly."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.pretrained import agent_path
from sb3_quad.controllers.resolve import EXPERTS, import_factory, resolve_expert
from sb3_quad.controllers.zips import saved_algorithm
from sb3_quad.evaluation.results import ControllerRecord, Scaling, file_name
from sb3_quad.evaluation.scaling import AdaptiveScaling, measure_mean
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.vehicles.vehicle import Vehicle, first_vehicle, load_vehicle

SCALINGS = ("none", "adaptive", "both")


@dataclass(frozen=True)
class ControllerSpec:
    """A controller as named.

    :param label: heads its column.
    :param spec: ``pid``, ``geometric``, the path of an SB3 zip, or ``package.module:factory``.
    :param scaling: ``adaptive``: a policy sees its observation through the thesis's scaling (4.3.1); experts see none.
    """

    label: str
    spec: str
    scaling: Scaling = "none"

    @property
    def is_zip(self) -> bool:
        """Whether it is an agent in a zip."""
        return self.spec.endswith(".zip")

    @cached_property
    def own(self) -> FlightSettings | None:
        """How the agent in a zip says that it flies; None: experts, factories, and zips that say nothing.

        :raises ConfigError: see :func:`agent_settings`.
        """
        settings, source = agent_settings(self.spec) if self.is_zip else (None, None)
        return settings if source else None

    @property
    def observed(self) -> dict[str, Any]:
        """What goes with the agent wherever it flies, see :attr:`FlightSettings.observed`; also where its rotors are."""
        return FlightSettings().observed if self.own is None else {**self.own.observed, "rotor_layout": self.own.layout}

    def notice(self, vehicle: str | Path | Vehicle) -> str:
        """A warning if the agent was trained on another vehicle than ``vehicle``, or does not say on which; else empty.

        :raises ConfigError: it cannot fly the vehicle, whose rotors are elsewhere.
        """
        flown = load_vehicle(vehicle)
        if self.own is None:
            silent = f"{self.label}: {self.spec} does not say how its agent flies; it flies"
            return f"{silent} {flown.name}, with the scaling of Table A.2" if self.is_zip else ""
        flown.in_layout_of(self.own.layout)
        known = first_vehicle(self.own.vehicle)
        if self.own.vehicles is not None or known.flies_as(flown):  # an agent of many vehicles knows none of them
            return ""
        same = " of other parameters" if known.name == flown.name else ""
        return f"{self.label}: was trained on the vehicle {known.name} and flies {flown.name}{same}"


def parse_controllers(texts: Sequence[str], scaling: str = "none") -> list[ControllerSpec]:
    """Controllers from ``spec`` or ``label=spec``; a label left out is the spec, of a zip the file's name.

    :param scaling: of all but the experts, ``none`` or ``adaptive``; ``both``: each of them once plain and once adaptive.
    :raises ConfigError: an unknown scaling, or two controllers of the same label.
    """
    if scaling not in SCALINGS:
        raise ConfigError(unknown("scaling", scaling, SCALINGS))
    named = [_label_and_spec(text) for text in texts]
    plain = [ControllerSpec(label, spec) for label, spec in named if scaling != "adaptive" or spec in EXPERTS]
    adapted = [(f"{label} (adaptive)", spec) for label, spec in named if scaling != "none" and spec not in EXPERTS]
    found = plain + [ControllerSpec(*each, "adaptive") for each in adapted]
    files = [file_name(entry.label) for entry in found]
    for file, entry in zip(files, found, strict=True):
        if not entry.label.isprintable():
            raise ConfigError(f"controller {entry.label!r}: holds control characters; label it: name={entry.spec}")
        if files.count(file) > 1:
            raise ConfigError(f"controller {entry.label!r}: two are called so; label them: name={entry.spec}")
    return found


def describe(spec: ControllerSpec, vehicle: str | Vehicle) -> ControllerRecord:
    """Who a controller is; with adaptive scaling also the offset that it needs, measured by flying to targets.

    :param vehicle: what it is measured with.
    :raises ConfigError: an unknown name, a missing file, a module that cannot be imported, a policy whose offset cannot be
        measured since it crashes on the way in more than half of the flights.
    """
    path = Path(spec.spec)
    if spec.is_zip:
        algorithm, content = saved_algorithm(path), hashlib.sha256(path.read_bytes()).hexdigest()
        record = ControllerRecord(label=spec.label, spec=path.name, kind="model", algorithm=algorithm, content=content)
    else:
        import_factory(spec.spec, "controller")  # says what is wrong
        record = ControllerRecord(label=spec.label, spec=spec.spec, kind="expert" if spec.spec in EXPERTS else "factory")
    if spec.scaling == "adaptive":
        controller = build(spec, vehicle)
        if isinstance(controller, AdaptiveScaling):
            mean = measure_mean(controller.policy, settings=FlightSettings(vehicle=vehicle, **spec.observed))
            record = record.model_copy(update={"scaling": "adaptive", "offset": tuple(mean.tolist())})
    return record


def build(spec: ControllerSpec, vehicle: str | Vehicle, mean: Sequence[float] | None = None) -> Any:
    """A controller, ready to fly.

    :param vehicle: what experts and factories are made for.
    :param mean: with adaptive scaling: the position components of μ, (3,), m; None: zero.
    :raises ConfigError: it cannot be loaded.
    :raises ExpertError: a factory that fails.
    """
    controller = resolve_expert(spec.spec, vehicle, "controller")
    if spec.scaling == "none" or hasattr(controller, "actions"):
        return controller
    if spec.own is not None and spec.own.is_extended:
        raise ConfigError(f"{spec.label}: adaptive scaling is for agents that see the 18 features alone; this one sees more")
    return AdaptiveScaling(controller, mean or (0.0, 0.0, 0.0), spec.observed["observation_std"])


def _label_and_spec(text: str) -> tuple[str, str]:
    label, equals, spec = text.partition("=")
    if not equals or "/" in label or "\\" in label:  # an equals sign further on belongs to the path
        path = agent_path(text)
        return Path(text).name if path != text else Path(path).stem if path.endswith(".zip") else path, path
    if not label or not spec:
        raise ConfigError(f"controller {text!r}: write name=path, or the path alone")
    return label, agent_path(spec)
