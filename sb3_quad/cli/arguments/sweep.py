"""Train many seeds and settings, here or on a Ray cluster; compare all on the same fresh episodes.

examples:
  sb3-quad sweep my_sweep.yaml --dry-run                   lists the runs
  sb3-quad sweep my_sweep.yaml --workers 4                 four worker processes, one core each
  sb3-quad sweep pid                                       a sweep of the package: nominal, pid, random_worlds, recovery
  sb3-quad sweep --seed 0 1 2 --conf-file imitation.yml two_stage.yml
  sb3-quad sweep --seed 0 1 2 --algo dagger --env QuadStateRecovery-v0 -n 240000 --suite quick
  sb3-quad sweep my_sweep.yaml --executor ray --address auto
  sb3-quad sweep --resume logs/sweep/my_sweep_1            goes on after Ctrl-C or a crash

A folder is left: run folders, results.csv, results.json, report.md and report.html. The file's keys: docs/sweeps.md.
"""

import argparse

from sb3_quad.cli.parser import TRUST, Pairs, Parser, add_executor, positive, seed, whole


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add("sweep", nargs="?", metavar="SWEEP", help="YAML file, or a name; the flags below go before what it says")
    add("--seed", nargs="+", type=seed, metavar="N", help="seeds of each configuration (0)")
    add("-conf", "--conf-file", nargs="+", metavar="FILE", help="settings files, of single runs or pipelines (imitation.yml)")
    add("--algo", nargs="+", help="algorithms of single runs (dagger)")
    add("--env", help="environment id of single runs (QuadTargetTracking-v0)")
    add("-n", "--n-timesteps", type=whole, metavar="N", help="timesteps of each run")
    add("-params", "--hyperparams", action=Pairs, nargs="+", metavar="K:V", help="settings to change, such as n_steps:500")
    add("--env-kwargs", action=Pairs, nargs="+", metavar="K:V", help="environment keywords, such as noise:0")
    add("--eval-freq", type=whole, metavar="N", help="timesteps between evaluations along the way (250000)")
    add("--eval-episodes", type=whole, metavar="N", help="episodes of each (48); 0: no evaluations along the way")
    add("--suite", metavar="SUITE", help="what the agents fly in the end (fresh episodes of both tasks, 240 each)")
    add("--episodes", type=positive, metavar="N", help="episodes of each scenario in the end")
    add("-f", "--log-folder", default="logs", metavar="DIR", help="the sweep goes to DIR/sweep/NAME_N (logs)")
    add("--workers", type=positive, metavar="N", help="runs side by side (the cores)")
    add_executor(parser)
    add("--storage", metavar="WHERE", help="folder or URL through which run folders travel from Ray's workers")
    add("--dry-run", action="store_true", help="list the runs, train nothing")
    add("--resume", metavar="FOLDER", help="go on with a sweep: what is not finished in its folder")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (in a terminal: yes)")
    add("--trust", action="store_true", help=TRUST)
