"""Errors, files, signals, seeds and validation, which every floor uses."""

__version__ = "0.1.0"
