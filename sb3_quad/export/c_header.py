"""A policy as a C header: C99, float32, nothing but ``tanhf`` and ``sqrtf`` of math.h, no memory but the stack."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from sb3_quad.base.errors import ConfigError
from sb3_quad.export.network import N_ROTORS, Layer, Network
from sb3_quad.simulation.observation import OBSERVATION_SIZE

WIDTH = 110  # columns


def c_name(text: str) -> str:
    """``text`` as the beginning of C identifiers: what C does not allow becomes an underscore."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_")
    return name if name and not name[0].isdigit() else f"quad_{name}".rstrip("_")


def check_name(name: str) -> str:
    """``name``, if C identifiers may begin so.

    :raises ConfigError: it cannot.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ConfigError(f"--name {name!r}: must be a C identifier: letters, digits and underscores, a letter first")
    return name


def write(network: Network, metadata: Mapping[str, str], name: str) -> bytes:
    """The header, with ``static inline void NAME_policy(const float observation[18], float thrust[4])``.

    For speeds the second parameter is called ``rotor_speed``.

    :param metadata: becomes the comment at the top.
    :param name: see :func:`check_name`.
    """
    guard = f"{name.upper()}_POLICY_H"
    prefix = f"{name}_policy"
    tables = [_table(f"{prefix}_mean", network.mean), _table(f"{prefix}_inverse_std", network.inverse_std)]
    for k, layer in enumerate(network.layers):
        tables += [_table(f"{prefix}_weight_{k}", layer.weight), _table(f"{prefix}_bias_{k}", layer.bias)]
    parts = [_comment(metadata), f"#ifndef {guard}\n#define {guard}\n\n#include <math.h>\n", *tables]
    return "\n".join([*parts, _function(network, prefix), f"#endif /* {guard} */\n"]).encode("ascii")


def _comment(metadata: Mapping[str, str]) -> str:
    lines = []
    for key, value in metadata.items():
        # Nothing that a file may be called ends the comment, or is more than ASCII.
        text = f"{key}: {value}".replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
        text = text.encode("ascii", "backslashreplace").decode("ascii")
        lines += textwrap.wrap(text, WIDTH - 3, subsequent_indent="    ", break_on_hyphens=False)
    return "\n".join(["/*", *(f" * {line}" for line in lines), " */"])


def _number(value: np.float32) -> str:
    text = f"{float(value):.9g}"  # nine digits tell any two float32 apart
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def _table(name: str, values: npt.NDArray[np.float32]) -> str:
    size = "".join(f"[{length}]" for length in values.shape)
    rows = values if values.ndim == 2 else values[None]
    lines = []
    for row in rows:
        text = textwrap.fill(", ".join(map(_number, row)), WIDTH - 8, break_on_hyphens=False)
        lines.append(textwrap.indent(f"{{{text}}}," if values.ndim == 2 else text, "    "))
    return "\n".join([f"static const float {name}{size} = {{", *lines, "};\n"])


def _function(network: Network, prefix: str) -> str:
    lines = [
        f"static inline void {prefix}(const float observation[{OBSERVATION_SIZE}], float {network.result}[{N_ROTORS}])",
        "{",
        f"    float layer_0[{OBSERVATION_SIZE}];",
        *(f"    float layer_{k + 1}[{len(layer.bias)}];" for k, layer in enumerate(network.layers)),
        "    int i, j;",
        "",
        f"    for (i = 0; i < {OBSERVATION_SIZE}; ++i) {{",
        f"        layer_0[i] = (observation[i] - {prefix}_mean[i]) * {prefix}_inverse_std[i];",
        "    }",
    ]
    for k, layer in enumerate(network.layers):
        lines += _layer(k, layer, prefix)
    last = f"layer_{len(network.layers)}"
    lines += [
        f"    for (i = 0; i < {N_ROTORS}; ++i) {{",
        f"        float a = {last}[i];",
        "",
        "        a = a < -1.0f ? -1.0f : (a > 1.0f ? 1.0f : a);",
        f"        a = {_number(network.middle)} + {_number(network.half_range)} * a;",
        f"        {network.result}[i] = {'a' if network.output == 'thrusts' else 'sqrtf(a < 0.0f ? 0.0f : a)'};",
        "    }",
        "}",
        "",
    ]
    return "\n".join(lines)


def _layer(k: int, layer: Layer, prefix: str) -> list[str]:
    outputs, inputs = layer.weight.shape
    result = {"none": "sum", "tanh": "tanhf(sum)", "relu": "sum < 0.0f ? 0.0f : sum"}[layer.activation]
    return [
        f"    for (i = 0; i < {outputs}; ++i) {{",
        f"        float sum = {prefix}_bias_{k}[i];",
        "",
        f"        for (j = 0; j < {inputs}; ++j) {{",
        f"            sum += {prefix}_weight_{k}[i][j] * layer_{k}[j];",
        "        }",
        f"        layer_{k + 1}[i] = {result};",
        "    }",
    ]
