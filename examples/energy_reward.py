"""A controller of your own, cloned by DAgger, then improved by PPOBC on a reward of your own.

    python examples/energy_reward.py

The controller is an LQR, which knows the linear model of a hovering quadcopter. The reward is that
of target tracking minus an energy: (T / T_hover)^1.5 for each rotor's thrust T, the power of an
ideal rotor. A wrapper subtracts it; nothing else changes.
"""

import argparse

import numpy as np
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_quad import PPOBC, DAgger, QuadcopterVecEnv, fly
from sb3_quad.evaluation.offset_correction import correct_offset
from sb3_quad.experts.protocol import Expert

ENERGY_COST = 0.003  # per control step in hover, as much as a distance of 1 m


class LQR(Expert):
    """Holds position by the discrete Riccati equation of the linear model around hover."""

    def __init__(self, vehicle="itm"):
        super().__init__(vehicle)
        v = self.vehicle
        # Position error, velocity, tilt (roll, pitch) and body rates, in the heading's frame
        a = np.zeros((11, 11))
        b = np.zeros((11, 4))
        a[0:3, 3:6] = np.eye(3)
        a[3, 7] = v.gravity
        a[4, 6] = -v.gravity
        a[6, 8] = a[7, 9] = 1.0
        b[5] = v.mixer[0] / v.mass
        b[8:11] = v.mixer[1:] / np.array(v.inertia)[:, None]
        a = np.eye(11) + v.control_step * a
        b = v.control_step * b
        q = np.diag([1.0, 1.0, 2.0, 0.6, 0.6, 0.6, 1.0, 1.0, 0.1, 0.1, 0.1])
        r = np.eye(4) / v.hover_thrust**2 * 4
        p = q
        for _ in range(3000):
            self.gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
            p = q + a.T @ p @ (a - b @ self.gain)

    def actions(self, state):
        """Float32 (n, 4), for the true state of n vehicles."""
        rotation = state.rotation
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        cosine, sine = np.cos(yaw), np.sin(yaw)

        def in_heading_frame(vectors):
            x, y, z = vectors.T
            return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)

        # A far target is approached 2 m at a time.
        error = in_heading_frame(state.position - state.target)
        error *= np.minimum(1.0, 2.0 / np.maximum(state.distance, 1e-9))[:, None]
        velocity = in_heading_frame(state.velocity)
        tilt = np.stack([rotation[:, 2, 1], -rotation[:, 2, 0]], axis=1)
        x = np.concatenate([error, velocity, tilt, state.body_rates], axis=1)
        thrust = self.vehicle.hover_thrusts - x @ self.gain.T
        return np.clip(self.vehicle.thrust_to_action(thrust), -1.0, 1.0).astype(np.float32)


class EnergyCost(VecEnvWrapper):
    """Subtracts the power of the rotors from the reward of every control step."""

    def reset(self):
        """Begin a new episode in every row."""
        return self.venv.reset()

    def step_async(self, actions):
        """Note the power of these actions, (n,), in units of hover."""
        vehicle = self.get_attr("vehicle", [0])[0]
        thrust = vehicle.action_to_thrust(actions)
        self.power = ((thrust / vehicle.hover_thrust) ** 1.5).mean(axis=1)
        self.venv.step_async(actions)

    def step_wait(self):
        """Return the environment's own reward minus the energy."""
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards - ENERGY_COST * self.power.astype(np.float32), dones, infos


def mean_reward(controller, n_episodes=240, seed=1_000_000):
    """The mean reward of fresh flights, with the energy, and the share of flights that survive."""
    quadcopters = QuadcopterVecEnv(n_episodes, "target_tracking", seed=seed)
    env = EnergyCost(quadcopters)
    observations = env.reset()
    flying = np.ones(n_episodes, dtype=bool)
    rewards = np.zeros(n_episodes)
    survived = 0
    while flying.any():
        if hasattr(controller, "actions"):
            actions = controller.actions(quadcopters.true_state())
        else:
            actions, _ = controller.predict(observations, deterministic=True)
        observations, step_rewards, dones, infos = env.step(actions)
        rewards[flying] += step_rewards[flying]
        for row in np.flatnonzero(dones & flying):
            survived += infos[row]["survival"]
        flying &= ~dones
    return rewards.mean(), survived / n_episodes


parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument(
    "--timesteps",
    type=int,
    default=1_500_000,
    help="transitions of PPOBC, over all environments (%(default)s)",
)
parser.add_argument(
    "--imitation-timesteps", type=int, default=600_000, help="those of DAgger (%(default)s)"
)
parser.add_argument("--seed", type=int, default=0, help="of both (%(default)s)")
arguments = parser.parse_args()
seed = arguments.seed

expert = LQR()
targets = QuadcopterVecEnv(240, "target_tracking", seed=seed)
imitation = DAgger("MlpPolicy", targets, expert=expert, seed=seed, device="cpu")
imitation.learn(arguments.imitation_timesteps)

# The expert flies much as this reward asks: clone everywhere and strongly, and explore little. The
# LQR takes more than 5 s to its target, so episodes last their full 15 s.
env = EnergyCost(QuadcopterVecEnv(480, "target_tracking", seed=seed))
agent = PPOBC(
    "MlpPolicy",
    env,
    learning_rate=LinearSchedule(3e-4, 1.5e-5, 1.0),
    gamma=0.99,
    policy_kwargs={"log_std_init": -2.6},
    expert=expert,
    initial_policy=imitation,
    bc_coef=5.0,
    bc_loss="huber_mse",
    bc_filter="none",
    seed=seed,
    device="cpu",
)
agent.learn(arguments.timesteps)
if arguments.timesteps > 100_000:
    correct_offset(agent)

for name, controller in (("LQR", expert), ("DAgger", imitation), ("PPOBC", agent)):
    reward, survival = mean_reward(controller)
    print(f"{name}: mean reward {reward:.2f}, survival {survival:.1%}")
flights = fly(agent, "target_tracking", n_episodes=240, seed=1_000_000)
print(f"PPOBC: median final error {np.median(flights.final_error):.3f} m")
agent.save("energy")
