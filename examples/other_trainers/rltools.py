r"""Train a Crazyflie by RLtools' L2F trainer, and fly its policy from the thesis's starts.

    git clone https://github.com/rl-tools/rl-tools && git -C rl-tools checkout 9acdf5c
    OMP_NUM_THREADS=1 python examples/other_trainers/rltools.py rl-tools --seeds 0 1 2

You need g++. The trainer is compiled as in the README of its zoo, for this processor and without
evaluations during the training. It trains for the number of steps that its authors set, unless you
give ``--steps``. The CPU seconds are those of its whole process, without compiling.

The trainer's own episodes last 10 s at most and end 1 m off a moving reference; it prints their
mean length, over 100 episodes. Its policy then flies here, on the vehicle that it was trained for
(l2f_zoo.yaml), with the noise of the thesis and without delay, for 15 s. Gentle starts are level
and at rest at the target; recoveries are from the thesis's starts.
"""

import argparse
import re
import resource
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from table import HEADER, print_row

from sb3_quad import fly, load_vehicle
from sb3_quad.envs.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE

Array = npt.NDArray[Any]
VEHICLE = load_vehicle(Path(__file__).with_name("l2f_zoo.yaml"))
GENTLE = {"random_attitude": False, "velocity_std": 0.0, "body_rates_std": 0.0}
HOLD = 2  # our control steps of 10 ms in one of the trainer's
LAST_ACTIONS = 2  # how many of them it sees
FLAGS = ("-std=c++17", "-Ofast", "-march=native")
NUMBERS = re.compile(r"memory\[\] = \{(.*?)\};\s*using SHAPE = [^<]*<unsigned long, ([\d, ]+)>")


def rational_tanh(x: Array) -> Array:
    """The Padé approximant of tanh, constant from ±3 on, which its SAC uses."""
    x = x.clip(-3.0, 3.0)
    return x * (27.0 + x**2) / (27.0 + 9.0 * x**2)


def relu(x: Array) -> Array:
    """The activation that its TD3 uses."""
    return x.clip(0.0)


# The file with the settings of an algorithm, and the activation of its hidden layers.
ALGORITHMS: dict[str, tuple[str, Callable[[Array], Array]]] = {
    "sac": ("sac_tiny.h", rational_tanh),
    "td3": ("td3.h", relu),
}
# The state of a flight: the last actions, the newest first, and how often the newest was flown
State = tuple[Array, int]


class Policy:
    """A policy that the trainer has saved, with ``predict`` as in SB3's recurrent policies.

    :param checkpoint: its ``checkpoint.h``.
    :raises SystemExit: if it does not reproduce the outputs of the example in the file.
    """

    def __init__(self, checkpoint: Path, activation: Callable[[Array], Array]) -> None:
        arrays = []
        for numbers, shape in NUMBERS.findall(checkpoint.read_text()):
            values = [float.fromhex(number.strip().rstrip("f")) for number in numbers.split(",")]
            arrays.append(np.array(values).reshape([int(size) for size in shape.split(",")]))
        *layers, inputs, outputs = arrays
        self._layers = list(zip(layers[::2], layers[1::2], strict=True))
        self._activation = activation
        if not np.allclose(self._evaluate(inputs), outputs, atol=1e-4):
            raise SystemExit(f"{checkpoint}: read in another way than it was written")

    def _evaluate(self, inputs: Array) -> Array:
        """The speeds of the rotors for inputs (..., 29), from -1 at rest to 1 at the greatest."""
        values = inputs
        for weights, biases in self._layers[:-1]:
            values = self._activation(values @ weights.T + biases)
        weights, biases = self._layers[-1]
        # SAC's last layer has standard deviations, too.
        return np.tanh(values @ weights.T + biases)[..., :4]

    def predict(
        self,
        observation: Array,
        state: State | None = None,
        episode_start: Array | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, State]:
        """Actions (n, 4) for observations (n, 18) of flights that have all begun together."""
        n = len(observation)
        if state is None:
            low, high = VEHICLE.thrust_limits
            hover = 2.0 * np.sqrt((1.0 - low) / (high - low)) - 1.0
            state = np.full((n, LAST_ACTIONS, 4), hover), HOLD
        speeds, flown = state
        if flown == HOLD:
            features = observation[:, :OBSERVATION_SIZE] * DEFAULT_STD + DEFAULT_MEAN
            position, to_body, velocity, rates = np.split(features, [3, 12, 15], axis=1)
            rotation = to_body.reshape(n, 3, 3).transpose(0, 2, 1)
            velocity = np.einsum("nij,nj->ni", rotation, velocity)
            # Position and velocity relative to its reference, which rests here, and then the state.
            parts = (position, velocity, rotation, velocity, rates, speeds)
            inputs = np.hstack([part.reshape(n, -1) for part in parts])
            speeds = np.concatenate([self._evaluate(inputs)[:, None], speeds[:, :-1]], axis=1)
            flown = 0
        # The thrust goes with the square of a speed from 0 to 1.
        shares = ((speeds[:, 0] + 1.0) / 2.0) ** 2
        return (2.0 * shares - 1.0).astype(np.float32), (speeds, flown + 1)


