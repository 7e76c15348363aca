"""The site, built by `make docs` into build/docs/."""

import importlib
import inspect
import re
import sys
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

from notebook_pages import append_notebook  # noqa: E402

import sb3_quad  # noqa: E402

project, version, author = "sb3_quad", sb3_quad.__version__, "the sb3_quad developers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
html_theme, html_title = "furo", f"sb3_quad {version}"
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_exclude = ".linenos, .gp, .go"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
linkcheck_anchors = False
nitpick_ignore_regex = [("py:.*", r"(?!sb3_quad).*")]  # what other packages document

PACKAGES = (
    "sb3_quad",
    "sb3_quad.envs",
    "sb3_quad.callbacks",
    "sb3_quad.vehicles",
)  # whose __all__ is in the reference
IMPORTED = re.compile(r"^from (sb3_quad[\w.]*) import ([\w, ]+)", re.MULTILINE)


class Manual(SphinxDirective):
    """A docstring that is written in Markdown, as Gymnasium's are."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Parse it as a part of the page, its headings as bold lines."""
        text = inspect.getdoc(find(self.arguments[0])) or ""
        text = re.sub(
            r"^#+ (.+)$",
            r"**\1**",
            re.sub(r":(class|func|meth):`", r"{py:\1}`", text),
            flags=re.MULTILINE,
        )
        node = nodes.container()
        self.state.nested_parse(StringList(text.splitlines(), self.arguments[0]), 0, node)
        return node.children


def find(path: str) -> object:
    """What a dotted path names."""
    module, _, name = path.rpartition(".")
    try:
        return importlib.import_module(path)
    except ModuleNotFoundError:
        return getattr(find(module), name)


def describe_fields(
    app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    """The fields of a pydantic model become its parameters; a manual in Markdown stands on the page
    already.
    """
    if isinstance(thing, type) and issubclass(thing, BaseModel):
        fields = {key: each.description for key, each in thing.model_fields.items()}
        lines += [
            "",
            *(f":param {key}: {' '.join(text.split())}" for key, text in fields.items() if text),
            "",
        ]
    if "## Description" in lines:
        lines[:] = ["The manual is above."]
    lines[:] = [
        re.sub(r"\|(r[^|`]*)\|", r"\\|\1\\|", line) for line in lines
    ]  # a distance, no substitution


def check_coverage(app: Sphinx, env: BuildEnvironment) -> None:
    """Each public name, and each name that a page imports, is in the reference."""
    wanted = {
        f"{package}.{name}"
        for package in PACKAGES
        for name in find(package).__all__
        if name != "__version__"
    }
    for page in [ROOT / "README.md", *ROOT.glob("docs/**/*.md")]:
        for module, names in IMPORTED.findall(page.read_text(encoding="utf-8")):
            wanted |= {f"{module}.{name.strip()}" for name in names.split(",")}
    kinds = ("class", "function", "data", "exception")
    documented = [
        find(path)
        for path, each in env.domains.python_domain.objects.items()
        if each.objtype in kinds
    ]
    for path in sorted(wanted):
        if not any(find(path) is each for each in documented):
            logging.getLogger(__name__).warning("%s is not in the reference", path)


def link_cards(app: Sphinx, page: str, source: list[str]) -> None:
    """The cards of the agents are a page of the site."""
    card = re.compile(r"\]\((?:\.\./)+sb3_quad/controllers/pretrained/([\w-]+)\.md\)")
    source[0] = card.sub(r"](/reference/cards.md#\1)", source[0])


def write_demo(app: Sphinx) -> None:
    """The page of `sb3-quad demo`, which demo.md shows in a frame."""
    from sb3_quad.evaluation.controllers import parse_controllers
    from sb3_quad.show.demo.page import DEFAULT_AGENTS, make_page

    if app.builder.format == "html":
        (Path(app.outdir) / "throw.html").write_text(
            make_page(parse_controllers(DEFAULT_AGENTS), None)[0], encoding="utf-8"
        )


def setup(app: Sphinx) -> None:
    """Connect the above."""
    app.add_directive("manual", Manual)
    app.connect("builder-inited", write_demo)
    app.connect("source-read", append_notebook)
    app.connect("source-read", link_cards)
    app.connect("autodoc-process-docstring", describe_fields)
    app.connect("env-check-consistency", check_coverage)
