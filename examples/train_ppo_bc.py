"""Stage two: an agent goes on by PPO with a cloning term towards the geometric expert, on recoveries and targets.

    python examples/train_dagger.py
    python examples/train_ppo_bc.py dagger.zip

The best agent by success in recoveries is kept as best_model.zip, with a curve of both tasks in evaluations*.npz.
"""

import argparse

from coefficient_schedule import CoefficientSchedule

from sb3_quad import PPOBC, GeometricExpert
from sb3_quad.callbacks import BestModel, StopOnSignal
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.training.transfer import transfer_policy

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument(
    "agent", nargs="?", help="zip to start from: any on-policy SB3 agent with 64-64 networks; none: from scratch"
)
parser.add_argument("--timesteps", type=int, default=1_500_000, help="transitions, over all environments (%(default)s)")
parser.add_argument("--output", default="ppo_bc.zip", help="where the agent goes (%(default)s)")
arguments = parser.parse_args()

expert = GeometricExpert()
model = PPOBC(
    "MlpPolicy",
    QuadcopterVecEnv(480, task={"state_recovery": 0.5, "target_tracking": 0.5}, max_episode_steps=500, seed=0),
    expert=expert,
    bc_loss="huber",
    n_steps=125,
    batch_size=7500,
    n_epochs=6,
    gae_lambda=0.98,
    critic_warmup=4,
    policy_kwargs={"log_std_init": -2.0},
    seed=0,
    device="cpu",
)
if arguments.agent:
    transfer_policy(arguments.agent, model)

every = max(arguments.timesteps // 5, 60_000)  # a rollout, at least
recovery, tracking = (QuadcopterVecEnv(48, task) for task in ("state_recovery", "target_tracking"))
best = BestModel(recovery, every, n_episodes=48, seed=1_000_000, report=print, others={"tracking": tracking})
less_cloning = CoefficientSchedule("bc_coef", start=5.0, final=1.0, follow="eval/success_rate", between=(0.5, 0.95))
model.learn(arguments.timesteps, callback=[best, less_cloning, StopOnSignal(arguments.output)])
model.save(arguments.output)
print(f"saved to {arguments.output}")
