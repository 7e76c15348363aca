"""The search for an algorithm's hyperparameters."""
