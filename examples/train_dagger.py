"""Stage one of the thesis: an agent learns from the PID expert to fly to targets (DAgger), then
both fly.

python examples/train_dagger.py
"""

import argparse

from stable_baselines3.common.utils import LinearSchedule
from stop_on_signal import StopOnSignal

from sb3_quad import DAgger, PIDExpert
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.simulation.settings import FlightSettings

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

model = DAgger(
    "MlpPolicy",
    QuadcopterVecEnv(240, task="target_tracking", seed=0),
    expert=PIDExpert(),
    n_steps=250,
    batch_size=4096,
    gradient_steps=60,
    n_epochs=2,
    learning_rate=LinearSchedule(4e-3, 2e-4, 1.0),
    bc_loss="mse",
    gamma=0.998,
    dataset_capacity=500_000,
    seed=0,
    device="cpu",
)
FlightSettings().write_into(model)  # so that the zip says how its agent flies: ITM, 18 features
model.learn(
    arguments.timesteps, callback=StopOnSignal(arguments.output)
)  # Ctrl-C ends it and saves
model.save(arguments.output)

for task in ("state_recovery", "target_tracking"):
    for name, controller in (("expert", PIDExpert()), ("agent", model)):
        flights = fly(controller, task, n_flights=480, seed=1_000_000)
        print(
            f"{name}, {task}: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}"
        )
print(f"saved to {arguments.output}")
