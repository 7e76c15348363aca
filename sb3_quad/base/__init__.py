"""Errors, files, signals, seeds and validation, which every layer uses."""

__version__ = "0.1.0"
