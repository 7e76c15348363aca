"""Settings of a training that starts from a trained agent: observation and networks as in its zip."""

from pathlib import Path
from typing import Any

from sb3_quad.base.notices import tell
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.zips import load_model
from sb3_quad.evaluation.controllers import unlike_trained
from sb3_quad.training.config import TrainingConfig
from sb3_quad.vehicles.vehicle import first_vehicle


def as_agent(path: str | Path, config: TrainingConfig, changes: dict[str, Any]) -> dict[str, Any]:
    """``changes`` to a settings file, and with them what makes its agent's successor: observation
    and networks, as in the zip.

    What ``changes`` give themselves holds. Evaluations fly with the agent's integral, if it has
    one, as it does; training does without. A zip that says nothing of its flights changes nothing.

    :param config: what the file and ``changes`` alone amount to.
    """
    own, source = agent_settings(path)
    if source is None or config.task is None:
        return changes
    if notice := unlike_trained(str(path), own, first_vehicle(config.flight_settings.vehicle)):
        tell(f"warning: {notice}; --env-kwargs vehicle:… says which")
    seen = {
        name: own.observed[name]
        for name in ("last_action", "history", "observation_mean", "observation_std")
    }
    flown = {"position_integral": own.observed["position_integral"]}
    given = {**changes, "env_kwargs": {**seen, **changes.get("env_kwargs", {})}}
    given["eval_env_kwargs"] = {
        **flown,
        **config.eval_env_kwargs,
        **changes.get("eval_env_kwargs", {}),
    }
    if "policy_kwargs" not in changes and not config.is_off_policy:
        policy: Any = load_model(path).policy
        unit = f"nn.{policy.activation_fn.__name__}"  # as config.yml names it
        given["policy_kwargs"] = {
            **config.policy_kwargs,
            "net_arch": policy.net_arch,
            "activation_fn": unit,
        }
    return given
