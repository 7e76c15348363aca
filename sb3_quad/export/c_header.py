"""A policy as a C header, by the template ``policy.h.j2``."""

import re
import textwrap
from collections.abc import Mapping
from typing import Any

import jinja2
import numpy as np

from sb3_quad.base.arrays import Float32Array
from sb3_quad.export.network import Network, StatefulNetwork
from sb3_quad.simulation.observation import OBSERVATION_SIZE, F

WIDTH = 110  # columns


def c_name(text: str) -> str:
    """Return ``text`` as the beginning of C identifiers: other characters become underscores."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_")
    return name if name and not name[0].isdigit() else f"quad_{name}".rstrip("_")


def write_header(network: Network, metadata: Mapping[str, str], name: str) -> bytes:
    """Return the header, with ``static inline void NAME_policy(const float observation[18], float
    thrust[4])``.

    For a policy with a state the function takes a ``NAME_state *`` before these, which
    ``NAME_reset`` lets begin a flight.

    :param network: for speeds the second parameter is called ``rotor_speed``.
    :param metadata: becomes the comment at the top.
    :param name: beginning of the identifiers, as :func:`c_name` gives it.
    """
    # The constants of the file, by name.
    tables = {"mean": network.mean, "inverse_std": network.inverse_std}
    for number, (layer, _) in enumerate(network.steps):
        tables[f"weight_{number}"] = layer.weight
        tables[f"bias_{number}"] = layer.bias
    # A policy of the present features alone has no state, and gets a shorter function.
    state: dict[str, Any] = {}
    if isinstance(network, StatefulNetwork):
        names = ("gain", "distance2", "speed2", "limit")
        state = {
            "observation": network.observation,
            "integral": dict(zip(names, map(_number, network.integral or ()), strict=False)),
            "keeps_actions": bool(network.actions),
        }
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sb3_quad.export", ""),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    text = environment.get_template("policy.h.j2").render(
        name=name,
        guard=f"{name.upper()}_POLICY_H",
        comment=_comment(metadata),
        tables=[_table(f"{name}_policy_{key}", value.numpy()) for key, value in tables.items()],
        layers=network.shapes,
        features=OBSERVATION_SIZE,
        position=F.position,
        velocity=F.velocity,
        result=network.result,
        middle=_number(network.middle),
        half_range=_number(network.half_range),
        **{"keeps_actions": False, **state},
    )
    return text.encode("ascii")


def _comment(metadata: Mapping[str, str]) -> list[str]:
    lines: list[str] = []
    for key, value in metadata.items():
        # A file may have any name, but the name must neither end the comment nor leave ASCII.
        text = f"{key}: {value}".replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
        text = text.encode("ascii", "backslashreplace").decode("ascii")
        lines += textwrap.wrap(text, WIDTH - 3, subsequent_indent="    ", break_on_hyphens=False)
    return lines


def _number(value: Any) -> str:
    """Return the fewest digits that tell a float32 from any other."""
    return f"{np.float32(value)!s}f"


def _table(name: str, values: Float32Array) -> str:
    size = "".join(f"[{length}]" for length in values.shape)
    # NumPy's brackets become C's braces.
    with np.printoptions(threshold=values.size, linewidth=WIDTH, formatter={"float_kind": _number}):
        rows = np.array2string(values, separator=", ").translate(str.maketrans("[]", "{}"))
    return f"{name}{size} =\n{rows}"
