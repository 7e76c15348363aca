"""Starting from an agent that a path or a name stands for."""

from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_quad.agents.pretrained import agent_path
from sb3_quad.agents.zips import load_model
from sb3_quad.algorithms.common import copy_policy
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import StrPath


def model_of(source: BaseAlgorithm | StrPath) -> BaseAlgorithm:
    """Return the model that ``source`` is or names.

    :param source: a model, the path of a zip, a run folder, or the name of a shipped agent.
    :raises ConfigError: a missing or damaged file, or something else.
    """
    if isinstance(source, (str, Path)):
        return load_model(agent_path(str(source)))
    if not isinstance(source, BaseAlgorithm):
        raise ConfigError(
            f"initial_policy {source!r}: must be a model, the path of a zip, or a name"
        )
    return source


def transfer_policy(source: BaseAlgorithm | StrPath, model: Any) -> None:
    """Give ``model`` the policy and critic of another agent: see
    :func:`~sb3_quad.algorithms.common.copy_policy`.

    :param source: a model of any algorithm, or what names one for :func:`model_of`.
    :raises ConfigError: a zip that is missing or incomplete, or an agent that does not fit.
    """
    name = "" if isinstance(source, BaseAlgorithm) else str(source)
    copy_policy(model_of(source), model, name)
