r"""Train a Crazyflie by PPO in RotorPy's environment, and fly it there from the thesis's starts.

    pip install -r examples/other_trainers/requirements.txt
    OMP_NUM_THREADS=1 python examples/other_trainers/rotorpy_ppo.py --cpu-seconds 120 --seeds 0

It trains as RotorPy's example of PPO does: 512 vehicles with masses and rotors that vary a little,
thrust and attitude as actions, the true state as observation, SB3's PPO with 32 steps a rollout and
batches of 1,024. It trains for as many CPU seconds as you give. These include the environments and
the training, but not imports and the flights afterwards.

Its own episodes start at rest up to 2 m from the target along each axis, and end after 5 s or at a
distance of 4 m. Their mean length and final distance are those of 240 episodes with RotorPy's
nominal vehicle. Recoveries are those of examples/other_simulators: in RotorPy, 15 s, without noise
and delay. No package of ours is needed.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from table import HEADER, print_row

sys.path.append(str(Path(__file__).resolve().parent.parent / "other_simulators"))
try:
    import torch
    from flights import Array, Setpoint, State, fly
    from in_rotorpy import RotorPy, to_fields
    from rotorpy.learning.learning_utils import generate_random_vehicle_params
    from rotorpy.learning.quadrotor_environments import make_default_vec_env
    from rotorpy.vehicles.crazyflie_params import quad_params
    from rotorpy.wind.default_winds import BatchedNoWind
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as error:
    raise SystemExit(f"{error}; pip install -r examples/other_trainers/requirements.txt") from error

ENVIRONMENTS = 512
STEPS = 500  # of an episode
EPISODES = 240
RECOVERIES = 480


class Until(BaseCallback):
    """Ends a training when this process has used ``end`` CPU seconds."""

    def __init__(self, end: float) -> None:
        super().__init__()
        self.end = end

    def _on_step(self) -> bool:
        return time.process_time() < self.end


def make_environment(n: int, vehicles: Any = quad_params) -> Any:
    """RotorPy's environment of n vehicles, with the actions of its example."""
    return make_default_vec_env(n, vehicles, "cmd_ctatt", torch.device("cpu"), render_mode="None")


def train(seed: int, limit: float) -> tuple[PPO, float]:
    """Train as RotorPy's example does; return the model and the CPU seconds."""
    begun = time.process_time()
    # in_rotorpy flies with double precision.
    torch.set_default_dtype(torch.float32)
    # RotorPy draws its vehicles from this one.
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)
    vehicles = generate_random_vehicle_params(ENVIRONMENTS, torch.device("cpu"))
    env = make_environment(ENVIRONMENTS, vehicles)
    env.reset_options |= {"params": "random", "vel_bound": 0.5}
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=1024, seed=seed, device="cpu")
    model.learn(10_000_000, Until(begun + limit))
    return model, time.process_time() - begun


def fly_own_episodes(model: PPO) -> tuple[Array, Array]:
    """Lengths of RotorPy's own episodes, steps, and distances from the target at their ends, m."""
    env = make_environment(EPISODES)
    observation = env.reset(seed=5)
    flying = np.ones(EPISODES, np.bool_)
    lengths = np.zeros(EPISODES)
    distances = np.zeros(EPISODES)
    # After the last step the environment has reset the vehicles.
    for _ in range(STEPS - 1):
        distances[flying] = np.linalg.norm(observation[flying, :3], axis=1)
        observation, _, done, _ = env.step(model.predict(observation, deterministic=True)[0])
        lengths += flying
        flying &= ~done
    distances[flying] = np.linalg.norm(observation[flying, :3], axis=1)
    return lengths + flying, distances


class Learned:
    """A trained model as a policy of flights.py, which sees the true state.

    RotorPy's own controller makes rotor thrusts of the thrust and attitude that it asks for.
    """

    def __init__(self, model: PPO, n: int) -> None:
        self._model = model
        self._env = make_environment(n)
        self._rows = torch.arange(n)

    def reset(self, n: int) -> None:
        pass

    def __call__(self, observation: Array, state: State, setpoint: Setpoint) -> Array:
        state = State(
            state.position - setpoint.position,
            state.quaternion,
            state.velocity - setpoint.velocity,
            state.body_rates,
        )
        # A vehicle that has crashed may have anything, also NaN.
        fields = {name: torch.nan_to_num(part) for name, part in to_fields(state).items()}
        seen = torch.hstack([fields[name] for name in "xvqw"]).numpy()
        actions, _ = self._model.predict(seen.astype(np.float32), deterministic=True)
        asked = self._env.rescale_action(actions)
        control = {name: torch.tensor(values).double() for name, values in asked.items()}
        vehicles = self._env.quadrotors
        speeds = vehicles.get_cmd_motor_speeds(fields, control, self._rows).numpy()
        return np.asarray(quad_params["k_eta"] * speeds.clip(0.0) ** 2)


def main() -> None:
    """Train, fly and print a row for each seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--cpu-seconds", type=float, default=120.0, help="of each training (120)")
    arguments = parser.parse_args()

    print(HEADER, flush=True)
    for seed in arguments.seeds:
        model, cpu_seconds = train(seed, arguments.cpu_seconds)
        torch.set_default_dtype(torch.float64)
        lengths, distances = fly_own_episodes(model)
        policy = Learned(model, RECOVERIES)
        simulator = RotorPy("crazyflie", BatchedNoWind, RECOVERIES)
        recoveries = fly(simulator, policy, "recoveries", seed=5, noise=0.0, delay=0)
        print_row(
            f"RotorPy, PPO, {model.num_timesteps:,} steps",
            seed,
            cpu_seconds,
            lengths.mean(),
            float(np.median(distances)),
            recoveries.survived.mean(),
            recoveries.succeeded.mean(),
        )


if __name__ == "__main__":
    main()
