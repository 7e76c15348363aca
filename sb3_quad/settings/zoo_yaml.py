"""The YAML of rl_zoo3's run folders: plain, but for a few tags of Python's that its dump leaves there.

Its own reader lets YAML call any function; this one knows ordered mappings, tuples and names of the classes that settings
may hold (``nn.Tanh``), and refuses every other tag.
"""

from __future__ import annotations

from typing import Any

import yaml

from sb3_quad.settings.literals import CLASSES

_PYTHON = "tag:yaml.org,2002:python"


class ZooLoader(yaml.SafeLoader):
    """A SafeLoader that reads those tags too."""


def _mapping(loader: ZooLoader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.SequenceNode) or len(node.value) != 1:
        raise yaml.constructor.ConstructorError(None, None, "no pairs in an OrderedDict", node.start_mark)
    (pairs,) = loader.construct_sequence(node, deep=True)
    try:
        return dict(pairs)
    except (TypeError, ValueError):
        raise yaml.constructor.ConstructorError(None, None, "no pairs in an OrderedDict", node.start_mark) from None


def _sequence(loader: ZooLoader, node: yaml.Node) -> list[Any]:
    if not isinstance(node, yaml.SequenceNode):
        raise yaml.constructor.ConstructorError(None, None, "a tuple that is none", node.start_mark)
    return loader.construct_sequence(node, deep=True)


def _class_name(loader: ZooLoader, suffix: str, node: yaml.Node) -> str:
    """``torch.nn.modules.activation.Tanh`` as ``nn.Tanh``."""
    parts = suffix.split(".")
    name = ".".join((parts[1], parts[-1])) if len(parts) > 2 and parts[0] == "torch" else suffix
    if name not in CLASSES:
        raise yaml.constructor.ConstructorError(None, None, f"{suffix} is no class that settings may hold", node.start_mark)
    return name


ZooLoader.add_constructor(f"{_PYTHON}/object/apply:collections.OrderedDict", _mapping)
ZooLoader.add_constructor(f"{_PYTHON}/tuple", _sequence)
ZooLoader.add_multi_constructor(f"{_PYTHON}/name:", _class_name)
