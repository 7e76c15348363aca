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

project = "sb3_quad"
version = sb3_quad.__version__
author = "the sb3_quad developers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = f"sb3_quad {version}"
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_exclude = ".linenos, .gp, .go"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
linkcheck_anchors = False
# Other packages document their names themselves.
IGNORED = "Bounded|StopSignals|Perceptrons"
nitpick_ignore_regex = [("py:.*", r"(?!sb3_quad).*"), ("py:class", rf".*\.({IGNORED})")]

# The reference must have every name in the __all__ of these.
PACKAGES = ("sb3_quad", "sb3_quad.envs", "sb3_quad.callbacks", "sb3_quad.envs.vehicles")
IMPORTED = re.compile(r"^from (sb3_quad[\w.]*) import ([\w, ]+)", re.MULTILINE)


class Manual(SphinxDirective):
    """Include a docstring that is written in Markdown, as Gymnasium's are."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Parse it as a part of the page, its headings as bold lines."""
        text = inspect.getdoc(find(self.arguments[0])) or ""
        text = re.sub(r":(class|func|meth):`", r"{py:\1}`", text)
        text = re.sub(r"^#+ (.+)$", r"**\1**", text, flags=re.MULTILINE)
        node = nodes.container()
        self.state.nested_parse(StringList(text.splitlines(), self.arguments[0]), 0, node)
        return node.children


def find(path: str) -> object:
    """Import what a dotted path names."""
    module, _, name = path.rpartition(".")
    try:
        return importlib.import_module(path)
    except ModuleNotFoundError:
        return getattr(find(module), name)


def describe_fields(
    app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    """Describe the fields of a pydantic model as parameters, and leave out Markdown manuals.

    A page that has the manual shows it by the directive above.
    """
    if isinstance(thing, type) and issubclass(thing, BaseModel):
        lines.append("")
        for key, field in thing.model_fields.items():
            if field.description:
                lines.append(f":param {key}: {' '.join(field.description.split())}")
        lines.append("")
    if "## Description" in lines:
        lines[:] = ["The manual is above."]
    # |r| is a distance, and would be a substitution in reStructuredText.
    for number, line in enumerate(lines):
        lines[number] = re.sub(r"\|(r[^|`]*)\|", r"\\|\1\\|", line)


def check_coverage(app: Sphinx, env: BuildEnvironment) -> None:
    """Warn of public names, and of names that a page imports, that are not in the reference."""
    wanted = set()
    for package in PACKAGES:
        for name in importlib.import_module(package).__all__:
            wanted.add(f"{package}.{name}")
    wanted.discard("sb3_quad.__version__")
    for page in [ROOT / "README.md", *ROOT.glob("docs/**/*.md")]:
        for module, names in IMPORTED.findall(page.read_text(encoding="utf-8")):
            wanted.update(f"{module}.{name.strip()}" for name in names.split(","))

    # Compared as objects: a class may be documented under the path of another module.
    documented = []
    for path, entry in env.domains.python_domain.objects.items():
        if entry.objtype in ("class", "function", "data", "exception"):
            documented.append(find(path))
    for path in sorted(wanted):
        thing = find(path)
        if not any(thing is other for other in documented):
            logging.getLogger(__name__).warning("%s is not in the reference", path)


def link_cards(app: Sphinx, page: str, source: list[str]) -> None:
    """Let links to the agents' cards lead to the page of all cards."""
    card = re.compile(r"\]\((?:\.\./)+sb3_quad/agents/pretrained/([\w-]+)\.md\)")
    source[0] = card.sub(r"](/reference/cards.md#\1)", source[0])


def write_demo(app: Sphinx) -> None:
    """Write the page of `sb3-quad demo`, which demo.md shows in a frame."""
    from sb3_quad.evaluation.controllers import parse_controllers
    from sb3_quad.show.demo.page import DEFAULT_AGENTS, make_page

    if app.builder.format == "html":
        page = make_page(parse_controllers(DEFAULT_AGENTS), None)[0]
        (Path(app.outdir) / "throw.html").write_text(page, encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Connect the functions above to Sphinx."""
    app.add_directive("manual", Manual)
    app.connect("builder-inited", write_demo)
    app.connect("source-read", append_notebook)
    app.connect("source-read", link_cards)
    app.connect("autodoc-process-docstring", describe_fields)
    app.connect("env-check-consistency", check_coverage)
