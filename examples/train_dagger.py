"""Imitation: an agent learns from the geometric expert to recover and to fly to targets (DAgger), then both fly.

python examples/train_dagger.py
"""

import argparse

from stable_baselines3.common.utils import LinearSchedule

from sb3_quad import DAgger, GeometricExpert
from sb3_quad.callbacks import StopOnSignal
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.simulation.settings import FlightSettings

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--timesteps", type=int, default=900_000, help="transitions, over all environments (%(default)s)")
parser.add_argument("--output", default="dagger.zip", help="where the agent goes (%(default)s)")
arguments = parser.parse_args()

env = QuadcopterVecEnv(240, task={"state_recovery": 0.5, "recovery_and_tracking": 0.5}, max_episode_steps=500, seed=0)
model = DAgger(
    "MlpPolicy",
    env,
    expert=GeometricExpert(),
    bc_loss="huber_mse",
    n_steps=125,
    batch_size=2048,
    gradient_steps=100,
    n_epochs=1,
    gamma=0.99,
    learning_rate=LinearSchedule(5e-3, 2.5e-4, 1.0),
    beta=1.0,  # the expert flies the first rollout, and less of each following one
    beta_decay=0.2,
    beta_final=0.0,
    seed=0,
    device="cpu",
)
FlightSettings().write_into(model)  # so that the zip says how its agent flies: ITM, 18 features
model.learn(arguments.timesteps, callback=StopOnSignal(arguments.output))  # Ctrl-C ends it and saves
model.save(arguments.output)

for task in ("state_recovery", "target_tracking"):
    for name, controller in (("expert", GeometricExpert()), ("agent", model)):
        flights = fly(controller, task, n_episodes=480, seed=1_000_000)
        print(f"{name}, {task}: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}")
print(f"saved to {arguments.output}")
