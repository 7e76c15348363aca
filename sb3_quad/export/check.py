"""An exported file, run as its users run it, against the policy it came from: the largest difference, the time of a call."""

import ctypes
import io
import itertools
import json
import shutil
import subprocess
import tempfile
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.base.arrays import BoolArray, Float32Array, FloatArray
from sb3_quad.base.errors import ConfigError, ExportError
from sb3_quad.base.imports import require
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.frames import ObservationSettings
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, GROUPS, OBSERVATION_SIZE
from sb3_quad.simulation.settings import FlightSettings
from sb3_quad.simulation.tasks import Task
from sb3_quad.vehicles.vehicle import Vehicle

N_OBSERVATIONS = 10_000  # half of them from flights, half of random states; with a memory all from flights
FLIGHT_STEPS = 1000  # of the flights of a policy with a memory
TOLERANCE = 1e-4  # of the range between least and greatest output: far above rounding, far below any mistake
CALLS, ROUNDS = 2000, 5  # that are timed: with one observation each, or with all at once
N_ROTORS = 4
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
_FLIGHTS, _EVERY = 50, 5  # flights side by side, and control steps from one kept observation to the next
_TASK = "recovery_and_tracking"
_WIDE = {"target_distance": 30.0, "nearest_target": 0.0, "velocity_std": 4.0, "body_rates_std": 8.0}
_UNSCALED: dict[str, Any] = {"observation_mean": np.zeros(OBSERVATION_SIZE), "observation_std": np.ones(OBSERVATION_SIZE)}
_NEAR = Task(name="near", target_distance=1.0, nearest_target=0.0)  # where a position integral is at work at once
_ROUNDING = 2e-6  # relative, of what decides whether the position integral is at work
Call = Callable[..., Float32Array]


