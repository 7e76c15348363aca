"""Stage two of the thesis: an agent learns to recover by PPO with a cloning term towards the PID.

    python examples/train_dagger.py
    python examples/train_ppo_bc.py dagger.zip

The best agent by survival of recoveries is kept as best_model.zip, with a curve of both tasks in
evaluations*.npz. The last one hovers at an offset from its target, which is corrected at the end.
"""

import argparse

from stop_on_signal import StopOnSignal

from sb3_quad import PPOBC, QuadcopterVecEnv, fly
from sb3_quad.callbacks import BestModel
from sb3_quad.evaluation.offset_correction import correct_offset

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

# A mixture of recoveries and targets up to 25 m away, with a reward that is steep near the target
thrown = QuadcopterVecEnv(480, task="thesis_recovery", seed=0)
model = PPOBC(
    "MlpPolicy",
    thrown,
    expert="pid",
    initial_policy=arguments.agent,
    # The imitation has learnt to act without noise; PPO has to explore.
    policy_kwargs={"log_std_init": -0.916},
    seed=0,
    device="cpu",
)

# A rollout, at least
every = max(arguments.timesteps // 5, 60_000)
tracking = QuadcopterVecEnv(48, "target_tracking")
best = BestModel(
    QuadcopterVecEnv(48, "state_recovery"),
    every,
    n_episodes=48,
    seed=1_000_000,
    report=print,
    others={"tracking": tracking},
    by="survival",
)
model.learn(arguments.timesteps, callback=[best, StopOnSignal(arguments.output)])
# An agent that still crashes has no offset.
if arguments.timesteps > every:
    correct_offset(model)
model.save(arguments.output)
for task in ("state_recovery", "target_tracking"):
    flights = fly(model, task, n_episodes=480, seed=1_000_000)
    print(
        f"agent, {task}: success {flights.success.mean():.1%},"
        f" survival {flights.survival.mean():.1%}"
    )
print(f"saved to {arguments.output}")
