"""Trained policies that come with the package: for each ``NAME.zip``, for stock PPO, a card
``NAME.md``.

The card says what it flies, how it was trained (command, seed, commit) and what was measured.
``examples/publish.py`` writes both.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_quad.base.errors import ConfigError, unknown

if TYPE_CHECKING:
    from stable_baselines3 import PPO

FOLDER = Path(__file__).parent
CORRECTED, BEST = "corrected_model.zip", "best_model.zip"  # in a run folder


def pretrained_names() -> list[str]:
    """Names of the policies that come with the package."""
    return sorted(path.stem for path in FOLDER.glob("*.zip"))


def pretrained(name: str) -> Path:
    """The zip of a policy that comes with the package, for ``PPO.load`` of Stable-Baselines3.

    >>> import sb3_quad
    >>> sb3_quad.pretrained("itm-recovery").name
    'itm-recovery.zip'

    :raises ConfigError: an unknown name.
    """
    path = FOLDER / f"{name}.zip"
    if name not in pretrained_names():
        raise ConfigError(unknown("pretrained policy", name, pretrained_names()))
    return path


def load_pretrained(name: str, **kwargs: Any) -> "PPO":
    """A policy that comes with the package, as a stock PPO model.

    It reads what an environment with :func:`env_kwargs` of that name observes, and gives 4 actions
    in [-1, 1].

    :param kwargs: of ``PPO.load``, such as ``env`` and ``device`` (here "cpu" unless told
        otherwise).
    :raises ConfigError: an unknown name.
    """
    from stable_baselines3 import PPO

    return PPO.load(pretrained(name), **{"device": "cpu", **kwargs})


def agent_path(text: str) -> str:
    """The path of an agent's zip, from what stands for one: the name of a policy that comes with
    the package, or a run folder.

    Anything else is returned as it is.
    """
    if text in pretrained_names():
        return str(pretrained(text))
    configs = sorted(Path(text).glob("*/config.yml"))
    return str(run_agent(Path(text), configs[0].parent.name)) if len(configs) == 1 else text


def run_agent(folder: Path, name: str) -> Path:
    """What a run has to offer: its trimmed agent, else its best one, else its last one,
    ``<name>.zip``.
    """
    zips = [folder / file for file in (CORRECTED, BEST, f"{name}.zip")]
    return next((path for path in zips if path.is_file()), zips[-1])
