"""A trained zip as a file that flies by itself, checked."""

import hashlib
import re
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.zips import load_model, saved_algorithm
from sb3_quad.export import load
from sb3_quad.export.c_header import c_name, write_header
from sb3_quad.export.check import N_OBSERVATIONS, Reference, compare
from sb3_quad.export.network import Network, build_network, write_onnx, write_torchscript
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.vehicles.vehicle import Vehicle, first_vehicle

FORMATS = {"onnx": ".onnx", "torchscript": ".pt", "c": ".h"}  # with the endings of their files


class Export(NamedTuple):
    """An exported policy, not yet on disk."""

    content: bytes  # the file
    metadata: dict[str, str]  # what it says about itself
    max_error: float  # the largest difference to the policy, in `unit`
    unit: str  # N or rad/s
    settings: Path | None  # the file that vehicle and scaling came from, where they were not given


def export_policy(
    path: str | Path,
    file_format: str,
    output: str = "thrusts",
    vehicle: str | Path | Vehicle | None = None,
    name: str | None = None,
    n_observations: int = N_OBSERVATIONS,
) -> Export:
    """The policy of an SB3 zip (PPO, A2C, SAC, TD3, DAgger, PPOBC, SACBC; ``MlpPolicy``) as a file
    that flies by itself.

    It takes the 18 features of an observation in physical units, see ``metadata["observation"]``.
    It gives the four rotors' thrusts (N) or speeds (rad/s), by the policy's mean action, clipped.
    Earlier frames that the policy sees are in a state, ``metadata["state"]``. A vehicle that is not
    given, and the scaling, are those that :func:`agent_settings` finds in or beside the zip, or
    else ``itm`` and Table A.2.

    :param file_format: ``onnx``, ``torchscript`` or ``c``; ``output``: ``thrusts`` or ``speeds``.
    :param vehicle: in whose body frame and order of the rotors the file speaks; its thrust limits,
        and for speeds its kF.
    :param name: the C function is called ``NAME_policy``; None: as the zip.
    :param n_observations: of the check, at most, see :func:`~sb3_quad.export.check.compare`.
    :raises ConfigError: an unknown format or output; a zip that cannot be read, whose spaces are
        not the quadcopter's or whose policy is no ``MlpPolicy``; one that flies any vehicle, and
        none is given; a vehicle whose rotors cannot be brought to where the policy knows them; a
        package or a C compiler that is not installed.
    :raises ExportError: the file computes something else than the policy, or does not compile.
    """
    prefix = c_name(Path(path).stem) if name is None else name
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", prefix):
        raise ConfigError(
            f"--name {name!r}: must be a C identifier: letters, digits and underscores, a letter first"
        )
    formats: dict[str, tuple[Callable[..., bytes], Callable[..., tuple[load.Call, str]]]] = {
        "onnx": (write_onnx, load.load_onnx),
        "torchscript": (write_torchscript, load.load_torchscript),
        "c": (partial(write_header, name=prefix), partial(load.load_header, name=prefix)),
    }
    if file_format not in formats:
        raise ConfigError(unknown("format", file_format, formats))
    write, read = formats[file_format]
    algorithm, model, (settings, source) = (
        saved_algorithm(path),
        load_model(path),
        agent_settings(path),
    )
    layout = settings.layout
    settings = settings if vehicle is None else settings.with_changes(vehicle=vehicle)
    if settings.vehicles is not None:
        raise ConfigError(
            f"model {path}: flies any vehicle; say with --vehicle which one's thrusts the file is to give"
        )
    flown = first_vehicle(settings.vehicle)
    row = QuadcopterBatch(
        1, settings.with_changes(vehicle=flown, rotor_layout=layout), n_threads=1
    )  # it checks them
    known, turn = row.vehicle_list[0], flown.turn_to(layout)
    reference = Reference(
        model, known, row.mean[:, 0], row.std[:, 0], output, row.observation, turn
    )
    network = build_network(reference, f"model {path}")
    metadata = _describe(Path(path), algorithm, network, reference, flown)
    with warnings.catch_warnings():
        # torch calls TorchScript deprecated: it still loads everywhere, also where torch.export's
        # files do not.
        warnings.simplefilter("ignore", DeprecationWarning)
        call, by = read(write(network, metadata))
        checked = compare(reference, call, by, n_observations)
        found = f"largest error {checked.error:.2g} {network.unit} in {checked.count} observations of flights"
        metadata["check"] = f"{found} ({by})"
        content = write(network, metadata)
    return Export(content, metadata, checked.error, network.unit, source)


def _describe(
    path: Path, algorithm: str, network: Network, reference: Reference, vehicle: Vehicle
) -> dict[str, str]:
    """What users of the file must know; ASCII but for names."""
    low, high = reference.results([-1.0, 1.0])
    rotors = enumerate(zip(vehicle.rotor_positions, vehicle.rotor_directions, strict=True))
    sizes = [network.steps[0][0].in_features, *(layer.out_features for layer, _ in network.steps)]
    hidden = ", ".join(activation for _, activation in network.steps[:-1]) or "none"
    mean, std = (
        ", ".join(f"{value:.6g}" for value in values)
        for values in (reference.own_mean, reference.std)
    )
    n_parameters = sum(parameter.numel() for parameter in network.parameters())
    return {
        "policy": f"{path.name} ({algorithm}), sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}",
        "made_by": f"sb3_quad {__version__}",
        "vehicle": f"{vehicle.name}: hover thrust {vehicle.hover_thrust:.6g} N, kF {vehicle.thrust_coefficient:.6g} N s^2",
        "frames": "world: z up; body: x forward, y left, z up",
        "observation": "18 numbers, not scaled: 0-2 position minus target position, world frame, m; "
        "3-11 rotation matrix world to body (v_body = R v_world), row by row; "
        "12-14 linear velocity, body frame, m/s; 15-17 body rates, body frame, rad/s",
        **network.facts,
        "result": f"4 numbers: the {network.output.removesuffix('s')} to command of each rotor, {network.unit}, "
        f"within {low:.6g} to {high:.6g}",
        "rotors": "; ".join(
            f"{k} at x {x:.4g} m, y {y:.4g} m, yaw moment {sign:+d}"[:-1]
            for k, ((x, y), sign) in rotors
        ),
        "period": f"{vehicle.control_step:g} s between calls, as in training",
        "scaling": f"done inside, (x - mean) / std with mean {mean} and std {std}",
        "network": f"{'-'.join(map(str, sizes))}, hidden layers {hidden}, {n_parameters} float32 parameters",
        "check": "pending",
    }
