"""A policy as a C header: C99, float32, nothing but ``tanhf`` and ``sqrtf`` of math.h, no heap."""

import re
import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_quad.base.arrays import Float32Array
from sb3_quad.export.network import Network, StatefulNetwork
from sb3_quad.simulation.observation import OBSERVATION_SIZE, F

WIDTH = 110  # columns
RESULTS = {"none": "sum", "tanh": "tanhf(sum)", "relu": "sum < 0.0f ? 0.0f : sum"}


def c_name(text: str) -> str:
    """``text`` as the beginning of C identifiers: what C does not allow becomes an underscore."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_")
    return name if name and not name[0].isdigit() else f"quad_{name}".rstrip("_")


def write_header(network: Network, metadata: Mapping[str, str], name: str) -> bytes:
    """The header, with ``static inline void NAME_policy(const float observation[18], float thrust[4])``.

    For a policy with a state the function takes a ``NAME_state *`` before these, which ``NAME_reset`` lets begin a flight.

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
    if isinstance(network, StatefulNetwork):
        parts.insert(2, _struct(network, name))
        keep = f"        state->frames[state->slot][{OBSERVATION_SIZE} + i] = a;\n" if network.actions else ""
        parts.append(_function(network, prefix, f"{name}_state *state, ", _observe(network, prefix), keep))
    else:
        parts.append(_function(network, prefix))
    return "\n".join([*parts, f"#endif /* {guard} */\n"]).encode("ascii")


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


def _struct(network: StatefulNetwork, name: str) -> str:
    seen = network.observation
    integral = "    float integral[3]; /* m */\n    int begun;\n" if network.integral else ""
    return f"""\
#include <string.h>

typedef struct {{
    float frames[{seen.ages[-1] + 1}][{seen.frame_size}]; /* of the latest calls, round and round */
    int slot; /* of the present one */
{integral}}} {name}_state;

static inline void {name}_reset({name}_state *state)
{{
    memset(state, 0, sizeof *state);
}}
"""


def _observe(network: StatefulNetwork, prefix: str) -> str:
    """What makes of the scaled features, the beginning of ``layer_0``, all that the policy sees."""
    ages, depth, integral = network.observation.ages, network.observation.ages[-1] + 1, ""
    if network.integral:
        gain, distance2, speed2, limit = map(_number, network.integral)
        integral = f"""\
    float error2 = 0.0f, speed2 = 0.0f;

    for (i = 0; i < 3; ++i) {{
        error2 += observation[{F.position} + i] * observation[{F.position} + i];
        speed2 += observation[{F.velocity} + i] * observation[{F.velocity} + i];
    }}
    for (i = 0; i < 3; ++i) {{
        float s = state->integral[i];

        if (state->begun && error2 < {distance2} && speed2 < {speed2}) {{
            s += {gain} * observation[{F.position} + i];
            state->integral[i] = s = s < -{limit} ? -{limit} : (s > {limit} ? {limit} : s);
        }}
        layer_0[{F.position} + i] += s * {prefix}_inverse_std[{F.position} + i];
    }}
    state->begun = 1;
"""
    return f"""\
    static const int ages[{len(ages)}] = {{{", ".join(map(str, ages))}}};
{integral}    memcpy(state->frames[state->slot], layer_0, {OBSERVATION_SIZE} * sizeof(float));
    for (i = 0; i < {len(ages)}; ++i) {{
        j = (state->slot + {depth} - ages[i]) % {depth};
        memcpy(layer_0 + {network.observation.frame_size} * i, state->frames[j], sizeof state->frames[j]);
    }}
    state->slot = (state->slot + 1) % {depth};
"""


def _function(network: Network, prefix: str, state: str = "", frames: str = "", keep: str = "") -> str:
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
static inline void {prefix}({state}const float observation[{OBSERVATION_SIZE}], float {network.result}[{outputs}])
{{
    float layer_0[{inputs}];
{"".join(declarations)}    int i, j;

    for (i = 0; i < {OBSERVATION_SIZE}; ++i) {{
        layer_0[i] = (observation[i] - {prefix}_mean[i]) * {prefix}_inverse_std[i];
    }}
{frames}{"".join(loops)}    for (i = 0; i < {outputs}; ++i) {{
        float a = layer_{len(layers)}[i];

        a = a < -1.0f ? -1.0f : (a > 1.0f ? 1.0f : a);
{keep}        a = {_number(network.middle)} + {_number(network.half_range)} * a;
        {network.result}[i] = {root};
    }}
}}
"""
