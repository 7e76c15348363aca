"""Agents for vehicles and forces that nobody measured: they remember, and learn from an expert that is told."""
