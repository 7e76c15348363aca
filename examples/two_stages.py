"""The two stages of the thesis: imitate the PID (DAgger), then learn to recover (PPOBC).

    python examples/two_stages.py

The best agent by survival of recoveries is kept as best_model.zip. The last one hovers at an offset
from its target, which is corrected at the end.
"""

import argparse

from sb3_quad import PPOBC, DAgger, QuadcopterVecEnv, fly
from sb3_quad.callbacks import BestModel
from sb3_quad.evaluation.offset_correction import correct_offset

parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument(
    "--timesteps", type=int, nargs=2, default=[600_000, 3_000_000], help="of each stage"
)
arguments = parser.parse_args()
first, second = arguments.timesteps

targets = QuadcopterVecEnv(240, task="target_tracking", seed=0)
imitation = DAgger("MlpPolicy", targets, expert="pid", seed=0, device="cpu")
imitation.learn(first)

# A mixture of recoveries and targets up to 25 m away, with a reward that is steep near the target
thrown = QuadcopterVecEnv(480, task="thesis_recovery", seed=0)
agent = PPOBC("MlpPolicy", thrown, expert="pid", initial_policy=imitation, seed=0, device="cpu")
# A rollout, at least
every = max(second // 5, 60_000)
best = BestModel(
    QuadcopterVecEnv(48, "state_recovery"),
    every,
    n_episodes=48,
    seed=1_000_000,
    report=print,
    by="survival",
)
agent.learn(second, callback=best)
# An agent that still crashes has no offset.
if second > every:
    correct_offset(agent)
agent.save("two_stages.zip")

for task in ("state_recovery", "target_tracking"):
    flights = fly(agent, task, n_episodes=480, seed=1_000_000)
    print(f"agent, {task}: success {flights.success.mean():.1%}")
