"""``python -m sb3_quad.zoo SCRIPT …``: rl_zoo3's scripts, with our algorithms and settings known to them."""

from __future__ import annotations

import importlib
import runpy
import sys

from sb3_quad.base.errors import SB3QuadError, unknown

SCRIPTS = {  # the function to call, or the module to run
    **{name: f"rl_zoo3.{name}:{name}" for name in ("train", "enjoy")},
    **{name: f"rl_zoo3.plots.{name}:{name}" for name in ("plot_train", "plot_from_file", "all_plots")},
    **{name: f"rl_zoo3.{name}" for name in ("record_video", "push_to_hub", "load_from_hub")},
}


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
        module, _, function = SCRIPTS[script].partition(":")
        if function:
            getattr(importlib.import_module(module), function)()
        else:
            runpy.run_module(module, run_name="__main__")
    except (SB3QuadError, ImportError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
