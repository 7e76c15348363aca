"""Say what this installation has, and what is missing.

It names versions, threads, the cache of compiled code, compilers, and the
extras that are not installed. Put its lines into reports of bugs.

examples:
  sb3-quad doctor
"""

import importlib.util
import os
import platform
import shutil
import sys
from argparse import Namespace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from sb3_quad.base import __version__
from sb3_quad.cli.parser import Flags

FLAGS: Flags = {}
PACKAGES = ("stable-baselines3", "torch", "gymnasium", "numpy", "numba", "pybullet")
# A module that each extra installs
EXTRAS = {
    "tune": "optuna",
    "video": "imageio",
    "export": "onnxruntime",
    "ray": "ray",
    "track": "wandb",
    "zoo": "rl_zoo3",
}
COMPILERS = ("cc", "gcc", "clang", "arm-none-eabi-gcc")
# What lowers the number of threads
LIMITS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def run(options: Namespace) -> int:
    """Print the lines. Returns the exit code."""
    import torch

    from sb3_quad.envs.simulation.kernel import step

    del options
    compilers = [name for name in COMPILERS if shutil.which(name)]
    limits = [f"{name}={os.environ[name]}" for name in LIMITS if name in os.environ]
    lacking = [name for name, module in EXTRAS.items() if not importlib.util.find_spec(module)]
    lines = {
        "sb3_quad": f"{__version__}, {Path(__file__).parents[2]}",
        "Python": f"{platform.python_version()}, {sys.executable}",
        "machine": f"{platform.platform()}, {os.cpu_count()} cores",
        "packages": ", ".join(map(_installed, PACKAGES)),
        "PyTorch": f"{torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}",
        "limits": ", ".join(limits) or "none set",
        "compiled code": _cache(step),
        "compilers": ", ".join(compilers) or "none: exported C is not checked (apt install gcc)",
        "extras": _extras(lacking),
    }
    for title, text in lines.items():
        print(f"{title:14}{text}")
    return 0


def _installed(package: str) -> str:
    """Return the name and the version of a package."""
    try:
        return f"{package} {version(package)}"
    except PackageNotFoundError:
        return f"{package} missing (pip install {package})"


def _extras(lacking: list[str]) -> str:
    """Say which extras are not installed, and how to install one."""
    if not lacking:
        return "all installed"
    return f"without {', '.join(lacking)} (pip install '.[{lacking[0]}]' from a clone)"


def _cache(function: object) -> str:
    """Say where a compiled function is kept, and whether it has been compiled.

    :param function: one of :func:`sb3_quad.base.compiled.compiled`.
    """
    cache = getattr(function, "_cache", None)
    path = getattr(cache, "cache_path", None)
    if path is None:
        return "kept nowhere, so it compiles at every start: set NUMBA_CACHE_DIR to a folder"
    megabytes = sum(file.stat().st_size for file in Path(path).glob("*.nb?")) / 1e6
    return (
        f"{path}, {megabytes:.0f} MB" if megabytes else f"{path}, nothing yet: first use compiles"
    )
