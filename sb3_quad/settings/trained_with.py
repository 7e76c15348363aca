"""The vehicle and the scaling that a policy was trained with: its zip does not hold them, its run folder does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_quad.base.errors import ConfigError
from sb3_quad.settings.config import read_yaml
from sb3_quad.settings.literals import ZooLoader, parse_mapping


@dataclass(frozen=True)
class TrainedWith:
    """What the run folder says, None where it says nothing.

    :param vehicle: name or path.
    :param observation_mean: μ of Eq. 3.16, (18,); ``observation_std`` σ, likewise.
    :param source: the file that says so, or why there is none.
    """

    vehicle: Any = None
    observation_mean: Any = None
    observation_std: Any = None
    source: str = "none beside the zip (itm, Table A.2)"


def trained_with(path: str | Path) -> TrainedWith:
    """The settings beside a zip in its run folder, ``<Env>/config.yml``.

    :raises ConfigError: settings of which one file is not to be told from another, a file that is not YAML, or
        statistics of VecNormalize, which are no part of the zip and of no export.
    """
    folder = Path(path).parent
    statistics = sorted(folder.glob("*/vecnormalize.pkl"))
    if statistics:
        raise ConfigError(
            f"{path}: was trained with VecNormalize ({statistics[0]}), whose scaling does not export; train without it"
        )
    files = sorted(folder.glob("*/config.yml"))
    if not files:
        return TrainedWith()
    if len(files) > 1:
        raise ConfigError(f"{path}: several settings lie beside it ({', '.join(map(str, files))}); copy the zip elsewhere")
    try:
        content = read_yaml(files[0].read_text(encoding="utf-8"), str(files[0]), ZooLoader)
    except (OSError, UnicodeDecodeError, ConfigError) as error:
        raise ConfigError(f"{files[0]}: cannot be read ({error}); copy the zip elsewhere to export it without") from None
    if not isinstance(content, dict):
        raise ConfigError(f"{files[0]}: holds no settings; copy the zip elsewhere to export it without")
    given = parse_mapping(content.get("env_kwargs"), f"{files[0]}: env_kwargs")
    kept = {key: given.get(key) for key in ("vehicle", "observation_mean", "observation_std")}
    return TrainedWith(**kept, source=str(files[0]))
