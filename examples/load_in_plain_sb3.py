"""A trained agent in stock Stable-Baselines3: load the zip with PPO, fly the Gymnasium environment.

    python examples/load_in_plain_sb3.py dagger.zip
    python examples/load_in_plain_sb3.py dagger.zip --env QuadStateRecovery-v0 --window

The zip itself needs no sb3_quad; the environment does.
"""

import argparse

import gymnasium
from stable_baselines3 import PPO

import sb3_quad  # noqa: F401  (registers the environments)

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("agent", help="a zip that training left")
parser.add_argument("--env", default="QuadTargetTracking-v0")
parser.add_argument("--episodes", type=int, default=3)
parser.add_argument("--window", action="store_true", help="show the flights, in real time")
arguments = parser.parse_args()

model = PPO.load(arguments.agent, device="cpu")
env = gymnasium.make(arguments.env, render_mode="human" if arguments.window else None)
for episode in range(arguments.episodes):
    observation, info = env.reset(seed=episode)
    terminated = truncated = False
    while not (terminated or truncated):
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, terminated, truncated, info = env.step(action)
    arrived = "arrived" if info["is_success"] else "missed"
    print(f"episode {episode}: {arrived}, {info['distance']:.3f} m from the target at the end")
env.close()
