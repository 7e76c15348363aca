"""Fly controllers through scenarios, side by side on the same episodes; tables, results.json and episodes.csv.

controllers:
  pid, geometric          the experts
  path/to/agent.zip       an agent of any Stable-Baselines3 algorithm, or the run folder of one
  package.module:factory  a function that takes the vehicle and returns a controller
  name=…                  any of these, under that name in the tables

examples:
  sb3-quad evaluate pid geometric                              the thesis's chapter 4 for both experts
  sb3-quad evaluate pid "agent=logs/ppo_bc/QuadStateRecovery-v0_1/trimmed_model.zip" --suite thesis -o evaluations/mine
  sb3-quad evaluate pid agent.zip --suite quick                a quick look, in less than a minute
  sb3-quad evaluate agent.zip --suite robustness --workers 2
  sb3-quad evaluate agent.zip --suite robustness --executor ray --address auto
  sb3-quad evaluate agent.zip --scaling adaptive --scenario tracking    Fig. 4.7: μ measured, α by Eq. 4.10
  sb3-quad evaluate pid my_package.control:make --suite my_scenarios.yaml
  sb3-quad evaluate pid --suite quick --backend pybullet       the same episodes on PyBullet
  sb3-quad evaluate pid geometric agent.zip --scenario tracking recovery --vehicle crazyflie -o evaluations/crazyflie

Results are kept in a folder: the same command again flies only what is missing, and further controllers are added.
"""

import argparse

from sb3_quad.cli.parser import TRUST, Parser, add_executor, whole

DEFAULT_FOLDER = "evaluations"


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("controllers", nargs="+", metavar="CONTROLLER", help="who flies, see below")
    add("--suite", default="thesis", metavar="SUITE", help="thesis (default), robustness, quadcopters, quick, or a YAML file")
    add("-o", "--output", metavar="FOLDER", help=f"where the results go ({DEFAULT_FOLDER}/SUITE)")
    add("--scenario", nargs="+", default=[], metavar="NAME", help="only these scenarios of the suite")
    add("--episodes", type=whole, metavar="N", help="episodes per scenario, instead of its own number")
    add("--seed", type=whole, metavar="N", help="seed of each scenario, instead of its own")
    add("--vehicle", metavar="V", help="vehicle for all, by name or YAML file (each agent's own, where the suite names none)")
    add("--backend", default="batch", metavar="KIND", help="batch (compiled, default) or pybullet")
    add("--scaling", default="none", metavar="KIND", help="none (default), or adaptive: the thesis's μ and α (4.3.1)")
    add("--workers", type=whole, default=1, metavar="N", help="processes that fly side by side (1)")
    add_executor(parser)
    add("--trust", action="store_true", help=TRUST)
    add("--overwrite", action="store_true", help="replace results of these controllers from other settings")
    add("--report", action=argparse.BooleanOptionalAction, default=True, help="update report.html and its plots (yes)")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (in a terminal: yes)")
