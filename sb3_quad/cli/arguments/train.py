"""Train an agent. Without arguments: DAgger in random worlds, from the geometric expert that is told the truth.

examples:
  sb3-quad train                                          imitation in random worlds, in the batched environment
  sb3-quad train --conf-file two_stage.yml                the same, then PPO with a cloning term
  sb3-quad train --conf-file nominal/two_stage.yml        both stages for one vehicle in still air
  sb3-quad train --conf-file pid/two_stage.yml            both stages from the PID expert
  sb3-quad train --conf-file thesis/two_stage.yml         the thesis's recipe as it prints it; hours
  sb3-quad train --reference                              plus PPO alone on the same budget, in the same tables
  sb3-quad train --algo dagger --vec-env subproc --n-envs 8   imitation on PyBullet, a process per environment
  sb3-quad train --seed 1 -P -tb logs/tb                  another seed, progress bar, TensorBoard
  sb3-quad train --seed 0 1 2                             three seeds side by side, one table: a sweep
  sb3-quad train --conf-file thesis/dagger.yml            Table A.4 as the thesis prints it
  sb3-quad train --hyperparams n_steps:500 learning_rate:lin_5e-4 "policy_kwargs:dict(net_arch=[32, 32])"
  sb3-quad train --env-kwargs noise:0 "task_kwargs:dict(target_distance=15)"
  sb3-quad train --algo ppo_bc --env QuadStateRecovery-v0 -i logs/dagger/QuadStateRecovery-v0_1/trimmed_model.zip
  sb3-quad train --resume logs/dagger/QuadTargetTracking-v0_1
  sb3-quad train --env Pendulum-v1 --conf-file my.yml --expert teacher.zip
"""

import argparse

from sb3_quad.cli.parser import BRIDGE, TRUST, OneOrMore, Pairs, Parser, pointers, positive, seed, whole
from sb3_quad.controllers.pretrained import agent_path

DEFAULT_PIPELINE = "imitation.yml"
DEFAULT_ALGO, DEFAULT_ENV = "dagger", "QuadTargetTracking-v0"


SEARCH = "is of rl-zoo's search for hyperparameters, here a command of its own: sb3-quad tune --help, docs/tune.md"
ELSEWHERE = {
    **pointers(
        "-optimize --optimize-hyperparameters --n-trials --max-total-trials --sampler --pruner --n-startup-trials", SEARCH
    ),
    **pointers("--n-evaluations --storage --study-name --n-jobs --trial-id --no-optim-plots --optimization-log-path", SEARCH),
    **pointers("--track --wandb-project-name --wandb-entity --wandb-group -tags --wandb-tags", BRIDGE.format("train")),
    **pointers("--save-replay-buffer --truncate-last-trajectory", BRIDGE.format("train")),
}
"""Flags of rl-zoo's ``train.py`` that ours lacks, and where to find what they do."""


def add_settings(parser: Parser) -> None:
    """The flags of rl-zoo's ``train.py`` for what is trained, with their meanings."""
    parser.elsewhere = ELSEWHERE
    add = parser.add_argument
    add("--algo", help=f"algorithm: dagger, ppo_bc, sac_bc, ppo, sac or td3 ({DEFAULT_ALGO})")
    add("--env", help=f"environment id ({DEFAULT_ENV}); any id that Gymnasium knows, with --vec-env dummy or subproc")
    add("-conf", "--conf-file", metavar="FILE", help="settings: a YAML file, or one of the package, such as thesis/dagger.yml")
    add("-n", "--n-timesteps", type=whole, metavar="N", help="timesteps, in whole rollouts; fewer than one shorten it")
    add("--n-envs", type=whole, metavar="N", help="environments side by side")
    add("--vec-env", metavar="KIND", help="batch (compiled), dummy (PyBullet, one process) or subproc (one process each)")
    add("--expert", metavar="SPEC", help="pid, geometric, path/to/model.zip or package.module:factory")
    add("-params", "--hyperparams", action=Pairs, nargs="+", metavar="K:V", help="settings to change, such as n_steps:500")
    add("--env-kwargs", action=Pairs, nargs="+", metavar="K:V", help="environment keywords, such as noise:0")
    add("--eval-env-kwargs", action=Pairs, nargs="+", metavar="K:V", help="the same, for evaluations only")
    add("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules that register further environments")
    start = "agent to start from (policy and critic): an SB3 on-policy zip, a run folder, or a name such as itm-recovery"
    add("-i", "--trained-agent", type=agent_path, metavar="ZIP", help=start)
    add("--n-eval-envs", type=whole, metavar="N", help="environments of an evaluation (batch: one per episode; else 1)")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar (in a terminal: yes)")
    add("--trust", action="store_true", help=TRUST)
    add("--device", help="cpu (default), cuda or auto")
    add("--num-threads", type=positive, metavar="N", help="threads (the cores; one where PyTorch computes)")


def add_arguments(parser: Parser) -> None:
    """The flags of rl-zoo's ``train.py``, with their meanings."""
    add_settings(parser)
    add = parser.add_argument
    add("--reference", action="store_true", help="with a pipeline: also train PPO alone on the same budget, for comparison")
    add("--resume", metavar="RUN_FOLDER", help="continue an interrupted or killed run with all its settings")
    add("-f", "--log-folder", metavar="DIR", help="folder for the run folders (logs)")
    add("-uuid", "--uuid", action="store_true", help="add a UUID to the run folder's name")
    seeds = "seed (0); negative: a random one, recorded in args.yml; several: a run each, compared, as sweep does"
    add("--seed", type=seed, nargs="+", action=OneOrMore, help=seeds)
    add("--eval-freq", type=whole, metavar="N", help="timesteps between evaluations (250000); below 1: one at the end")
    add("--eval-episodes", type=whole, metavar="N", help="episodes per evaluation (48); 0: no evaluations")
    add("--save-freq", type=whole, metavar="N", help="timesteps between checkpoints (none)")
    snapshots = "seconds between snapshots, from which --resume goes on after a crash (60); 0: none"
    add("--snapshot-every", type=float, metavar="SECONDS", help=snapshots)
    add("--log-interval", type=whole, metavar="N", help="rollouts between two tables of --verbose 1 (1)")
    add("-tb", "--tensorboard-log", metavar="DIR", help="folder for TensorBoard")
    add("--verbose", type=int, choices=(0, 1, 2), help="1: SB3's tables, 2: debugging (0)")
