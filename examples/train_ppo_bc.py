"""Stage two of the thesis: an agent learns to recover by PPO with a cloning term towards the PID,
and is trimmed.

    python examples/train_dagger.py
    python examples/train_ppo_bc.py dagger.zip

The best agent by survival of recoveries is kept as best_model.zip, with a curve of both tasks in
evaluations*.npz. The last one hovers beside its target by an offset, which trimming takes away.
"""

import argparse

from stable_baselines3.common.utils import LinearSchedule
from stop_on_signal import StopOnSignal

from sb3_quad import PPOBC, PIDExpert
from sb3_quad.algorithms.offset_correction import correct_offset
from sb3_quad.algorithms.transfer import transfer_policy
from sb3_quad.callbacks import BestModel
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.simulation.settings import FlightSettings

parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument(
    "agent",
    nargs="?",
    help="zip to start from: any on-policy SB3 agent with 64-64 networks; none: from scratch",
)
parser.add_argument(
    "--timesteps",
    type=int,
    default=3_000_000,
    help="transitions, over all environments (%(default)s)",
)
parser.add_argument("--output", default="ppo_bc.zip", help="where the agent goes (%(default)s)")
arguments = parser.parse_args()

tasks = {"state_recovery": 0.6, "far_tracking": 0.4}
reward = {
    "precision_cost": 0.03,
    "nearest_target": 0.0,
}  # steep near the target; targets from 0 to 25 m away
model = PPOBC(
    "MlpPolicy",
    QuadcopterVecEnv(480, task=tasks, task_kwargs=reward, max_episode_steps=500, seed=0),
    expert=PIDExpert(),
    bc_coef=0.1,
    bc_loss="mse",
    # Where the agent recovers otherwise than the PID, which would crash, it is not cloned
    bc_filter="agreement",
    n_steps=125,
    batch_size=3750,
    n_epochs=6,
    gamma=0.995,
    gae_lambda=0.98,
    critic_warmup=2,
    learning_rate=LinearSchedule(1e-3, 5e-5, 1.0),
    policy_kwargs={"log_std_init": -0.9},
    seed=0,
    device="cpu",
)
if arguments.agent:
    transfer_policy(arguments.agent, model)

FlightSettings().write_into(model)  # so that the zip says how its agent flies: ITM, 18 features
every = max(arguments.timesteps // 5, 60_000)  # a rollout, at least
recovery, tracking = (QuadcopterVecEnv(48, task) for task in ("state_recovery", "target_tracking"))
best = BestModel(
    recovery,
    every,
    n_episodes=48,
    seed=1_000_000,
    report=print,
    others={"tracking": tracking},
    by="survival",
)
model.learn(arguments.timesteps, callback=[best, StopOnSignal(arguments.output)])
if arguments.timesteps > every:  # an agent that still crashes has no offset
    correct_offset(model)
model.save(arguments.output)
for task in ("state_recovery", "target_tracking"):
    flights = fly(model, task, n_flights=480, seed=1_000_000)
    print(
        f"agent, {task}: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}"
    )
print(f"saved to {arguments.output}")
