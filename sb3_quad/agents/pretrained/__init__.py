"""Trained policies that come with the package.

Each ``NAME.zip``, which stock PPO loads, has a card ``NAME.md`` that says what the policy flies,
how it was trained (command, seed, commit) and what was measured. ``examples/publish.py`` writes
both.
"""

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.agents.hub import ADDRESS, hub_agent
from sb3_quad.base.errors import refuse_unknown

if TYPE_CHECKING:
    from stable_baselines3 import PPO

FOLDER = Path(__file__).parent
# Agents in a run folder.
CORRECTED = "corrected_model.zip"
BEST = "best_model.zip"


def pretrained_names() -> list[str]:
    """Return the names of the policies that come with the package."""
    return sorted(path.stem for path in FOLDER.glob("*.zip"))


def pretrained_path(name: str) -> Path:
    """Return the zip of a policy that comes with the package, for Stable-Baselines3's ``PPO.load``.

    >>> import sb3_quad
    >>> sb3_quad.pretrained_path("itm-recovery").name
    'itm-recovery.zip'

    :raises ConfigError: an unknown name.
    """
    refuse_unknown("pretrained policy", [name], pretrained_names())
    return FOLDER / f"{name}.zip"


def load_pretrained(name: str, **kwargs: Any) -> "PPO":
    """Return a policy that comes with the package, as a stock PPO model, or one of the Hub to fly.

    It takes the observations of an environment made with :func:`env_kwargs` of that name, and
    returns 4 actions in [-1, 1]. A zip of the Hub is read as data, so that it cannot run code.

    :param name: a name of the package, or ``hf:ORG/NAME`` on the Hugging Face Hub.
    :param kwargs: passed on to ``PPO.load``, such as ``env`` and ``device`` (default: "cpu").
    :raises ConfigError: an unknown name, or a file of the Hub that is refused.
    """
    from stable_baselines3 import PPO

    kwargs.setdefault("device", "cpu")
    if name.startswith(ADDRESS):
        # By its name, since commands look for agents before they import PyTorch.
        zips = importlib.import_module("sb3_quad.agents.zips")
        model: PPO = zips.load_zip(None, hub_agent(name), name, **kwargs)
        return model
    return PPO.load(pretrained_path(name), **kwargs)


def agent_path(text: str) -> str:
    """Return the path of an agent's zip.

    :param text: the name of a policy that comes with the package, ``hf:ORG/NAME`` on the Hugging
        Face Hub, or a run folder. Anything else is returned as it is.
    :raises ConfigError: an agent of the Hub that cannot be downloaded.
    """
    if text.startswith(ADDRESS):
        return hub_agent(text)
    if text in pretrained_names():
        return str(pretrained_path(text))
    configs = sorted(Path(text).glob("*/config.yml"))
    if len(configs) == 1:
        return str(run_agent(Path(text), configs[0].parent.name))
    return text


def run_agent(folder: Path, name: str) -> Path:
    """Return the agent of a run.

    It is the one with corrected offset, or else the best one, or else the last one, ``<name>.zip``.
    """
    for path in (folder / CORRECTED, folder / BEST):
        if path.is_file():
            return path
    return folder / f"{name}.zip"
