"""Statistics of SB3's VecNormalize, by which an agent's observations are normalised."""

from copy import deepcopy
from typing import Any

from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_quad.base.errors import ConfigError

# The attribute of a model. It is the wrapper itself, which pickles its statistics, so that every
# zip of the model contains the current ones.
STATISTICS = "vec_normalize"


def statistics_of(model: Any) -> Any:
    """Return the VecNormalize whose observations a model was trained with; None: raw ones.

    :param model: an SB3 model, or any other controller, which has none.
    """
    statistics = getattr(model, "_vec_normalize_env", None) or getattr(model, STATISTICS, None)
    return statistics if getattr(statistics, "norm_obs", False) else None


def share_statistics(statistics: Any, env: Any, training: bool = False) -> None:
    """Let an environment normalise by the statistics of another VecNormalize.

    :param statistics: the other VecNormalize, or None.
    :param env: a VecEnv, or None.
    :param training: whether they continue to learn there; otherwise rewards stay raw, too, as in
        the environments of SB3's EvalCallback.
    :raises ConfigError: only one of the two normalises observations.
    """
    own = unwrap_vec_normalize(env)
    if getattr(statistics, "norm_obs", False) != getattr(own, "norm_obs", False):
        raise ConfigError(
            "VecNormalize: the agent and its environment must both have it, or neither "
            "(settings: normalize: true)"
        )
    if own is None:
        return
    for name in ("obs_rms", "ret_rms", "clip_obs", "epsilon"):
        if hasattr(statistics, name):
            setattr(own, name, deepcopy(getattr(statistics, name)))
    if not training:
        own.training = False
        own.norm_reward = False
