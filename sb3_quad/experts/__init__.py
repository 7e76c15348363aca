"""Controllers that know the model: the teachers of DAgger and of PPO with behavioural cloning."""
