"""Search for hyperparameters: train with one choice after another, and write the best as a settings file.

examples:
  sb3-quad tune --algo dagger -n 250000 --n-trials 30               around zoo_configs/dagger.yml
  sb3-quad tune --algo ppo_bc --env QuadStateRecovery-v0 -i logs/dagger/QuadTargetTracking-v0_1/best_model.zip -n 3e6
  sb3-quad tune --algo ppo --env QuadStateRecovery-v0 --sampler random --pruner none --seed 1
  sb3-quad tune --algo dagger --storage logs/my_study.log           again or in another terminal: continues that study
  sb3-quad tune --algo dagger --storage sqlite:///study.db --study-name noise_free --env-kwargs noise:0
  sb3-quad tune --algo dagger -n 250000 --n-trials 30 --workers 4   four trials side by side
  sb3-quad tune --algo dagger --search-space my_space.yml --hyperparams n_epochs:4
  sb3-quad train --algo dagger --env QuadTargetTracking-v0 --conf-file logs/tune/dagger/QuadTargetTracking-v0_1/best.yml

The first trial uses the settings unchanged. Ctrl-C keeps the finished trials. Needs: pip install '.[tune]' from a clone.
"""

from sb3_quad.cli.arguments.train import add_settings
from sb3_quad.cli.parser import Parser, add_executor, natural, positive, seed, whole


def add_arguments(parser: Parser) -> None:
    """The flags of rl-zoo's ``train.py --optimize-hyperparameters``, with their meanings."""
    add_settings(parser)
    add = parser.add_argument
    add("--n-trials", type=natural, default=500, metavar="N", help="trials of this process (500); 0: only write results")
    add("--max-total-trials", type=positive, metavar="N", help="trials of the whole study, failed ones excluded (no limit)")
    add("--workers", type=positive, default=1, metavar="N", help="trials side by side, one core each (1)")
    add_executor(parser)
    add("--sampler", default="tpe", metavar="NAME", help="proposes the trials: tpe (default), random or cmaes")
    add("--pruner", default="median", metavar="NAME", help="cuts poor trials short: median (default), halving or none")
    add("--n-startup-trials", type=whole, default=10, metavar="N", help="random trials before sampler and pruner start (10)")
    add("--n-evaluations", type=whole, default=10, metavar="N", help="evaluations per trial, for the pruner (10)")
    add("--storage", metavar="WHERE", help="journal file, or URL of a database (study.log in the new folder)")
    add("--study-name", metavar="NAME", help="name of the study in the storage (ALGO_ENV)")
    add("--search-space", metavar="FILE", help="YAML file of what is varied (the package's, for the algorithm)")
    add("-f", "--log-folder", default="logs", metavar="DIR", help="results go to DIR/tune/ALGO/ENV_N (logs)")
    add("--seed", type=seed, help="seed of trainings and sampler (0); negative: a random one")
    add("--eval-episodes", type=whole, metavar="N", help="episodes per evaluation (batch: 240, else 48)")
