"""Sweeps, by which tables of docs/research/results.md are made."""
