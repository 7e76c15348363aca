"""Write a trained policy as a small zip for stock PPO, with a card: measured metrics, command, seed, versions.

The zip holds the weights and plain numbers only, so that other versions of Stable-Baselines3 can read it too.
For the card, the policy flies fresh episodes: 3,840 recoveries, and 960 targets at each of 10, 15 and 20 m.

examples:
  sb3-quad publish logs/ppo_bc/QuadStateRecovery-v0_1/trimmed_model.zip --name my-agent
  sb3-quad publish logs/ppo/QuadStateRecovery-v0_2/best_model.zip --name other --command "python my.py" -o published

The zip must lie in its run folder, which records how it was trained.
"""

from sb3_quad.cli.parser import Parser, positive


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("model", metavar="MODEL.zip", help="an agent of an on-policy algorithm (PPO, A2C, DAgger, PPOBC) with MlpPolicy")
    add("--name", required=True, metavar="NAME", help="name of the files, NAME.zip and NAME.md")
    add("-o", metavar="FOLDER", dest="folder", default=".", help="where they go (current folder)")
    add("--command", metavar="TEXT", dest="made_by", help="the command that trained it (as noted in the run folder)")
    add("--episodes", type=positive, default=960, metavar="N", help="episodes of each task (960; recoveries: 4 times as many)")
    add("--overwrite", action="store_true", help="replace existing files")
