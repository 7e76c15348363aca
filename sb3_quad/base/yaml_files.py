"""YAML files by name, where they come with the package, or by path."""

from collections import Counter
from dataclasses import dataclass
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import one_line, read_text


class Loader(yaml.SafeLoader):
    """PyYAML's SafeLoader, which refuses two equal keys, and reads what rl_zoo3 writes.

    That is ordered mappings, tuples and names of classes, none of which is imported.
    """

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if twice := [key for key, times in keys.items() if times > 1]:
            raise yaml.YAMLError(f"{', '.join(twice)}: given twice{node.start_mark}")
        return node

    def construct_python(self, tag: str, node: Any) -> Any:
        match tag.split(":"):
            case ["tuple"]:
                return self.construct_sequence(node, deep=True)
            case ["object/apply", "collections.OrderedDict"]:
                (pairs,) = self.construct_sequence(node, deep=True)
                return dict(pairs)
            case ["name", name] if name.startswith(
                "torch."
            ):  # torch.nn.modules.activation.Tanh: nn.Tanh
                return ".".join([name.split(".")[1], name.split(".")[-1]])
        raise ValueError(f"{tag}: no such value in settings")


Loader.add_multi_constructor("tag:yaml.org,2002:python/", Loader.construct_python)


def parse_yaml(text: str, where: str) -> Any:
    """:raises ConfigError: text that is not YAML, in one line."""
    try:
        return yaml.load(text, Loader=Loader)
    except Exception as error:  # a value may raise anything when it does not fit its tag
        raise ConfigError(f"{where}: not valid YAML ({one_line(error)})") from None


def parse_keys(text: str, where: str) -> dict[Any, Any]:
    """:raises ConfigError: text that is not YAML, or holds no keys and values."""
    content = parse_yaml(text, where)
    if not isinstance(content, dict):
        raise ConfigError(f"{where}: must hold keys and values")
    return content


def read_yaml(path: Path) -> dict[Any, Any]:
    """As :func:`parse_keys`, of a file."""
    return parse_keys(read_text(path), str(path))


@dataclass(frozen=True)
class YamlFolder:
    """The YAML files of one kind that come with the package; a user's own are given by their paths.

    :param kind: what messages call such a file.
    :param package: that holds the files.
    :param suffix: of the files.
    :param folders: further ones inside the package. With them the suffix is part of a name, as in
        ``thesis/dagger.yml``.
    """

    kind: str
    package: str
    suffix: str = ".yaml"
    folders: tuple[str, ...] = ()

    def names(self) -> list[str]:
        """The names of the files in the package."""
        return list(self._files())

    def is_path(self, source: str | Path) -> bool:
        """Whether a source is the path of a file rather than a name.

        Where the suffix is part of the name, a source is a path if the user has such a file.
        """
        if isinstance(source, Path) or self.folders:
            return isinstance(source, Path) or Path(source).is_file()
        return bool(Path(source).suffix) or "/" in source

    def text(self, source: str | Path) -> tuple[str, str]:
        """The text of a file by name or path, and what messages call it.

        :raises ConfigError: an unknown name, a missing or unreadable file.
        """
        if self.is_path(source):
            return read_text(source), str(source)
        name, files = str(source), self._files()
        if name not in files:
            raise ConfigError(
                f"{unknown(self.kind, name, files)}, or the path of a {self.suffix} file"
            )
        return files[name].read_text(
            encoding="utf-8"
        ), f"{name.removesuffix(self.suffix)}{self.suffix}"

    def read(self, source: str | Path) -> tuple[dict[Any, Any], str]:
        """The keys and values of a file by name or path, and what messages call it.

        :raises ConfigError: as :meth:`text`; or it holds something else.
        """
        text, where = self.text(source)
        return parse_keys(text, where), where

    def _files(self) -> dict[str, Any]:
        package = resources.files(self.package)
        folders = {folder: package.joinpath(folder).iterdir() for folder in ("", *self.folders)}
        paths = sorted(
            str(PurePosixPath(folder, file.name))
            for folder, files in folders.items()
            for file in files
        )
        found = [path for path in paths if path.endswith(self.suffix)]
        return {
            path if self.folders else path.removesuffix(self.suffix): package.joinpath(path)
            for path in found
        }
