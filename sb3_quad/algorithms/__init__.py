"""The algorithms: DAgger, PPO with behavioural cloning, and the gradient of the model.

They need Stable-Baselines3 and PyTorch, and nothing of the simulator. What of this package they ask
for by name is in :mod:`sb3_quad.base.plugins`.
"""
