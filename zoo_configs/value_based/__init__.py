"""Pipelines whose second stage learns by values: SAC from an imitation."""
