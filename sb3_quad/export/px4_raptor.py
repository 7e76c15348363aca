"""A recurrent policy as the ``policy.tar`` that PX4's ``mc_raptor`` loads from its SD card (docs/px4.md).

Source of the layout: rl_tools, ``persist/backends/tar`` and ``nn/layers/{dense,gru}/persist.h``; of what is done with it:
PX4-Autopilot, ``src/modules/mc_raptor/mc_raptor.cpp``.
"""

import hashlib
import io
import re
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_quad.base.arrays import BoolArray, Float32Array
from sb3_quad.base.errors import ConfigError, ExportError
from sb3_quad.experts.models import load_model, saved_algorithm
from sb3_quad.experts.raptor_frame import idle_share, motor_order, rotor_thrusts, seen
from sb3_quad.export import check
from sb3_quad.export.policy import Export
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.memory import Memory
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

FILE = "policy.tar"
SIZES = (22, 16, 16, 4)  # inputs, first layer, GRU, motors: the type that mc_raptor is compiled for
CONTROL_STEP = 0.01  # s; POLICY_CONTROL_FREQUENCY_TRAINING of mc_raptor is 100 Hz
EXAMPLE_STEPS, EXAMPLE_BATCH = 100, 2  # mc_raptor compares the first five steps of a batch of two
MAX_NAME = 99  # characters; CHECKPOINT_NAME_LENGTH of mc_raptor, with the zero at its end, is 100
_FLOATS = np.dtype("<f4")
_DENSE, _GRU = ("weights", "biases"), ("weights_input", "biases_input", "weights_hidden", "biases_hidden")
_LAYERS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("actor/layers/0", _DENSE, "activation_function: RELU\ntype: dense\n"),
    ("actor/layers/1", (*_GRU, "initial_hidden_state"), "type: gru\n"),
    ("actor/layers/2", _DENSE, "activation_function: IDENTITY\ntype: dense\n"),
)
ROTORS = "motor commands of front right, back right, back left, front left; (command + 1) / 2 goes to actuator_motors"


