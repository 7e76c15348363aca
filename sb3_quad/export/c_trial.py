"""Running an exported C header: compiled by the machine's own compiler, or, where there is none, its numbers by numpy."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from sb3_quad.base.errors import ExportError
from sb3_quad.export.check import Trial
from sb3_quad.export.network import N_ROTORS, Float32Array, Network
from sb3_quad.simulation.observation import OBSERVATION_SIZE

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
ROUNDS = 5  # through all observations, of which the fastest is the time
TIME_LIMIT = 120.0  # s

# Reads float32 rows from a file, writes the results to another, and prints µs per call.
_PROGRAM = """#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "policy.h"

int main(int argc, char **argv)
{
    const size_t n = argc > 3 ? (size_t)strtoul(argv[3], NULL, 10) : 0;
    float *in = malloc((n + 1) * @IN@ * sizeof(float)), *out = malloc((n + 1) * @OUT@ * sizeof(float));
    FILE *file = argc > 3 ? fopen(argv[1], "rb") : NULL;
    double best = 1e30;
    size_t k;
    int round;

    if (!in || !out || !file || fread(in, @IN@ * sizeof(float), n, file) != n) return 1;
    fclose(file);
    for (round = 0; round < @ROUNDS@; ++round) {
        const clock_t start = clock();
        double elapsed;
        for (k = 0; k < n; ++k) @NAME@_policy(in + @IN@ * k, out + @OUT@ * k);
        elapsed = (double)(clock() - start) / CLOCKS_PER_SEC;
        if (elapsed < best) best = elapsed;
    }
    file = fopen(argv[2], "wb");
    if (!file || fwrite(out, @OUT@ * sizeof(float), n, file) != n || fclose(file)) return 1;
    printf("%.6f\\n", best * 1e6 / (double)n);
    free(in);
    free(out);
    return 0;
}
"""


def find_compiler() -> str | None:
    """The path of a C compiler, or None."""
    return next((path for name in COMPILERS if (path := shutil.which(name))), None)


def run(content: bytes, observations: Float32Array, name: str, network: Network) -> Trial:
    """What the compiled header gives; without a compiler, what its numbers give in numpy, untimed.

    :param observations: physical units, (n, 18).
    :param name: the beginning of the header's identifiers.
    :param network: its activations and output; the numbers are the header's own.
    :raises ExportError: the header does not compile without warnings, or its program fails.
    """
    compiler = find_compiler()
    if compiler is None:
        by = "its numbers in numpy: there is no C compiler here, so it was not compiled"
        return Trial(_by_numpy(content.decode("ascii"), observations, name, network), None, by)
    with tempfile.TemporaryDirectory(prefix="sb3_quad_") as place:
        folder = Path(place)
        values = {"NAME": name, "IN": OBSERVATION_SIZE, "OUT": N_ROTORS, "ROUNDS": ROUNDS}
        program = re.sub(r"@(\w+)@", lambda match: str(values[match[1]]), _PROGRAM)
        (folder / "policy.h").write_bytes(content)
        (folder / "main.c").write_text(program, encoding="ascii")
        observations.astype(np.float32).tofile(folder / "in")
        _call(compiler, *FLAGS, "-o", "main", "main.c", "-lm", folder=folder)
        microseconds = float(_call("./main", "in", "out", str(len(observations)), folder=folder))
        results = np.fromfile(folder / "out", dtype=np.float32).reshape(-1, N_ROTORS)
    return Trial(results, microseconds, f"{Path(compiler).name} {' '.join(FLAGS)}")


def _call(*command: str, folder: Path) -> str:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=TIME_LIMIT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ExportError(f"the C header cannot be checked: {command[0]} failed ({error})") from None
    if done.returncode:
        said = next((line for line in done.stderr.splitlines() if "error" in line), f"exit status {done.returncode}")
        raise ExportError(f"the C header cannot be checked: {command[0]} failed ({said})")
    return done.stdout


def _by_numpy(text: str, observations: Float32Array, name: str, network: Network) -> Float32Array:
    tables = {}
    for key, size, body in re.findall(rf"float {name}_policy_(\w+?)((?:\[\d+\])+) = {{(.*?)}};", text, re.DOTALL):
        shape = [int(length) for length in re.findall(r"\d+", size)]
        tables[key] = np.array([float(word) for word in re.findall(r"[-\d.e+]+(?=f)", body)], dtype=np.float32).reshape(shape)
    value = (observations - tables["mean"]) * tables["inverse_std"]
    for k, layer in enumerate(network.layers):
        value = value @ tables[f"weight_{k}"].T + tables[f"bias_{k}"]
        if layer.activation != "none":
            value = np.tanh(value) if layer.activation == "tanh" else np.maximum(value, 0)
    found = re.search(r"a = (\S+)f \+ (\S+)f \* a;", text)
    if found is None:
        raise ExportError("the C header cannot be checked: it holds no line from actions to rotors")
    value = np.float32(found[1]) + np.float32(found[2]) * np.clip(value, np.float32(-1), np.float32(1))
    return np.asarray(value if network.output == "thrusts" else np.sqrt(np.maximum(value, 0)), dtype=np.float32)
