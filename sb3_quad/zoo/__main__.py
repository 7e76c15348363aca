"""``python -m sb3_quad.zoo SCRIPT …``: rl_zoo3's scripts, with our algorithms and settings known to them."""

import argparse
import runpy
import sys

from sb3_quad.base.errors import SB3QuadError

SCRIPTS = ("train", "enjoy", "record_video", "push_to_hub", "load_from_hub")


def main() -> int:
    """Run one of them; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sb3_quad.zoo")
    parser.add_argument("script", choices=SCRIPTS)
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="those of rl_zoo3's script")
    options = parser.parse_args()
    sys.argv = [f"rl_zoo3 {options.script}", *options.arguments]
    try:
        import sb3_quad.zoo  # noqa: F401

        runpy.run_module(f"rl_zoo3.{options.script}", run_name="__main__")
    except (SB3QuadError, ImportError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
