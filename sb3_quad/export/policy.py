"""A trained zip as a self-contained policy file, checked."""

import hashlib
import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from torch.nn.utils import parameters_to_vector

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.zips import load_model, saved_algorithm
from sb3_quad.algorithms.labelling import refuse_other_action
from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.templates import render
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.envs.simulation.observation import FEATURES, GROUPS
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vehicles.vehicle import VehicleSource, first_vehicle, load_vehicle
from sb3_quad.export.c_header import c_name, write_header
from sb3_quad.export.check import N_OBSERVATIONS, TrainedPolicy, compare
from sb3_quad.export.cost import cost_of
from sb3_quad.export.crazyflie import FILES, plan_app
from sb3_quad.export.load import load_header, load_onnx
from sb3_quad.export.network import Network, build_network, write_onnx

# Formats, with the suffixes of their files or folders
FORMATS = {"onnx": ".onnx", "c": ".h", "crazyflie": "_crazyflie"}
APP = "crazyflie"  # the format that is a folder, and the file in it that contains the policy
HEADER = "src/policy.h"


class Export(NamedTuple):
    """An exported policy, not yet on disk."""

    content: bytes  # the file
    metadata: dict[str, str]  # what it says about itself
    max_error: float  # the largest difference from the policy, in `unit`
    unit: str  # N or rad/s
    settings: Path | None  # the file that vehicle and scaling came from, if not given
    files: dict[str, bytes] | None  # all files of an app, by their paths in its folder


def export_policy(
    path: StrPath,
    file_format: str,
    output: str = "thrusts",
    vehicle: VehicleSource | None = None,
    name: str | None = None,
    n_observations: int = N_OBSERVATIONS,
) -> Export:
    """Export an SB3 zip (PPO, A2C, SAC, TD3, DAgger, PPOBC, APG; ``MlpPolicy``) as a self-contained
    policy file.

    The file takes the features of an observation in physical units, see
    ``metadata["observation"]``, relative to a moving reference, see ``metadata["reference"]``. It
    returns the four rotors' thrusts (N) or speeds (rad/s), or the collective thrust (N) and body
    rates (rad/s) of a policy that commands these, by the policy's mean action, clipped.
    Earlier frames that the policy sees are in a state, ``metadata["state"]``. A vehicle that is not
    given, and the scaling, are those that :func:`agent_settings` finds in the zip or next to it. If
    it finds none, the vehicle must be given, and the scaling is that of Table A.2.

    :param file_format: ``onnx``, ``c``, or ``crazyflie``, which is an app around the C header;
        ``output``: ``thrusts`` or ``speeds``.
    :param vehicle: the vehicle whose body frame, order of rotors, thrust limits and, for speeds, kF
        the file uses.
    :param name: the C function is called ``NAME_policy``; None: the name of the zip.
    :param n_observations: maximum number of observations of the check, see
        :func:`~sb3_quad.export.check.compare`.
    :raises ConfigError: an unknown format or output; a zip that cannot be read, whose spaces are
        not the quadcopter's or whose policy is not an ``MlpPolicy``; one that flies any vehicle or
        does not say which, and none is given; a vehicle whose rotors cannot be turned to the layout
        that the policy knows; an app for another vehicle than a Crazyflie, of speeds, or of a
        policy that is too slow; a package or a C compiler that is not installed.
    :raises ExportError: the file computes something other than the policy, or does not compile.
    """
    prefix = c_name(Path(path).stem) if name is None else name
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", prefix):
        raise ConfigError(
            f"--name {name!r}: must be a C identifier: "
            "letters, digits and underscores, a letter first"
        )
    refuse_unknown("format", [file_format], FORMATS)
    is_app = file_format == APP
    if is_app and output != "thrusts":
        raise ConfigError(f"--format {file_format}: the firmware takes thrusts; remove --output")
    model = load_model(path)
    settings, source = agent_settings(path, model)
    if is_app:
        refuse_other_action(f"model {path}", model, "thrusts")
    if settings.action == "rates":
        if output != "thrusts":
            raise ConfigError(f"model {path}: commands thrust and body rates; remove --output")
        output = "rates"
    if vehicle is None:
        vehicle = _own_vehicle(f"model {path}", settings, source)
    flown = first_vehicle(vehicle)
    if is_app:
        # Axes and rotors as the firmware has them.
        flown = flown.in_layout_of(load_vehicle("crazyflie"))
    trained = TrainedPolicy(model, settings, flown, output)
    network = build_network(trained, f"model {path}")
    is_header = file_format != "onnx"
    facts: StrDict = {"cost": cost_of(network) if is_header else None}
    facts["plan"] = plan_app(network) if is_app else {}
    metadata = _describe(Path(path), network, **facts)
    write: Any = partial(write_header, name=prefix)
    read: Any = partial(load_header, name=prefix)
    if not is_header:
        write, read = write_onnx, load_onnx
    # The file is checked, then written again with the result of the check in it.
    call, by = read(write(network, metadata), network.state_size)
    error, n_compared = compare(trained, call, by, n_observations, relates=is_header)
    metadata["check"] = (
        f"largest error {error:.2g} {network.unit} in {n_compared} observations of flights ({by})"
    )
    content = write(network, metadata)
    files = None
    if is_app:
        words = {"name": prefix, "metadata": metadata, "vehicle": flown, **facts["plan"]}
        files = _app_files(content, words)
    return Export(content, metadata, error, network.unit, source, files)


def _own_vehicle(where: str, settings: FlightSettings, source: Path | None) -> VehicleSource:
    """Return the vehicle that an agent was trained for.

    :raises ConfigError: it flies any vehicle, or does not say which.
    """
    if source is None:
        raise ConfigError(
            f"{where}: does not say how its agent flies; if no wrapper of observations or"
            " actions lay over its environment, name its vehicle with --vehicle"
        )
    if settings.vehicles is not None:
        raise ConfigError(
            f"{where}: flies any vehicle; say with --vehicle which one's thrusts the file is to"
            " give"
        )
    vehicle: VehicleSource = settings.vehicle
    return vehicle


def _app_files(content: bytes, words: StrDict) -> dict[str, bytes]:
    """Return all files of an app around a policy, by their paths in its folder."""
    files = {HEADER: content}
    for file in FILES:
        template = f"{APP}.{file.replace('/', '.')}.j2"
        files[file] = render("sb3_quad.export", template, content=content, **words).encode()
    return files


def _describe(path: Path, network: Network, **facts: Any) -> dict[str, str]:
    """Return what users of the file must know; ASCII except for names."""
    trained = network.trained
    text = render(
        "sb3_quad.export",
        "metadata.j2",
        version=__version__,
        network=network,
        # The limits of the results are those of the extreme actions.
        limits=trained.results([[-1.0] * 4, [1.0] * 4]),
        features=FEATURES,
        places=GROUPS,
        n_parameters=parameters_to_vector(network.parameters()).numel(),
        needs=network.observation.model_dump(mode="json", exclude={"preview"}),
        **facts,
    )
    # The name of a file may contain anything, even the end of a line.
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    policy = f"{path.name} ({saved_algorithm(path)}), sha256 {digest}"
    return {"policy": policy, **dict(line.split(": ", 1) for line in text.splitlines())}
