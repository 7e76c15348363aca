"""Searches for hyperparameters, by Optuna."""

import warnings

from sb3_quad.base.imports import require

optuna = require("optuna", "tune", "a search")
optuna.logging.set_verbosity(optuna.logging.ERROR)  # trials that fail are reported in our own lines
warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
# SB3 warns of each batch size that does not divide the rollout, which a search often tries.
warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
