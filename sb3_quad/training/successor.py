"""Settings of a training that starts from a trained agent: observation and networks of its zip."""

from typing import Any

from sb3_quad.base.process import print_once
from sb3_quad.base.types import StrDict, StrPath
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.zips import load_model
from sb3_quad.evaluation.controllers import unlike_trained
from sb3_quad.training.config import TrainingConfig
from sb3_quad.vehicles.vehicle import first_vehicle


def as_agent(path: StrPath, config: TrainingConfig, changes: StrDict) -> StrDict:
    """Return ``changes`` to a settings file with the observation and networks of a zip added.

    What is in ``changes`` takes precedence. Evaluations fly with the agent's position integral, if
    it has one; training does without. A zip that does not say how its agent flies adds nothing.

    :param config: the settings with ``changes`` alone.
    """
    own, source = agent_settings(path)
    if source is None or config.task is None:
        return changes
    # A new vehicle may be what the user wants, so this is only a warning.
    notice = unlike_trained(str(path), own, first_vehicle(config.flight_settings.vehicle))
    if notice:
        print_once(f"warning: {notice}; --env-kwargs vehicle:… gives another one")
    env_kwargs = {
        name: own.observed[name]
        for name in ("last_action", "history", "observation_mean", "observation_std")
    }
    env_kwargs |= changes.get("env_kwargs", {})
    eval_env_kwargs = {"position_integral": own.observed["position_integral"]}
    eval_env_kwargs |= config.eval_env_kwargs
    eval_env_kwargs |= changes.get("eval_env_kwargs", {})
    merged = {**changes, "env_kwargs": env_kwargs, "eval_env_kwargs": eval_env_kwargs}
    # The actor of an off-policy algorithm imitates the agent, so its networks may differ.
    if "policy_kwargs" not in changes and not config.is_off_policy:
        policy: Any = load_model(path).policy
        merged["policy_kwargs"] = {
            **config.policy_kwargs,
            "net_arch": policy.net_arch,
            # As config.yml names it.
            "activation_fn": f"nn.{policy.activation_fn.__name__}",
        }
    return merged
