"""Sweeps, by which tables of docs/results.md are made."""
