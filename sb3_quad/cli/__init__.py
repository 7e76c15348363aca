"""The command line, ``sb3-quad`` or ``python -m sb3_quad.cli``."""

from sb3_quad.cli.app import main

__all__ = ["main"]
