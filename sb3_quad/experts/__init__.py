"""Controllers that know the model: teachers for DAgger and for cloning in PPO and SAC."""
