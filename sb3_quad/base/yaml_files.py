"""YAML files by name, where they come with the package, or by path."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import one_line, read_text

SUFFIXES = (".yaml", ".yml")
MAX_CHARACTERS, MAX_DEPTH, MAX_VALUES = 2**20, 50, 100_000  # of a file; levels; values, with those that aliases repeat


class LimitedLoader(yaml.SafeLoader):
    """PyYAML's SafeLoader; it refuses a key given twice, an alias of what it is part of, and what is too deep or too much."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise yaml.YAMLError(f"nested more than {MAX_DEPTH} levels deep")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def get_single_node(self) -> Any:
        node = super().get_single_node()
        if node is not None and self._count(node, {}) > MAX_VALUES:
            raise yaml.YAMLError(f"its aliases stand for more than {MAX_VALUES:,} values")
        return node

    def _count(self, node: Any, known: dict[Any, int]) -> int:
        """The values in a node, those of an alias as often as it stands there; 0 in ``known`` marks what is being counted."""
        if node in known:
            if known[node] == 0:
                raise yaml.YAMLError(f"an alias of what it is part of{node.start_mark}")
            return known[node]
        known[node], parts = 0, []
        if isinstance(node, yaml.SequenceNode):
            parts = node.value
        elif isinstance(node, yaml.MappingNode):
            keys = Counter((key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode))
            if twice := [name for (_, name), times in keys.items() if times > 1]:
                raise yaml.YAMLError(f"{', '.join(twice)}: given twice{node.start_mark}")
            parts = [part for pair in node.value for part in pair]
        known[node] = 1 + sum(self._count(part, known) for part in parts)
        return known[node]


def parse_yaml(text: str, where: str, loader: type[LimitedLoader] = LimitedLoader) -> Any:
    """:raises ConfigError: text that is not YAML, or is too much of it, in one line."""
    if len(text) > MAX_CHARACTERS:
        raise ConfigError(f"{where}: has more than {MAX_CHARACTERS:,} characters; this is no file of settings")
    try:
        return yaml.load(text, Loader=loader)
    except Exception as error:  # beside YAMLError, whatever a value raises that is none of its tag's
        raise ConfigError(f"{where}: not valid YAML ({one_line(error)})") from None


def parse_mapping_file(path: Path, loader: type[LimitedLoader] = LimitedLoader) -> dict[str, Any]:
    """The keys and values of a YAML file.

    :raises ConfigError: it is missing, unreadable or holds something else.
    """
    return _mapping(parse_yaml(read_text(path), str(path), loader), str(path))


def _mapping(content: Any, where: str) -> dict[Any, Any]:
    if not isinstance(content, dict):
        raise ConfigError(f"{where}: must hold keys and values")
    return content


@dataclass(frozen=True)
class YamlFolder:
    """The YAML files of one kind that come with the package; a user's own are given by their paths.

    :param kind: what messages call such a file.
    :param package: that holds the files.
    :param suffix: of the files.
    :param in_name: whether the suffix is part of the name, as in ``thesis/dagger.yml``.
    :param folders: further ones inside the package, in the order in which their names are listed.
    :param former: beginnings of names that once were, and what they are now; former names still find the files.
    """

    kind: str
    package: str
    suffix: str = ".yaml"
    in_name: bool = False
    folders: tuple[str, ...] = ()
    former: Mapping[str, str] = field(default_factory=dict)

    def names(self) -> list[str]:
        """The names of the files in the package."""
        return list(self._files())

    def is_path(self, source: str | Path) -> bool:
        """Whether a source is the path of a file rather than a name.

        A name that could be a path, since it ends as one, stands for the user's file if there is one.
        """
        if isinstance(source, Path) or (self.in_name and Path(source).is_file()):
            return True
        return not self.in_name and (bool(Path(source).suffix) or "/" in source)

    def text(self, source: str | Path) -> tuple[str, str]:
        """The text of a file by name or path, and what messages call it.

        :raises ConfigError: an unknown name, a missing or unreadable file.
        """
        if self.is_path(source):
            return read_text(source), str(source)
        name, files = str(source), self._files()
        for former, now in self.former.items():
            name = name if not name.startswith(former) else now + name.removeprefix(former)
        if name not in files:
            raise ConfigError(f"{unknown(self.kind, name, files)}, or the path of a {self.suffix} file")
        return files[name].read_text(encoding="utf-8"), f"{name.removesuffix(self.suffix)}{self.suffix}"

    def read(self, source: str | Path) -> tuple[dict[Any, Any], str]:
        """The keys and values of a file by name or path, and what messages call it.

        :raises ConfigError: as :meth:`text`; or it holds something else.
        """
        text, where = self.text(source)
        return _mapping(parse_yaml(text, where), where), where

    def _files(self) -> dict[str, Any]:
        """The files in the package, by name."""
        found = {}
        for folder in ("", *self.folders):
            for file in sorted(resources.files(self.package).joinpath(folder).iterdir(), key=lambda file: file.name):
                if file.name.endswith(self.suffix):
                    name = str(PurePosixPath(folder, file.name))
                    found[name if self.in_name else name.removesuffix(self.suffix)] = file
        return found
