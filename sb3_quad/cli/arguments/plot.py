"""Draw learning curves: success, reward and losses over timesteps and wall-clock time, with mean and range over seeds.

examples:
  sb3-quad plot "RL-agent=logs/ppo_bc/QuadStateRecovery-v0_*" -o curves.png
  sb3-quad plot "PPO+BC=logs/ppo_bc/*" "PPO only=logs/ppo/*" --line expert:31.9:-16.1 --title "state recovery" -o curves.svg
  sb3-quad plot "PPO+BC=logs/ppo_bc/QuadStateRecovery-v0_*" --thesis state_recovery --show survival reward losses
"""

from sb3_quad.cli.parser import Parser

PANELS = ("success", "survival", "reward", "losses")
THESIS = {"state_recovery": "recovery", "target_tracking": "tracking"}  # its scenarios by task


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("groups", nargs="+", metavar="NAME=PATTERN", help="an agent's name and its run folders; quote a *")
    add("--line", action="append", default=[], metavar="NAME:SUCCESS:REWARD", help="horizontal lines: success in %%, reward")
    scenarios = ", ".join(THESIS)
    add("--thesis", choices=[*THESIS], metavar="TASK", help=f"draw what the thesis prints of {scenarios} as horizontal lines")
    add("--show", nargs="+", choices=PANELS, default=[], metavar="PANEL", help=f"of {', '.join(PANELS)} (success reward)")
    add("--task", help="show the evaluations on this one of the runs' eval_tasks instead of on their own task")
    add("--title", default="", help="title of the picture")
    add("-o", "--output", default="curves.png", metavar="FILE", help="picture to write: .png, .svg or .pdf (curves.png)")
