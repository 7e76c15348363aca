"""Training jobs: their YAML settings, run folders, environments, interruption and resumption."""
