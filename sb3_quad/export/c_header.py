"""A policy as a C header: C99, float32, nothing but ``tanhf`` and ``sqrtf`` of math.h, no memory but the stack."""

import re
import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_quad.base.arrays import Float32Array
from sb3_quad.export.network import Network

WIDTH = 110  # columns
RESULTS = {"none": "sum", "tanh": "tanhf(sum)", "relu": "sum < 0.0f ? 0.0f : sum"}


def c_name(text: str) -> str:
    """``text`` as the beginning of C identifiers: what C does not allow becomes an underscore."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_")
    return name if name and not name[0].isdigit() else f"quad_{name}".rstrip("_")


def write_header(network: Network, metadata: Mapping[str, str], name: str) -> bytes:
    """The header, with ``static inline void NAME_policy(const float observation[18], float thrust[4])``.

    :param network: for speeds the second parameter is called ``rotor_speed``.
    :param metadata: becomes the comment at the top.
    :param name: beginning of the identifiers, as :func:`c_name` gives it.
    """
    guard, prefix = f"{name.upper()}_POLICY_H", f"{name}_policy"
    tables = {"mean": network.mean, "inverse_std": network.inverse_std}
    for k, (layer, _) in enumerate(network.steps):
        tables |= {f"weight_{k}": layer.weight, f"bias_{k}": layer.bias}
    arrays = [_table(f"{prefix}_{key}", value.numpy()) for key, value in tables.items()]
    parts = [_comment(metadata), f"#ifndef {guard}\n#define {guard}\n\n#include <math.h>\n", *arrays]
    return "\n".join([*parts, _function(network, prefix), f"#endif /* {guard} */\n"]).encode("ascii")


def _comment(metadata: Mapping[str, str]) -> str:
    lines = []
    for key, value in metadata.items():
        # Nothing that a file may be called ends the comment, or is more than ASCII.
        text = f"{key}: {value}".replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
        text = text.encode("ascii", "backslashreplace").decode("ascii")
        lines += textwrap.wrap(text, WIDTH - 3, subsequent_indent="    ", break_on_hyphens=False)
    return "\n".join(["/*", *(f" * {line}" for line in lines), " */"])


def _number(value: Any) -> str:
    return f"{np.float32(value)!s}f"  # the fewest digits that tell it from any other float32


def _table(name: str, values: Float32Array) -> str:
    size = "".join(f"[{length}]" for length in values.shape)
    with np.printoptions(threshold=values.size, linewidth=WIDTH, formatter={"float_kind": _number}):
        rows = np.array2string(values, separator=", ").translate(str.maketrans("[]", "{}"))
    return f"static const float {name}{size} =\n{rows};\n"


def _function(network: Network, prefix: str) -> str:
    layers = network.steps
    inputs, outputs = layers[0][0].in_features, layers[-1][0].out_features
    root = "a" if network.output == "thrusts" else "sqrtf(a < 0.0f ? 0.0f : a)"
    declarations = [f"    float layer_{k + 1}[{layer.out_features}];\n" for k, (layer, _) in enumerate(layers)]
    loops = [
        f"""\
    for (i = 0; i < {layer.out_features}; ++i) {{
        float sum = {prefix}_bias_{k}[i];

        for (j = 0; j < {layer.in_features}; ++j) {{
            sum += {prefix}_weight_{k}[i][j] * layer_{k}[j];
        }}
        layer_{k + 1}[i] = {RESULTS[activation]};
    }}
"""
        for k, (layer, activation) in enumerate(layers)
    ]
    return f"""\
static inline void {prefix}(const float observation[{inputs}], float {network.result}[{outputs}])
{{
    float layer_0[{inputs}];
{"".join(declarations)}    int i, j;

    for (i = 0; i < {inputs}; ++i) {{
        layer_0[i] = (observation[i] - {prefix}_mean[i]) * {prefix}_inverse_std[i];
    }}
{"".join(loops)}    for (i = 0; i < {outputs}; ++i) {{
        float a = layer_{len(layers)}[i];

        a = a < -1.0f ? -1.0f : (a > 1.0f ? 1.0f : a);
        a = {_number(network.middle)} + {_number(network.half_range)} * a;
        {network.result}[i] = {root};
    }}
}}
"""
