r"""Your own vehicle: a YAML file with its parameters, from which experts derive their gains.

An agent then learns to fly it from the geometric expert.

    python examples/own_vehicle.py
    python examples/own_vehicle.py --vehicle path/to/yours.yaml

On the command line, you imitate the same expert on more tasks, for 6,000,000 timesteps:

    sb3-quad train --algo dagger --env QuadStateRecovery-v0 --conf-file nominal/dagger.yml \
        --env-kwargs vehicle:examples/my_quadcopter.yaml
"""

import argparse
from pathlib import Path

from stable_baselines3.common.utils import LinearSchedule

from sb3_quad import DAgger, GeometricExpert, PIDExpert
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import fly

parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument(
    "--vehicle",
    default=str(Path(__file__).with_name("my_quadcopter.yaml")),
    help="a name or a YAML file",
)
parser.add_argument(
    "--timesteps",
    type=int,
    default=600_000,
    help="transitions, over all environments (%(default)s)",
)
arguments = parser.parse_args()

# A value that no vehicle can have is refused here, with its name.
vehicle = load_vehicle(arguments.vehicle)
low, high = vehicle.thrust_range
print(
    f"{vehicle.name}: rotors from {low:.2f} to {high:.2f} N, "
    f"hover at {vehicle.hover_rotor_speed:.0f} rad/s"
)

expert = GeometricExpert(vehicle)
env = QuadcopterVecEnv(240, task="state_recovery", vehicle=vehicle, max_episode_steps=500, seed=0)
model = DAgger(
    "MlpPolicy",
    env,
    expert=expert,
    n_steps=125,
    batch_size=2048,
    gradient_steps=100,
    n_epochs=1,
    gamma=0.99,
    learning_rate=LinearSchedule(5e-3, 2.5e-4, 1.0),
    dataset_capacity=1_500_000,
    # The expert flies the first rollout, and less of each following one.
    beta=1.0,
    beta_decay=0.2,
    beta_final=0.0,
    seed=0,
    device="cpu",
)
model.learn(arguments.timesteps)
for name, controller in (("PID", PIDExpert(vehicle)), ("geometric", expert), ("agent", model)):
    flights = fly(controller, "state_recovery", n_episodes=480, seed=1_000_000, vehicle=vehicle)
    print(f"{name}: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}")
