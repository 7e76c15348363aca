"""Searches for hyperparameters, by Optuna."""

import warnings

from sb3_quad.base.imports import require

optuna = require("optuna", "tune", "a search")
optuna.logging.set_verbosity(optuna.logging.ERROR)  # trials that fail are reported in our own lines
warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
