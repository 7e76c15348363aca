"""``export_policy``: a trained zip as a file of one of the formats, checked against the policy and timed."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy.typing as npt

from sb3_quad import __version__
from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.experts.models import load_model, saved_algorithm
from sb3_quad.export import c_header, c_trial, onnx, torchscript
from sb3_quad.export.check import N_OBSERVATIONS, Trial, draw_samples, largest_error
from sb3_quad.export.network import Float32Array, Network, build_network, result_range
from sb3_quad.settings.trained_with import trained_with
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

FORMATS = {"onnx": ".onnx", "torchscript": ".pt", "c": ".h"}
"""Each format and the ending of its files."""
_SIGN = {1: "+", -1: "-"}


@dataclass(frozen=True)
class Export:
    """An exported policy, not yet on disk.

    :param content: the file.
    :param metadata: what it says about itself.
    :param max_error: the largest difference to the policy, in ``unit``.
    :param unit: ``N`` or ``rad/s``.
    :param microseconds: per call with one observation, on one thread; None where it could not be run.
    :param checked_by: what ran it.
    :param settings: the file that vehicle and scaling came from, where they were not given.
    """

    content: bytes
    metadata: dict[str, str]
    max_error: float
    unit: str
    microseconds: float | None
    checked_by: str
    settings: str


def export_policy(
    path: str | Path,
    file_format: str,
    output: str = "thrusts",
    vehicle: str | Path | Vehicle | None = None,
    observation_mean: npt.ArrayLike | None = None,
    observation_std: npt.ArrayLike | None = None,
    name: str | None = None,
    n_observations: int = N_OBSERVATIONS,
) -> Export:
    """The policy of an on-policy SB3 zip (PPO, A2C, DAgger, PPOBC; ``MlpPolicy``) as a file that flies by itself.

    What it is given are the 18 features of an observation in physical units, see ``metadata["observation"]``; what it gives
    are the four rotors' thrusts (N) or speeds (rad/s), by the policy's mean action, clipped. Vehicle and scaling that are
    not given are those of the settings in the zip's run folder, or else ``itm`` and Table A.2.

    :param file_format: ``onnx``, ``torchscript`` or ``c``.
    :param output: ``thrusts`` or ``speeds``.
    :param vehicle: its hover thrust and thrust limits, and for speeds its kF.
    :param observation_mean: μ of Eq. 3.16, (18,); ``observation_std`` σ, likewise.
    :param name: the C function is called ``NAME_policy``; None: as the zip.
    :param n_observations: of the check; even.
    :raises ConfigError: an unknown format or output, a zip that cannot be read, whose spaces are not the quadcopter's or
        whose policy is no ``MlpPolicy``, or a package that the format needs and that is not installed.
    :raises ExportError: the file computes something else than the policy, or does not compile.
    """
    if file_format not in FORMATS:
        raise ConfigError(unknown("format", file_format, FORMATS))
    prefix = c_header.c_name(Path(path).stem) if name is None else c_header.check_name(name)
    algorithm, model = saved_algorithm(path), load_model(path)
    given = trained_with(path)
    flown = load_vehicle(vehicle if vehicle is not None else given.vehicle or "itm")
    mean = given.observation_mean if observation_mean is None else observation_mean
    std = given.observation_std if observation_std is None else observation_std
    network = build_network(model, flown, output, mean, std, f"model {path}")
    samples = draw_samples(model, flown, mean, std, n_observations)
    metadata = _describe(Path(path), algorithm, network, flown)
    trial = _run(file_format, _write(file_format, network, metadata, prefix), samples.physical, prefix, network)
    error = largest_error(model, samples, trial, flown, network.output)
    count = len(samples.physical)
    metadata["check"] = f"largest error {error:.2g} {network.unit} in {count} observations ({trial.by})"
    content = _write(file_format, network, metadata, prefix)
    return Export(content, metadata, error, network.unit, trial.microseconds, trial.by, given.source)


def _write(file_format: str, network: Network, metadata: dict[str, str], prefix: str) -> bytes:
    if file_format == "c":
        return c_header.write(network, metadata, prefix)
    return onnx.write(network, metadata) if file_format == "onnx" else torchscript.write(network, metadata)


def _run(file_format: str, content: bytes, observations: Float32Array, prefix: str, network: Network) -> Trial:
    if file_format == "c":
        return c_trial.run(content, observations, prefix, network)
    return onnx.run(content, observations) if file_format == "onnx" else torchscript.run(content, observations)


def _describe(path: Path, algorithm: str, network: Network, vehicle: Vehicle) -> dict[str, str]:
    """What users of the file must know; ASCII but for names."""
    low, high = result_range(vehicle, network.output)
    what = "thrust" if network.output == "thrusts" else "speed"
    rotors = enumerate(zip(vehicle.rotor_positions, vehicle.rotor_directions, strict=True))
    sizes = [len(network.mean), *(len(layer.bias) for layer in network.layers)]
    hidden = ", ".join(layer.activation for layer in network.layers[:-1]) or "none"
    std = _compact([f"{1.0 / value:.6g}" for value in network.inverse_std])
    mean = _compact([f"{value:.6g}" for value in network.mean])
    facts: dict[str, Any] = {
        "policy": f"{path.name} ({algorithm}), sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}",
        "made_by": f"sb3_quad {__version__}",
        "vehicle": f"{vehicle.name}: hover thrust {vehicle.hover_thrust:.6g} N, kF {vehicle.thrust_coefficient:.6g} N s^2",
        "frames": "world: z up; body: x forward, y left, z up",
        "observation": "18 numbers, not scaled: 0-2 position minus target position, world frame, m; "
        "3-11 rotation matrix world to body (v_body = R v_world), row by row; "
        "12-14 linear velocity, body frame, m/s; 15-17 body rates, body frame, rad/s",
        "result": f"4 numbers: the {what} to command of each rotor, {network.unit}, within {low:.6g} to {high:.6g}",
        "rotors": "; ".join(f"{k} at x {x:.4g} m, y {y:.4g} m, yaw moment {_SIGN[sign]}" for k, ((x, y), sign) in rotors),
        "period": f"{vehicle.control_step:g} s between calls, as in training",
        "scaling": f"done inside, (x - mean) / std with mean {mean} and std {std}",
        "network": f"{'-'.join(map(str, sizes))}, hidden layers {hidden}, {network.n_parameters} float32 parameters",
        "check": "pending",
    }
    return facts


def _compact(words: list[str]) -> str:
    """Equal words in a row once, with how many they are: ``5.7735 (3 times), 1.73205 (9 times)``."""
    return ", ".join(f"{word} ({len(list(group))} times)" for word, group in groupby(words))