class Reference(NamedTuple):
    """A trained policy in its own environment: what an exported file must agree with.

    :param mean: μ of Eq. 3.16, (18,), as in training; ``std`` σ, likewise.
    :param output: ``thrusts`` (N) or ``speeds`` (rad/s).
    :param memory: what the policy sees beside the 18 features.
    """

    model: BaseAlgorithm
    vehicle: Vehicle
    mean: FloatArray = DEFAULT_MEAN
    std: FloatArray = DEFAULT_STD
    output: str = "thrusts"
    memory: ObservationSettings = ObservationSettings()

    def actions(self, observations: Float32Array) -> Any:
        """The policy's actions, (n, 4), for observations in physical units, (n, 18), scaled as in training (Eq. 3.16)."""
        scaled = (observations - np.float32(self.mean)) * np.float32(1.0 / self.std)
        return self.model.predict(scaled, deterministic=True)[0]

    def results(self, actions: npt.ArrayLike) -> FloatArray:
        """Rotor thrusts, N (Eq. 3.18), or speeds, rad/s (Eq. 2.4), of actions of any shape; in float64."""
        thrusts = self.vehicle.action_to_thrust(np.asarray(actions, dtype=np.float64))
        return thrusts if self.output == "thrusts" else np.sqrt(thrusts / self.vehicle.thrust_coefficient)

    def sample_observations(self, n: int) -> Float32Array:
        """Noisy observations in physical units, (n, 18): half from flights of the policy, half of random states.

        The flights are of recovery and tracking, up to 20 m. The random states: any attitude, up to 30 m from the target,
        velocity N(0, 4 m/s) and body rates N(0, 8 rad/s) per axis, which is twice what an episode starts with.
        """
        half = n // 2
        rows = min(_FLIGHTS, half)
        flights = QuadcopterBatch(rows, FlightSettings(task=_TASK, vehicle=self.vehicle, **_UNSCALED), seed=0, n_threads=1)
        observations, kept = flights.reset(), list[Float32Array]()
        while len(kept) * rows < half:
            kept.append(observations)
            for _ in range(_EVERY):
                observations = flights.step(self.actions(observations))[0]
        others = QuadcopterBatch(
            half, FlightSettings(task=_TASK, task_kwargs=_WIDE, vehicle=self.vehicle, **_UNSCALED), rows, n_threads=1
        )
        return np.concatenate([np.concatenate(kept)[:half], others.reset()])

    def fly(self, call: Call, n: int, by: str) -> tuple[Float32Array, float, str]:
        """Let a file with a memory fly, and compare each of its results with the policy's own in the same environment.

        The file sees the 18 features and keeps its own state from a flight's first step to its last; the policy sees what the
        environment remembers, also of the actions that the file has flown. About half of the flights begin near their target.

        :param call: of the file; ``n`` observations in all, of flights side by side; ``by``, what runs it.
        :return: the observations in physical units, (n, 18); the largest difference, N or rad/s; how far it was flown.
        :raises ExportError: see :meth:`largest_error`.
        """
        rows, tasks, integral = max(n // FLIGHT_STEPS, 1), cast(Any, {_TASK: 1.0, _NEAR: 1.0}), self.memory.position_integral
        same: dict[str, Any] = {"task": tasks, "vehicle": self.vehicle, "max_episode_steps": FLIGHT_STEPS}
        seeing = {"observation_mean": self.mean, "observation_std": self.std, **dict(self.memory)}
        env, twin = (QuadcopterBatch(rows, FlightSettings(**same, **each), 0, n_threads=1) for each in (seeing, _UNSCALED))
        limits = {"position": integral.distance, "velocity": integral.speed} if integral else {}
        seen, features, begins, sure = env.reset(), twin.reset(), np.ones(rows, bool), np.zeros(rows, bool)
        state: Any = None  # of a recurrent policy
        errors, kept = [0.0], list[Float32Array]()
        for _ in range(FLIGHT_STEPS):
            kept.append(features)
            sure |= begins
            for group, limit in limits.items():  # so close to one, rounding may begin to integrate a step later, or earlier
                sure &= np.abs(np.linalg.norm(features[:, GROUPS[group]], axis=1) / limit - 1.0) > _ROUNDING
            results = call(features, begins)
            actions, state = self.model.predict(seen, state, begins, deterministic=True)
            if sure.any():
                errors.append(self.largest_error(actions[sure], results[sure], by))
            thrusts = results if self.output == "thrusts" else self.vehicle.thrust_coefficient * np.square(results)
            flown = self.vehicle.thrust_to_action(np.asarray(thrusts, dtype=np.float64))
            (seen, _, begins), (features, _, _) = env.step(flown), twin.step(flown)
        return np.concatenate(kept), max(errors), f"closed-loop flights of {FLIGHT_STEPS} control steps, {rows} side by side"

    def largest_error(self, actions: Any, results: Float32Array, by: str) -> float:
        """The largest difference of any rotor, N or rad/s.

        :param actions: of the policy, (n, 4).
        :param results: of the file, (n, 4), which ``by`` ran.
        :raises ExportError: a difference above ``TOLERANCE`` of the range, or a result that is not finite.
        """
        error = float(np.abs(results - self.results(actions)).max())
        allowed = TOLERANCE * float(np.ptp(self.results([-1.0, 1.0])))
        if not error <= allowed:  # also where it is NaN
            difference = f"differs from the trained one by {error:.3g}, {allowed:.3g} is allowed ({by})"
            raise ExportError(f"the exported policy {difference}; nothing was written")
        return error


def load_torchscript(content: bytes) -> tuple[Call, str]:
    """What computes results, (n, 4), from observations, (n, 18): the file as torch loads it on the CPU. And its version.

    Of a file with a memory it also takes which of n flights side by side begin, bool (n,), and holds their states
    from call to call. Without that argument, a flight goes on.
    """
    extra = {"metadata.json": ""}
    module = th.jit.load(io.BytesIO(content), "cpu", extra)  # type: ignore[no-untyped-call]
    size = int(json.loads(extra["metadata.json"]).get("state_size", 0))

    @th.no_grad()
    def run(*inputs: Float32Array) -> Any:
        given = module(*map(th.from_numpy, inputs))
        return [each.numpy() for each in given] if size else given.numpy()

    return (_with_states(run, size) if size else run), f"torch {th.__version__}"


def _with_states(run: Callable[..., Any], size: int) -> Call:
    """``run``, from observations and states to results and next states, as a call that holds the states, ``size`` each."""
    held = np.zeros((1, size), dtype=np.float32)

    def call(rows: Float32Array, begins: BoolArray | None = None) -> Float32Array:
        nonlocal held
        held = held[: len(rows)] if begins is None else np.where(begins[:, None], np.float32(0.0), held)
        results, held = run(rows, held)
        return np.asarray(results)

    return call


def load_onnx(content: bytes) -> tuple[Call, str]:
    """As :func:`load_torchscript`, by onnxruntime on one thread of the CPU.

    :raises ConfigError: it is not installed.
    """
    runtime = require("onnxruntime", "export", "--format onnx")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    by, state = f"onnxruntime {runtime.__version__}", session.get_inputs()[1:]
    if not state:
        return lambda rows: session.run(None, {"observation": rows})[0], by
    return _with_states(lambda rows, held: session.run(None, {"observation": rows, "state": held}), state[0].shape[1]), by


def load_header(content: bytes, name: str) -> tuple[Call, str]:
    """As :func:`load_torchscript`, of a C header by the machine's compiler.

    :param name: the beginning of the header's identifiers.
    :raises ConfigError: there is no compiler.
    :raises ExportError: the header does not compile without warnings.
    """
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        raise ConfigError("--format c needs a C compiler, to check what it writes: install gcc or clang (apt install gcc)")
    remembers = f"}} {name}_state;".encode() in content
    instead = "" if remembers else f"typedef char {name}_state;\n#define {name}_reset(state) (*(state) = 0)\n"
    program = f"""\
#include "policy.h"
{instead}int size(void) {{ return (int)sizeof({name}_state); }}
void run(const float *in, float *out, {name}_state *states, const unsigned char *begins, long n, long flights)
{{
    for (long k = 0; k < n; ++k) {{
        {name}_state *state = &states[k % flights];
        if (begins[k]) {name}_reset(state);
        {name}_policy({"state, " * remembers}in + {OBSERVATION_SIZE} * k, out + {N_ROTORS} * k);
    }}
}}
"""
    with tempfile.TemporaryDirectory(prefix="sb3_quad_") as folder:
        (Path(folder) / "policy.h").write_bytes(content)
        (Path(folder) / "run.c").write_text(program, encoding="ascii")
        command = (compiler, *FLAGS, "-shared", "-fPIC", "-o", "run.so", "run.c", "-lm")
        try:
            subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
            library = ctypes.CDLL(str(Path(folder) / "run.so"))
        except (OSError, subprocess.CalledProcessError) as error:
            said = " ".join(str(getattr(error, "stderr", error)).split())[:200]
            raise ExportError(f"the C header cannot be checked: {compiler} failed ({said})") from None
    held = np.zeros((1, library.size()), dtype=np.uint8)

    def call(rows: Float32Array, begins: BoolArray | None = None) -> Float32Array:
        nonlocal held
        if begins is None:  # the rows are one flight's
            held, begins = held[:1], np.zeros(len(rows), dtype=bool)
        elif begins.all():
            held = np.full((len(rows), held.shape[1]), 0xFF, dtype=np.uint8)  # as a struct may be before its reset
        results = np.empty((len(rows), N_ROTORS), dtype=np.float32)
        arrays = map(np.ctypeslib.as_ctypes, (rows, results, held, begins.view(np.uint8)))
        library.run(*arrays, ctypes.c_long(len(rows)), ctypes.c_long(len(held)))
        return results

    return call, f"{Path(compiler).name} {' '.join(FLAGS)}"


def time_calls(call: Call, observations: Float32Array, at_once: bool = False) -> float:
    """Median time per observation, µs, of calls with one observation each, or ``at_once`` with all of them."""
    parts = itertools.cycle(observations[None] if at_once else observations[:, None])
    times = timeit.repeat(lambda: call(next(parts)), number=1, repeat=ROUNDS if at_once else CALLS)
    return float(np.median(times)) * 1e6 / (len(observations) if at_once else 1)
