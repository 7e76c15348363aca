"""Write a trained policy as a small zip for stock PPO, with a card: measured metrics, command, seed, versions.

The zip holds the weights and plain numbers only, so that other versions of Stable-Baselines3 can read it too.
For the card, the policy flies fresh episodes: 3,840 recoveries, and 960 targets at each of 10, 15 and 20 m.

examples:
  sb3-quad publish logs/ppo_bc/QuadStateRecovery-v0_1/trimmed_model.zip --name my-agent
  sb3-quad publish logs/ppo/QuadStateRecovery-v0_2/best_model.zip --name other --command "python my.py" -o published

How it was trained is taken from its run folder. What is recorded nowhere, the card calls so.
"""

from sb3_quad.cli.parser import TRUST, Parser, positive
from sb3_quad.controllers.pretrained import agent_path


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    agent = "an agent of an on-policy algorithm (PPO, A2C, DAgger, PPOBC) with MlpPolicy: a zip or a run folder"
    add("model", type=agent_path, metavar="MODEL", help=agent)
    add("--name", required=True, metavar="NAME", help="name of the files, NAME.zip and NAME.md")
    add("-o", metavar="FOLDER", dest="folder", default=".", help="folder for both (here)")
    add("--command", metavar="TEXT", dest="made_by", help="the command that trained it (command.txt of the run)")
    add("--episodes", type=positive, default=960, metavar="N", help="episodes of each task (960; recoveries: 4 times as many)")
    add("--trust", action="store_true", help=TRUST)
    add("--overwrite", action="store_true", help="replace existing files")
