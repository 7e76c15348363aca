"""An exported file, run as its users run it, against the policy it came from: the largest difference, the time of a call."""

import ctypes
import io
import itertools
import shutil
import subprocess
import tempfile
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.base.arrays import Float32Array, FloatArray
from sb3_quad.base.errors import ConfigError, ExportError
from sb3_quad.base.imports import require
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE
from sb3_quad.vehicles.vehicle import Vehicle

N_OBSERVATIONS = 10_000  # half of them from flights, half of random states
TOLERANCE = 1e-4  # of the range between least and greatest output: far above rounding, far below any mistake
CALLS, ROUNDS = 2000, 5  # that are timed: with one observation each, or with all at once
N_ROTORS = 4
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
_FLIGHTS, _EVERY = 50, 5  # flights side by side, and control steps from one kept observation to the next
_TASK = "recovery_and_tracking"
_WIDE = {"target_distance": 30.0, "nearest_target": 0.0, "velocity_std": 4.0, "body_rates_std": 8.0}
Call = Callable[[Float32Array], Float32Array]


class Reference(NamedTuple):
    """A trained policy in its own environment: what an exported file must agree with.

    :param mean: μ of Eq. 3.16, (18,), as in training; ``std`` σ, likewise.
    :param output: ``thrusts`` (N) or ``speeds`` (rad/s).
    """

    model: BaseAlgorithm
    vehicle: Vehicle
    mean: FloatArray = DEFAULT_MEAN
    std: FloatArray = DEFAULT_STD
    output: str = "thrusts"

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
        scaling: dict[str, Any] = {"observation_mean": np.zeros_like(self.mean), "observation_std": np.ones_like(self.std)}
        flights = QuadcopterBatch(rows, _TASK, vehicle=self.vehicle, seed=0, n_threads=1, **scaling)
        observations, kept = flights.reset(), list[Float32Array]()
        while len(kept) * rows < half:
            kept.append(observations)
            for _ in range(_EVERY):
                observations = flights.step(self.actions(observations))[0]
        others = QuadcopterBatch(half, _TASK, _WIDE, self.vehicle, seed=rows, n_threads=1, **scaling)
        return np.concatenate([np.concatenate(kept)[:half], others.reset()])

    def largest_error(self, observations: Float32Array, results: Float32Array, by: str) -> float:
        """The largest difference of any rotor in any observation, N or rad/s.

        :param results: of the file, (n, 4), which ``by`` ran.
        :raises ExportError: a difference above ``TOLERANCE`` of the range, or a result that is not finite.
        """
        error = float(np.abs(results - self.results(self.actions(observations))).max())
        allowed = TOLERANCE * float(np.ptp(self.results([-1.0, 1.0])))
        if not error <= allowed:  # also where it is NaN
            difference = f"differs from the trained one by {error:.3g}, {allowed:.3g} is allowed ({by})"
            raise ExportError(f"the exported policy {difference}; nothing was written")
        return error


def load_torchscript(content: bytes) -> tuple[Call, str]:
    """What computes results, (n, 4), from observations, (n, 18): the file as torch loads it on the CPU. And its version."""
    module = th.jit.load(io.BytesIO(content), map_location="cpu")  # type: ignore[no-untyped-call]
    return th.no_grad()(lambda rows: module(th.from_numpy(rows)).numpy()), f"torch {th.__version__}"


def load_onnx(content: bytes) -> tuple[Call, str]:
    """As :func:`load_torchscript`, by onnxruntime on one thread of the CPU.

    :raises ConfigError: it is not installed.
    """
    runtime = require("onnxruntime", "export", "--format onnx")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    return lambda rows: session.run(None, {"observation": rows})[0], f"onnxruntime {runtime.__version__}"


def load_header(content: bytes, name: str) -> tuple[Call, str]:
    """As :func:`load_torchscript`, of a C header by the machine's compiler.

    :param name: the beginning of the header's identifiers.
    :raises ConfigError: there is no compiler.
    :raises ExportError: the header does not compile without warnings.
    """
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        raise ConfigError("--format c needs a C compiler, to check what it writes: install gcc or clang (apt install gcc)")
    with tempfile.TemporaryDirectory(prefix="sb3_quad_") as folder:
        (Path(folder) / "policy.h").write_bytes(content)
        loop = f"for (; n > 0; --n, in += {OBSERVATION_SIZE}, out += {N_ROTORS}) {name}_policy(in, out);"
        program = f'#include "policy.h"\nvoid run(const float *in, float *out, long n)\n{{\n    {loop}\n}}\n'
        (Path(folder) / "run.c").write_text(program, encoding="ascii")
        command = (compiler, *FLAGS, "-shared", "-fPIC", "-o", "run.so", "run.c", "-lm")
        try:
            subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
            library = ctypes.CDLL(str(Path(folder) / "run.so"))
        except (OSError, subprocess.CalledProcessError) as error:
            said = " ".join(str(getattr(error, "stderr", error)).split())[:200]
            raise ExportError(f"the C header cannot be checked: {compiler} failed ({said})") from None

    def call(rows: Float32Array) -> Float32Array:
        results = np.empty((len(rows), N_ROTORS), dtype=np.float32)
        library.run(*map(np.ctypeslib.as_ctypes, (rows, results)), ctypes.c_long(len(rows)))
        return results

    return call, f"{Path(compiler).name} {' '.join(FLAGS)}"


def time_calls(call: Call, observations: Float32Array, at_once: bool = False) -> float:
    """Median time per observation, µs, of calls with one observation each, or ``at_once`` with all of them."""
    parts = itertools.cycle(observations[None] if at_once else observations[:, None])
    times = timeit.repeat(lambda: call(next(parts)), number=1, repeat=ROUNDS if at_once else CALLS)
    return float(np.median(times)) * 1e6 / (len(observations) if at_once else 1)
