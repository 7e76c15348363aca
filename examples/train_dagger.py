"""Imitation: an agent learns from the PID expert to fly to targets (DAgger), then both fly the same targets.

python examples/train_dagger.py
"""

import argparse

from sb3_quad import DAgger, PIDExpert
from sb3_quad.callbacks import StopOnSignal
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--timesteps", type=int, default=300_000, help="transitions, over all environments (%(default)s)")
parser.add_argument("--output", default="dagger.zip", help="where the agent goes (%(default)s)")
arguments = parser.parse_args()

env = QuadcopterVecEnv(240, task="target_tracking", seed=0)
model = DAgger(
    "MlpPolicy",
    env,
    expert=PIDExpert(),
    n_steps=125,
    batch_size=4096,
    gradient_steps=30,
    n_epochs=2,
    learning_rate=2e-3,
    seed=0,
    device="cpu",
)
model.learn(arguments.timesteps, callback=StopOnSignal(arguments.output))  # Ctrl-C ends it and saves
model.save(arguments.output)

for name, controller in (("expert", PIDExpert()), ("agent", model)):
    flights = fly(controller, "target_tracking", n_episodes=48, seed=1_000_000)
    print(f"{name}: {flights.success.mean():.1%} arrive, mean distance after 15 s {flights.final_error.mean():.3f} m")
print(f"saved to {arguments.output}")
