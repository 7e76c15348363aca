"""The algorithms: DAgger, and PPO and SAC with behavioural cloning."""
