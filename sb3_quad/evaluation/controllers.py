"""The controllers of an evaluation: what a command line names, who they are, and how they are asked."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.records import ControllerRecord
from sb3_quad.evaluation.scaling import AdaptiveScaling, measure_mean
from sb3_quad.experts.models import saved_algorithm
from sb3_quad.experts.resolve import EXPERTS, resolve_expert
from sb3_quad.pretrained_policies import agent_path
from sb3_quad.simulation.observation import OBSERVATION_SIZE

Scaling = Literal["none", "adaptive"]
SCALINGS = ("none", "adaptive")


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


def parse_controllers(texts: Sequence[str], scaling: Scaling = "none") -> list[ControllerSpec]:
    """Controllers from ``spec`` or ``label=spec``; a label left out is as short as tells them apart.

    :raises ConfigError: two controllers of the same label.
    """
    given = [_named(text) for text in texts]
    paths = [spec for label, spec in given if label is None and spec.endswith(".zip")]
    found = []
    for label, spec in given:
        name = label or (_short(spec, paths) if spec.endswith(".zip") else spec)
        adapted = scaling == "adaptive" and spec not in EXPERTS
        found.append(ControllerSpec(f"{name} (adaptive)" if adapted else name, spec, "adaptive" if adapted else "none"))
    slugs = [file_name(entry.label) for entry in found]
    for slug, entry in zip(slugs, found, strict=True):
        if slugs.count(slug) > 1:
            raise ConfigError(f"controller {entry.label!r}: two are called so; label them: name={entry.spec}")
    return found


def file_name(label: str) -> str:
    """A label as part of file names."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", label).strip("_.") or "_"


def describe(spec: ControllerSpec) -> ControllerRecord:
    """Who a controller is, without its offset.

    :raises ConfigError: an unknown name, a missing file, a module that cannot be imported.
    """
    if spec.spec.endswith(".zip"):
        algorithm = saved_algorithm(spec.spec)
        content = Path(spec.spec).read_bytes()
        return _record(spec, "model", Path(spec.spec).name, algorithm, content)
    location = EXPERTS.get(spec.spec, spec.spec)
    return _record(spec, "expert" if spec.spec in EXPERTS else "factory", spec.spec, None, _source(location))


def build(spec: ControllerSpec, vehicle: str, mean: Sequence[float] | None = None) -> Any:
    """A controller, ready to fly.

    :param vehicle: what experts and factories are given, the one they are to know.
    :param mean: with adaptive scaling: the position components of μ, (3,), m; None: zero.
    :raises ConfigError: it cannot be loaded, or its spaces are not the quadcopter's.
    :raises ExpertError: a factory that fails.
    """
    controller = resolve_expert(spec.spec, vehicle, "controller")
    _check_spaces(controller, spec.spec)
    if spec.scaling == "none" or hasattr(controller, "actions"):
        return controller
    return AdaptiveScaling(controller, (0.0, 0.0, 0.0) if mean is None else mean)


def measured(spec: ControllerSpec, record: ControllerRecord, vehicle: str) -> ControllerRecord:
    """The record with the offset that adaptive scaling needs, measured by flying to targets; without it, as it is.

    :raises ConfigError: a controller that crashes on the way in more than half of the flights.
    """
    if spec.scaling == "none":
        return record
    controller = build(spec, vehicle)
    if not isinstance(controller, AdaptiveScaling):
        return record.model_copy(update={"scaling": "none"})
    offset = tuple(measure_mean(controller.policy, vehicle=vehicle).tolist())
    return record.model_copy(update={"offset": offset})


def _named(text: str) -> tuple[str | None, str]:
    label, spec = _split(text)
    path = agent_path(spec)
    return (spec if label is None and path != spec else label), path


def _split(text: str) -> tuple[str | None, str]:
    label, equals, spec = text.partition("=")
    if not equals or "/" in label or "\\" in label:  # an equals sign further on belongs to the path
        return None, text
    if not label or not spec:
        raise ConfigError(f"controller {text!r}: write name=path, or the path alone")
    return label, spec


def _short(path: str, paths: Sequence[str]) -> str:
    """The end of a path that no other of ``paths`` has, without the ending."""
    parts = Path(path).with_suffix("").parts
    others = [Path(other).with_suffix("").parts for other in paths if other != path]
    for count in range(1, len(parts) + 1):
        if not any(other[-count:] == parts[-count:] for other in others):
            return "/".join(parts[-count:])
    return "/".join(parts)


def _record(
    spec: ControllerSpec, kind: Literal["expert", "model", "factory"], name: str, algorithm: str | None, content: bytes
) -> ControllerRecord:
    digest = hashlib.sha256(content).hexdigest()
    return ControllerRecord(label=spec.label, spec=name, kind=kind, algorithm=algorithm, content=digest, scaling=spec.scaling)


def _source(location: str) -> bytes:
    """The source of the module that holds an expert or factory, or what else tells its versions apart."""
    module_name, colon, _ = location.partition(":")
    if not colon:
        resolve_expert(location, kind="controller")  # says what is wrong
    try:
        file = inspect.getsourcefile(importlib.import_module(module_name))
    except Exception:  # build() says what is wrong with it
        return location.encode()
    return location.encode() + (Path(file).read_bytes() if file is not None else b"")


def _check_spaces(controller: Any, spec: str) -> None:
    """:raises ConfigError: a model whose observations or actions are not the quadcopter's."""
    wanted = {"observation_space": (OBSERVATION_SIZE,), "action_space": (4,)}
    for name, shape in wanted.items():
        space = getattr(controller, name, None)
        if space is None:
            continue
        found = getattr(space, "shape", None)
        if found != shape or not np.issubdtype(space.dtype, np.floating):
            what = name.removesuffix("_space")
            raise ConfigError(f"controller {spec}: its {what}s are {space}, the quadcopter's are of shape {shape}")