class TarPolicy:
    """What a ``policy.tar`` computes, by numpy: a reader of its own, for the check.

    :param content: the file.
    :raises ExportError: an entry is missing, or of another shape than its data.
    """

    def __init__(self, content: bytes) -> None:
        with tarfile.open(fileobj=io.BytesIO(content)) as archive:
            self._files = {member.name: archive.extractfile(member).read() for member in archive}  # type: ignore[union-attr]
        self.name = self._meta("actor/meta").get("checkpoint_name", "")
        arrays = [[self.array(f"{layer}/{part}/parameters") for part in parts] for layer, parts, _ in _LAYERS]
        (self._first, self._gru, self._last) = arrays

    def step(self, inputs: Float32Array, hidden: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Motor commands, (n, 4), not clipped, and the next hidden state, (n, 16), of inputs, (n, 22), and the present one."""
        weights_input, biases_input, weights_hidden, biases_hidden, _ = self._gru
        x = np.maximum(inputs @ self._first[0].T + self._first[1], 0.0)
        of_x, of_h = x @ weights_input.T + biases_input, hidden @ weights_hidden.T + biases_hidden
        (reset, update, new), (h_reset, h_update, h_new) = (np.split(each, 3, axis=1) for each in (of_x, of_h))
        reset, update = (1.0 / (1.0 + np.exp(-each)) for each in (reset + h_reset, update + h_update))
        hidden = (update * hidden + (1.0 - update) * np.tanh(new + reset * h_new)).astype(np.float32)
        return hidden @ self._last[0].T + self._last[1], hidden

    def start(self, n: int) -> Float32Array:
        """The hidden state of n flights that begin, (n, 16)."""
        return np.tile(self._gru[-1], (n, 1))

    def array(self, path: str) -> Float32Array:
        """The tensor at ``path``, by its ``meta``."""
        meta = self._meta(f"{path}/meta")
        try:
            shape = [int(meta[f"dim_{k}"]) for k in range(int(meta["num_dims"]))]
            return np.frombuffer(self._files[f"{path}/data"], dtype=_FLOATS).reshape(shape)
        except (KeyError, ValueError) as error:
            raise ExportError(f"policy.tar: {path} cannot be read ({error})") from None

    def _meta(self, path: str) -> dict[str, str]:
        lines = self._files.get(path, b"").decode("ascii").splitlines()
        return dict(line.split(": ", 1) for line in lines)


class _Flights:
    """A ``policy.tar`` in flight, as ``mc_raptor`` flies it: rl_tools' executor clips the commands, so the last ones, too."""

    def __init__(self, policy: TarPolicy, vehicle: Vehicle) -> None:
        self._policy, self._vehicle, self._order = policy, vehicle, motor_order(vehicle, "mc_raptor")
        self._hidden, self._last = policy.start(1), np.zeros((1, SIZES[-1]), dtype=np.float32)
        self.inputs: list[Float32Array] = []

    def __call__(self, features: Float32Array, begins: BoolArray) -> Float32Array:
        """Thrusts, (n, 4), N, of the features in physical units, (n, 18), and which flights begin."""
        rows = begins[:, None]
        hidden = np.where(rows, self._policy.start(1), self._hidden)
        inputs = np.hstack([seen(th.from_numpy(features)).numpy(), np.where(rows, np.float32(0.0), self._last)])
        commands, self._hidden = self._policy.step(inputs, hidden)
        self.inputs.append(inputs)
        self._last = commands.clip(-1.0, 1.0)
        return rotor_thrusts(self._vehicle, self._order, self._last).astype(np.float32)


def export_px4_raptor(
    path: str | Path, vehicle: str | Path | Vehicle | None = None, n_observations: int = check.N_OBSERVATIONS
) -> Export:
    """The policy of a recurrent agent's zip as ``policy.tar``, checked in closed-loop flights.

    The bytes depend on the weights, the zip's name and the vehicle alone.

    :param path: a zip whose policy is :class:`~sb3_quad.recurrent.raptor_policy.RaptorPolicy`.
    :param vehicle: what it flies; None: as its zip or its run's settings say.
    :param n_observations: of the check, whole flights of ``check.FLIGHT_STEPS``; at least two.
    :raises ConfigError: another policy, another size, or another observation than ``mc_raptor`` gives; rotors that it does not
        fly.
    :raises ExportError: the file computes something else than the policy.
    """
    model, (settings, source) = load_model(path), FlightSettings.of(path)
    if vehicle is not None:
        settings = settings.with_changes(vehicle=vehicle)
    elif settings.vehicles is not None:  # one of those that it flies, for the check
        settings = settings.with_changes(vehicle=settings.vehicles.weakest(load_vehicle(settings.vehicle)))
    row = QuadcopterBatch(1, **dict(settings), n_threads=1)  # it checks them
    reference = check.Reference(model, row.vehicle_list[0], row.mean[:, 0], row.std[:, 0], "thrusts", row.memory)
    layers = _check(reference, path)
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", Path(path).stem)[:MAX_NAME] or "policy"
    parameters = _parameters(*layers)
    flights = _Flights(TarPolicy(_write(parameters, name)), reference.vehicle)
    _, error, extent = reference.fly(flights, n_observations, f"numpy {np.__version__}")
    inputs = np.stack([each[:EXAMPLE_BATCH] for each in flights.inputs[:EXAMPLE_STEPS]])
    example = {"example/input": inputs, "example/output": _outputs(layers, inputs)}
    metadata = _describe(Path(path), reference, error, extent, name, sum(map(np.size, parameters.values())))
    return Export(_write({**parameters, **example}, name), metadata, error, "N", None, source)


def _refusal(path: str | Path, found: str) -> str:
    wanted = "mc_raptor is compiled for 22-16-GRU 16-4 and loads nothing else"
    return f"model {path}: its policy is {found}; {wanted}: train one with RaptorPolicy (docs/px4.md)"


def _check(reference: check.Reference, path: str | Path) -> tuple[th.nn.Linear, th.nn.GRU, th.nn.Linear]:
    """The layers of a policy that ``mc_raptor`` can fly."""
    policy: Any = reference.model.policy
    if not hasattr(policy, "layers"):
        raise ConfigError(_refusal(path, f"{type(policy).__name__} of {saved_algorithm(path)}"))
    first, gru, last = layers = policy.layers()
    sizes = (first.in_features, first.out_features, gru.hidden_size, last.out_features)
    if sizes != SIZES or gru.num_layers != 1 or policy.squash_output:
        a, b, c, d = sizes
        deep = f"{gru.num_layers} x GRU" if gru.num_layers > 1 else "GRU"
        squashed = " with tanh" * policy.squash_output
        raise ConfigError(_refusal(path, f"{a}-{b}-{deep} {c}-{d}{squashed}"))
    vehicle = reference.vehicle
    if reference.memory != Memory(last_action=True):
        raise ConfigError(
            f"model {path}: mc_raptor shows it the last command and nothing older; fly it with last_action alone"
        )
    if not (np.allclose(reference.mean, DEFAULT_MEAN) and np.allclose(reference.std, DEFAULT_STD)):
        raise ConfigError(f"model {path}: RaptorPolicy undoes the scaling of Table A.2, this one was shown another")
    order, idle = motor_order(vehicle, "mc_raptor"), idle_share(vehicle)
    if list(policy.motors) != order or abs(policy.idle - idle) > 1e-5:
        trained = f"was trained with motors {list(policy.motors)} and idle {policy.idle:.6g}"
        raise ConfigError(f"model {path}: {trained}, {vehicle.name} has motors {order} and idle {idle:.6g} (policy_kwargs)")
    if abs(vehicle.control_step - CONTROL_STEP) > 1e-9:
        raise ConfigError(f"model {path}: control_step of {vehicle.name} is {vehicle.control_step:g} s, of mc_raptor 0.01 s")
    return layers  # type: ignore[no-any-return]


def _parameters(first: th.nn.Linear, gru: th.nn.GRU, last: th.nn.Linear) -> dict[str, Float32Array]:
    """By path, the tensors of the network; the gates of the GRU are reset, update, new, as PyTorch has them."""
    arrays: list[list[Any]] = [
        [first.weight, first.bias],
        [gru.weight_ih_l0, gru.bias_ih_l0, gru.weight_hh_l0, gru.bias_hh_l0, th.zeros(gru.hidden_size)],
        [last.weight, last.bias],
    ]
    return {
        f"{layer}/{part}/parameters": tensor.detach().cpu().numpy()
        for (layer, parts, _), tensors in zip(_LAYERS, arrays, strict=True)
        for part, tensor in zip(parts, tensors, strict=True)
    }


@th.no_grad()
def _outputs(layers: tuple[th.nn.Linear, th.nn.GRU, th.nn.Linear], inputs: Float32Array) -> Float32Array:
    """Motor commands, (steps, batch, 4), of inputs, (steps, batch, 22), from a hidden state of zeros, by PyTorch."""
    first, gru, last = layers
    hidden = th.zeros(1, inputs.shape[1], gru.hidden_size)
    outputs, _ = gru(first(th.from_numpy(inputs)).relu(), (hidden, hidden))
    return np.asarray(last(outputs).numpy())


def _write(tensors: Mapping[str, Float32Array], name: str) -> bytes:
    """The archive; its bytes are the same for the same tensors and name."""
    files = {"actor/meta": f"checkpoint_name: {name}\ntype: sequential\n".encode("ascii")}
    files |= {f"{layer}/meta": text.encode("ascii") for layer, _, text in _LAYERS}
    for path, array in tensors.items():
        sizes = "".join(f"dim_{k}: {size}\n" for k, size in enumerate(array.shape))
        files[f"{path}/meta"] = f"type: tensor\ndtype: float32\nnum_dims: {array.ndim}\n{sizes}".encode("ascii")
        files[f"{path}/data"] = np.ascontiguousarray(array, dtype=_FLOATS).tobytes()
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for path, content in files.items():
            member = tarfile.TarInfo(path)  # of no one, at the beginning of time
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return buffer.getvalue()


def _describe(
    path: Path, reference: check.Reference, error: float, extent: str, name: str, n_parameters: int
) -> dict[str, str]:
    vehicle = reference.vehicle
    return {
        "policy": f"{path.name}, sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}",
        "vehicle": f"{vehicle.name}: least over greatest rotor speed {idle_share(vehicle):.6g}",
        "network": f"22-16-GRU 16-4, {n_parameters} float32 parameters",
        "observation": "22 numbers, as mc_raptor gives them: position error, at most 0.5 m; rotation body to world; "
        "velocity error, at most 1 m/s; body rates; last command; world x forward, y left, z up",
        "result": ROTORS,
        "checkpoint_name": name,
        "check": f"largest error {error:.2g} N in {extent}",
    }
