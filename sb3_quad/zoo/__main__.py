"""``python -m sb3_quad.zoo SCRIPT …``: rl_zoo3's scripts, with our algorithms and settings known to them."""

from __future__ import annotations

import importlib
import runpy
import sys

from sb3_quad.base.errors import SB3QuadError, unknown

FUNCTIONS = ("train", "enjoy", "plot_train", "plot_from_file", "all_plots")  # of rl_zoo3's modules of the same names
SCRIPTS = (*FUNCTIONS, "record_video", "push_to_hub", "load_from_hub")


def main() -> int:
    """Run one of them; returns the exit code."""
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print(f"usage: python -m sb3_quad.zoo {{{','.join(SCRIPTS)}}} …   the arguments are those of rl_zoo3's script")
        return 0
    script = sys.argv[1]
    if script not in SCRIPTS:
        print(f"error: {unknown('script', script, SCRIPTS)}", file=sys.stderr)
        return 2
    try:
        import sb3_quad.zoo  # noqa: F401

        sys.argv = [f"rl_zoo3 {script}", *sys.argv[2:]]
        module = f"rl_zoo3.plots.{script}" if "plot" in script else f"rl_zoo3.{script}"
        if script in FUNCTIONS:
            getattr(importlib.import_module(module), script)()
        else:
            runpy.run_module(module, run_name="__main__")
    except (SB3QuadError, ImportError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
