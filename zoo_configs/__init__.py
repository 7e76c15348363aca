"""Training settings, one YAML per algorithm, in the format of rl-zoo."""
