"""A policy as a C header, by the template ``policy.h.j2``."""

import re
import textwrap
from typing import Any

import numpy as np

from sb3_quad.base.templates import render
from sb3_quad.base.types import StrDict
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE, F
from sb3_quad.export.network import Network

WIDTH = 110  # columns


def c_name(text: str) -> str:
    """Return ``text`` as the beginning of C identifiers: other characters become underscores."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_")
    if not name[:1].isalpha():
        name = f"quad_{name}".rstrip("_")
    return name


def write_header(network: Network, metadata: StrDict, name: str) -> bytes:
    """Return the header, with ``static inline void NAME_policy(const float observation[18], float
    thrust[4])``, and ``NAME_relate``, which makes an observation relative to a moving reference.

    For a policy with a state, the function takes a ``NAME_state *`` before these, which
    ``NAME_reset`` prepares for a flight.

    :param network: if it outputs speeds, the second parameter is called ``rotor_speed``.
    :param metadata: becomes the comment at the top.
    :param name: beginning of the identifiers, as :func:`c_name` gives it.
    """
    return render(
        "sb3_quad.export",
        "policy.h.j2",
        name=name,
        comment=_comment(metadata),
        table=_table,
        c_number=_number,
        network=network,
        features=OBSERVATION_SIZE,
        F=F,
    ).encode("ascii")


def _comment(metadata: StrDict) -> list[str]:
    lines = []
    for key, value in metadata.items():
        # A file may have any name, but here it must be ASCII and must not end the comment.
        text = f"{key}: {value}".replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
        text = text.encode("ascii", "backslashreplace").decode("ascii")
        lines += textwrap.wrap(text, WIDTH - 3, subsequent_indent="    ", break_on_hyphens=False)
    return lines


def _number(value: Any) -> str:
    """The fewest digits that distinguish a float32 from any other."""
    return f"{np.float32(value)!s}f"


def _table(name: str, tensor: Any) -> str:
    values = tensor.numpy()
    size = "".join(f"[{length}]" for length in values.shape)
    # NumPy's brackets become C's braces.
    with np.printoptions(threshold=values.size, linewidth=WIDTH, formatter={"float_kind": _number}):
        rows = np.array2string(values, separator=", ").translate(str.maketrans("[]", "{}"))
    return f"{name}{size} =\n{rows}"
