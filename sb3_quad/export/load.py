"""An exported file as its users run it: loaded by torch, by onnxruntime, or compiled; and the time
of a call.
"""

import ctypes
import io
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_quad.base.arrays import Float32Array
from sb3_quad.base.errors import ConfigError, ExportError
from sb3_quad.base.files import one_line
from sb3_quad.base.imports import require
from sb3_quad.simulation.observation import OBSERVATION_SIZE

N_ROTORS = 4
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
Call = Callable[..., tuple[Float32Array, Any]]
"""From observations in physical units, (n, 18), and states to results, (n, 4), and the next states;
None: flights begin.
"""


def load_torchscript(content: bytes) -> tuple[Call, str]:
    """The file as torch loads it on the CPU; and torch's version."""
    extra = {"metadata.json": ""}
    module = th.jit.load(io.BytesIO(content), "cpu", extra)  # type: ignore[no-untyped-call]
    size = int(json.loads(extra["metadata.json"]).get("state_size", 0))

    @th.no_grad()
    def run(*inputs: Float32Array) -> Sequence[Float32Array]:
        outputs = module(*map(th.from_numpy, inputs))
        return [output.numpy() for output in (outputs if size else [outputs])]

    return _call(run, size), f"torch {th.__version__}"


def load_onnx(content: bytes) -> tuple[Call, str]:
    """As :func:`load_torchscript`, by onnxruntime on one thread of the CPU.

    :raises ConfigError: it is not installed.
    """
    runtime = require("onnxruntime", "export", "--format onnx")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    names, state = [port.name for port in session.get_inputs()], session.get_inputs()[1:]

    def run(*inputs: Float32Array) -> Any:
        return session.run(None, dict(zip(names, inputs, strict=True)))

    return _call(run, state[0].shape[1] if state else 0), f"onnxruntime {runtime.__version__}"


def _call(run: Callable[..., Sequence[Float32Array]], size: int) -> Call:
    """:param size: numbers in a state of ``run``; 0: it takes and gives none."""

    def call(rows: Float32Array, state: Float32Array | None = None) -> tuple[Float32Array, Any]:
        if not size:
            return run(rows)[0], None
        results, following = run(
            rows, np.zeros((len(rows), size), dtype=np.float32) if state is None else state
        )
        return results, following

    return call


def load_header(content: bytes, name: str) -> tuple[Call, str]:
    """As :func:`load_torchscript`, of a C header by the machine's compiler.

    :param name: the beginning of the header's identifiers.
    :raises ConfigError: there is no compiler.
    :raises ExportError: the header does not compile without warnings.
    """
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        raise ConfigError(
            "--format c needs a C compiler, to check what it writes: install gcc or clang (apt install gcc)"
        )
    has_state = f"}} {name}_state;".encode() in content
    instead = (
        ""
        if has_state
        else f"typedef char {name}_state;\n#define {name}_reset(state) (*(state) = 0)\n"
    )
    program = f"""\
#include "policy.h"
{instead}int size(void) {{ return (int)sizeof({name}_state); }}
void run(const float *in, float *out, {name}_state *states, int begin, long n)
{{
    for (long k = 0; k < n; ++k) {{
        if (begin) {name}_reset(&states[k]);
        {name}_policy({"&states[k], " * has_state}in + {OBSERVATION_SIZE} * k, out + {N_ROTORS} * k);
    }}
}}
"""
    with tempfile.TemporaryDirectory(prefix="sb3_quad_") as folder:
        (Path(folder) / "policy.h").write_bytes(content)
        (Path(folder) / "run.c").write_text(program, encoding="ascii")
        command = (compiler, *FLAGS, "-shared", "-fPIC", "-o", "run.so", "run.c", "-lm")
        try:
            subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
            library = ctypes.CDLL(str(Path(folder) / "run.so"))
        except subprocess.CalledProcessError as error:
            said = " ".join(error.stderr.split())[:200]
            raise ExportError(
                f"the C header cannot be checked: {compiler} failed ({said})"
            ) from None
        except OSError as error:
            raise ExportError(f"the C header cannot be checked: {one_line(error)}") from None

    def call(rows: Float32Array, state: Any = None) -> tuple[Float32Array, Any]:
        # A new struct holds anything before its reset.
        states = (
            np.full((len(rows), library.size()), 0xFF, dtype=np.uint8) if state is None else state
        )
        results = np.empty((len(rows), N_ROTORS), dtype=np.float32)
        arrays = map(np.ctypeslib.as_ctypes, (rows, results, states))
        library.run(*arrays, state is None, ctypes.c_long(len(rows)))
        return results, states

    return call, f"{Path(compiler).name} {' '.join(FLAGS)}"
