"""Pipelines whose second stage is value-based: SAC from an imitation agent."""
