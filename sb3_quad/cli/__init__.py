"""The command line, ``sb3-quad`` or ``python -m sb3_quad.cli``."""

from collections.abc import Sequence

from sb3_quad.base.process import interrupts_leave


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line. Returns the exit code."""
    # Ctrl-C ends the imports at once.
    with interrupts_leave():
        from sb3_quad.cli import app
    return app.main(argv)
