"""Callbacks for any Stable-Baselines3 algorithm: one idea per file."""
