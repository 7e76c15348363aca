"""Draw learning curves: success and reward over timesteps and wall-clock time, with mean and range over seeds.

examples:
  sb3-quad plot "RL-agent=logs/ppo_bc/QuadStateRecovery-v0_*" -o curves.png
  sb3-quad plot "PPO+BC=logs/ppo_bc/*" "PPO only=logs/ppo/*" --line expert:31.9:-16.1 --title "state recovery" -o curves.svg
"""

from sb3_quad.cli.parser import Parser


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("groups", nargs="+", metavar="NAME=PATTERN", help="an agent's name and its run folders; quote a *")
    add("--line", action="append", default=[], metavar="NAME:SUCCESS:REWARD", help="horizontal lines: success in %%, reward")
    add("--task", help="show the evaluations on this one of the runs' eval_tasks instead of on their own task")
    add("--title", default="", help="title of the picture")
    add("-o", "--output", default="curves.png", metavar="FILE", help="picture to write: .png, .svg or .pdf (curves.png)")
