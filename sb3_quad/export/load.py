"""Exported files, run as their users do: loaded by onnxruntime, or compiled."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sb3_quad.base.errors import ConfigError, ExportError, raised_as
from sb3_quad.base.imports import require
from sb3_quad.base.templates import render
from sb3_quad.base.types import Float32Array

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
Call = Callable[..., tuple[Float32Array, Any]]
"""A function from observations in physical units, (n, numbers), and states to results, (n, 4), and
the next states. The state None begins flights. That of a header also takes references, (n, 5):
velocity, heading and heading rate.
"""


def load_onnx(content: bytes, state_size: int) -> tuple[Call, str]:
    """Load the file with onnxruntime on one thread of the CPU. Return its call and the version.

    :param state_size: numbers in a state; 0: the file has no state.
    :raises ConfigError: onnxruntime is not installed.
    """
    runtime = require("onnxruntime", "export", "--format onnx")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])

    def call(rows: Float32Array, state: Any = None) -> Any:
        if not state_size:
            return session.run(None, {"observation": rows})[0], None
        # Zeros begin a flight.
        if state is None:
            state = np.zeros((len(rows), state_size), np.float32)
        return session.run(None, {"observation": rows, "state": state})

    return call, f"onnxruntime {runtime.__version__}"


def load_header(content: bytes, state_size: int, name: str) -> tuple[Call, str]:
    """Load a C header with the machine's compiler, see :func:`load_onnx`.

    :param name: the beginning of the header's identifiers.
    :raises ConfigError: there is no compiler.
    :raises ExportError: the header does not compile without warnings.
    """
    compiler = next(filter(shutil.which, COMPILERS), None)
    if compiler is None:
        raise ConfigError(
            "--format c needs a C compiler, to check what it writes: "
            "install gcc or clang (apt install gcc)"
        )
    program = render("sb3_quad.export", "run.c.j2", name=name, stateful=state_size > 0)
    with tempfile.TemporaryDirectory(prefix="sb3_quad_") as folder:
        Path(folder, "policy.h").write_bytes(content)
        Path(folder, "run.c").write_text(program, encoding="ascii")
        command = (compiler, *FLAGS, "-shared", "-fPIC", "-o", "run.so", "run.c", "-lm")
        failed = "the C header cannot be checked"
        with raised_as(ExportError, failed):
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode:
                reason = " ".join(done.stderr.split())[:200]
                raise ExportError(f"{failed}: {compiler} failed ({reason})")
            library = ctypes.CDLL(f"{folder}/run.so")

    def call(rows: Float32Array, state: Any = None, references: Any = None) -> Any:
        if references is None:
            references = np.zeros((len(rows), 5), np.float32)
        begins = state is None
        if begins:
            # A new struct may contain anything before its reset.
            state = np.full((len(rows), library.size()), 0xFF, np.uint8)
        results = np.empty((len(rows), 4), np.float32)
        arrays = map(np.ctypeslib.as_ctypes, (rows, references, results, state))
        library.run(*arrays, begins, ctypes.c_long(len(rows)))
        return results, state

    return call, f"{compiler} {' '.join(FLAGS)}"
