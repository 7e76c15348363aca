"""``python -m sb3_quad.zoo SCRIPT …``: rl_zoo3's scripts, with our algorithms and settings known to them."""

import importlib
import runpy
import sys

from sb3_quad.base.errors import SB3QuadError, unknown

SCRIPTS = ("train", "enjoy", "plot_train", "plot_from_file", "all_plots", "record_video", "push_to_hub", "load_from_hub")


def main() -> int:
    """Run one of them; returns the exit code."""
    script, *arguments = sys.argv[1:] or ["--help"]
    if script in ("-h", "--help"):
        print(f"usage: python -m sb3_quad.zoo {{{','.join(SCRIPTS)}}} …   the arguments are those of rl_zoo3's script")
        return 0
    if script not in SCRIPTS:
        print(f"error: {unknown('script', script, SCRIPTS)}", file=sys.stderr)
        return 2
    sys.argv = [f"rl_zoo3 {script}", *arguments]
    try:
        import sb3_quad.zoo  # noqa: F401

        if "plot" in script:
            getattr(importlib.import_module("rl_zoo3.plots"), script)()
        else:
            runpy.run_module(f"rl_zoo3.{script}", run_name="__main__")
    except (SB3QuadError, ImportError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
