"""The settings of a training, from YAML."""
