"""Stage one of the thesis: an agent learns from the PID expert to fly to targets (DAgger), then
both fly.

python examples/train_dagger.py
"""

import argparse

from stop_on_signal import StopOnSignal

from sb3_quad import DAgger, QuadcopterVecEnv, fly

parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument(
    "--timesteps",
    type=int,
    default=600_000,
    help="transitions, over all environments (%(default)s)",
)
parser.add_argument("--output", default="dagger.zip", help="where the agent goes (%(default)s)")
arguments = parser.parse_args()

targets = QuadcopterVecEnv(240, task="target_tracking", seed=0)
model = DAgger("MlpPolicy", targets, expert="pid", seed=0, device="cpu")
# Ctrl-C ends the training and saves the agent.
model.learn(arguments.timesteps, callback=StopOnSignal(arguments.output))
model.save(arguments.output)

for task in ("state_recovery", "target_tracking"):
    for name, controller in (("expert", "pid"), ("agent", model)):
        flights = fly(controller, task, n_episodes=480, seed=1_000_000)
        print(
            f"{name}, {task}: success {flights.success.mean():.1%},"
            f" survival {flights.survival.mean():.1%}"
        )
print(f"saved to {arguments.output}")
