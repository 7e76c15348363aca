"""Gymnasium and Stable-Baselines3 environments of the quadcopter."""
