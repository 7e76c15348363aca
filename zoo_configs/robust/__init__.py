"""The shipped agents for random worlds: the default settings with more timesteps."""
