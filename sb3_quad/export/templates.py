"""Templates of files: exported policies, what they say about themselves, and the demo's page."""

from typing import Any

import jinja2
import numpy as np


def render(template: str, package: str = "sb3_quad.export", **values: Any) -> str:
    """Fill in a template of a package; its filter ``c_number`` is :func:`c_number`."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(package, ""),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["c_number"] = c_number
    return environment.get_template(template).render(values)


def c_number(value: Any) -> str:
    """Return the fewest digits that tell a float32 from any other."""
    return f"{np.float32(value)!s}f"