def compile_trainer(clone: Path, algorithm: str, steps: int | None, folder: Path) -> Path:
    """Compile the trainer of a clone into a folder.

    :param steps: steps of the training; None: as its authors set them.
    :raises SystemExit: without a clone or a suitable compiler.
    """
    zoo = clone / "src" / "rl" / "zoo"
    if not (zoo / "zoo.cpp").is_file():
        raise SystemExit(
            f"{clone}: no RLtools there; git clone https://github.com/rl-tools/rl-tools, and give "
            "its folder"
        )
    if shutil.which("g++") is None:
        raise SystemExit("g++ not found: install it, it compiles RLtools' trainer")
    if steps is not None:
        # The number is a constant in its source.
        zoo = Path(shutil.copytree(zoo, folder / "zoo"))
        settings = zoo / "l2f" / ALGORITHMS[algorithm][0]
        text, found = re.subn(r"(?<=\bTI STEP_LIMIT = )\d+", str(steps), settings.read_text())
        if not found:
            raise SystemExit(f"{settings}: has no STEP_LIMIT to change; leave --steps out")
        settings.write_text(text)
    program = folder / "trainer"
    names = ("BENCHMARK", f"ALGORITHM_{algorithm.upper()}", "ENVIRONMENT_L2F")
    command = ["g++", *FLAGS, *(f"-DRL_TOOLS_RL_ZOO_{name}" for name in names)]
    command += ["-I", str(clone / "include"), str(zoo / "zoo.cpp"), str(zoo / "zoo_cli.cpp")]
    done = subprocess.run([*command, "-o", str(program)], capture_output=True, text=True)
    if done.returncode != 0:
        error = next((line for line in done.stderr.splitlines() if "error" in line), "g++ failed")
        raise SystemExit(f"{error}; git -C {clone} checkout 9acdf5c, which compiles")
    return program


def train(program: Path, seed: int, folder: Path) -> tuple[float, float, Path]:
    """Train; return the CPU seconds, the mean length of its episodes, and the saved policy."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    folder.mkdir()
    done = subprocess.run(
        [program, str(seed)],
        cwd=folder,
        check=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    length = re.search(r"Mean episode length: ([\d.]+)", done.stdout)
    (checkpoint,) = folder.rglob("checkpoint.h")
    return cpu_seconds, float(length[1]) if length else np.nan, checkpoint


def main() -> None:
    """Compile the trainer, train, fly and print a row for each seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clone", type=Path, help="folder of a clone of RLtools")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="sac")
    parser.add_argument("--steps", type=int, help="of a training (as its authors set it)")
    arguments = parser.parse_args()

    name = f"RLtools L2F, {arguments.algorithm.upper()}"
    if arguments.steps is not None:
        name += f", {arguments.steps:,} steps"
    clone = arguments.clone.resolve()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        program = compile_trainer(clone, arguments.algorithm, arguments.steps, folder)
        print(HEADER, flush=True)
        for seed in arguments.seeds:
            cpu_seconds, length, checkpoint = train(program, seed, folder / str(seed))
            policy = Policy(checkpoint, ALGORITHMS[arguments.algorithm][1])
            gentle = fly(policy, "state_recovery", 240, 5, VEHICLE, task_kwargs=GENTLE)
            thesis = fly(policy, "state_recovery", 3840, 5, VEHICLE)
            print_row(
                name,
                seed,
                cpu_seconds,
                length,
                float(np.median(gentle.final_error)),
                float(thesis.survival.mean()),
                float(thesis.success.mean()),
            )


if __name__ == "__main__":
    main()
