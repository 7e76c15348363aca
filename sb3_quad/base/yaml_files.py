"""YAML files, by the name of one that comes with the package, or by path."""

import os
from collections import Counter
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.files import one_line, read_text, write_text
from sb3_quad.base.types import StrDict, StrMapping, StrPath

# The most characters of a text, which take a few seconds
LONGEST = 100_000


class Loader(yaml.SafeLoader):
    """PyYAML's SafeLoader, which refuses two equal keys, and reads what rl_zoo3 writes.

    That is ordered mappings, tuples and names of classes. No class is imported. Aliases that expand
    a short text too much are refused.
    """

    def get_single_node(self) -> Any:
        root = super().get_single_node()
        _walk(root, 100_000 + len(self.buffer))
        return root

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        # A key may also be a list.
        keys = Counter(key.value for key, _ in node.value if isinstance(key.value, str))
        for key, times in keys.items():
            if times > 1:
                raise yaml.YAMLError(f"{key}: given twice{node.start_mark}")
        return node

    def construct_python(self, tag: str, node: Any) -> Any:
        if tag == "tuple":
            return self.construct_sequence(node, deep=True)
        if tag == "object/apply:collections.OrderedDict":
            (pairs,) = self.construct_sequence(node, deep=True)
            return dict(pairs)
        if tag.startswith("name:torch."):
            # torch.nn.modules.activation.Tanh becomes nn.Tanh, as settings name it.
            _, package, *_, name = tag.split(".")
            return f"{package}.{name}"
        raise ValueError(f"{tag}: no such value in settings")


def _walk(node: Any, most: int, deepest: int = 50) -> int:
    """Walk over everything that a YAML node contains, and return how much of ``most`` is left.

    A few lines of a file can contain a node so many times, or so deep, that a program that copies
    or shows it never ends. Here each one counts as often as it occurs.

    :param most: the maximum number of nodes.
    :param deepest: the maximum depth.
    :raises ValueError: there are more, or one contains itself.
    """
    # The parts of a mapping are pairs of nodes.
    parts = getattr(node, "value", node)
    if isinstance(parts, str):
        return most
    for part in parts or ():
        most -= 1
        if most < 0 or deepest == 0:
            raise ValueError("too many values, or too deep; one that is repeated counts each time")
        most = _walk(part, most, deepest - 1)
    return most


Loader.add_multi_constructor("tag:yaml.org,2002:python/", Loader.construct_python)


def parse_keys(text: str, where: str) -> dict[Any, Any]:
    """Return the keys and values of a YAML text.

    :raises ConfigError: The text is not YAML, or holds something else. The message is one line.
    """
    if len(text) > LONGEST:
        raise ConfigError(f"{where}: is longer than {LONGEST:,} characters")
    try:
        content = yaml.load(text, Loader=Loader)
    except Exception as error:
        # A value that does not fit its tag may raise anything.
        raise ConfigError(f"{where}: not valid YAML ({one_line(error)})") from None
    if not isinstance(content, dict):
        raise ConfigError(f"{where}: must hold keys and values")
    return content


def read_yaml(path: Path) -> dict[Any, Any]:
    """Return the keys and values of a YAML file.

    :raises ConfigError: See :func:`parse_keys`; or the file cannot be read.
    """
    return parse_keys(read_text(path), str(path))


def write_yaml(path: StrPath, content: StrMapping) -> None:
    """Write keys and values in their order; the file appears whole or not at all."""
    write_text(path, yaml.safe_dump(content, sort_keys=False))


class YamlFolder(NamedTuple):
    """YAML files of one kind that come with the package. Users name their own files by path.

    :param kind: The kind for error messages, such as "vehicle".
    :param package: The package that holds the files.
    :param suffix: The suffix of the files.
    :param folders: Further folders inside the package. With them, the suffix is part of a name, as
        in ``thesis/dagger.yml``.
    """

    kind: str
    package: str
    suffix: str = ".yaml"
    folders: tuple[str, ...] = ()

    def names(self) -> list[str]:
        """Return the names of the files in the package."""
        return sorted(self._files())

    def is_path(self, source: StrPath) -> bool:
        """Whether a source is the path of a file rather than a name.

        If the suffix is part of the name, a source is a path if the user has such a file.
        """
        if isinstance(source, Path):
            return True
        if self.folders:
            return Path(source).is_file()
        return bool(Path(source).suffix) or "/" in source

    def text(self, source: StrPath) -> tuple[str, str]:
        """Return the text of a file by name or path, and the file's name for messages.

        :raises ConfigError: An unknown name, or a file that is missing or cannot be read.
        """
        if not isinstance(source, (str, os.PathLike)):
            raise ConfigError(
                f"{self.kind} {source!r}: must be a name or the path of a {self.suffix} file"
            )
        if self.is_path(source):
            return read_text(source), str(source)
        name = str(source)
        text = self.packaged(name).read_text(encoding="utf-8")
        return text, name.removesuffix(self.suffix) + self.suffix

    def is_packaged(self, source: StrPath) -> bool:
        """Whether a source is a file of the package, by name or as :meth:`packaged` returns it."""
        return not self.is_path(source) or source in self._files().values()

    def packaged(self, name: str) -> Any:
        """Return the path of a file of the package, which a user's file does not replace.

        :raises ConfigError: An unknown name.
        """
        files = self._files()
        refuse_unknown(self.kind, [name], files, f", or the path of a {self.suffix} file")
        return files[name]

    def read(self, source: StrPath) -> tuple[dict[Any, Any], str]:
        """Return the keys and values of a file by name or path, and its name for messages.

        :raises ConfigError: See :meth:`text` and :func:`parse_keys`.
        """
        text, where = self.text(source)
        return parse_keys(text, where), where

    def _files(self) -> StrDict:
        files = {}
        for folder in ("", *self.folders):
            for file in resources.files(self.package).joinpath(folder).iterdir():
                if file.name.endswith(self.suffix):
                    name = f"{folder}/{file.name}".removeprefix("/")
                    files[name if self.folders else name.removesuffix(self.suffix)] = file
        return files
