"""Searches for hyperparameters and for an expert's gains, by Optuna."""

import warnings

from sb3_quad.base.imports import require

optuna = require("optuna", "tune", "a search")
optuna.logging.set_verbosity(optuna.logging.WARNING)
warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
