"""Texts from templates: pages, reports, exported policies."""

from typing import Any

import jinja2


def render(package: str, template: str, **content: Any) -> str:
    """Return the text of a template in the folder of a package, filled with its content.

    In templates called ``*.html.j2`` the content is escaped.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(package, ""),
        autoescape=jinja2.select_autoescape(["html.j2"]),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(content)
