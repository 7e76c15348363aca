"""Sweeps that make the tables of docs/research/results.md."""
