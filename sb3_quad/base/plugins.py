"""What lower packages may ask of higher ones, by name: the only names that point upwards.

The algorithms work with objects of any origin. A user of this package may also give them names, and
has compiled code compute small policies. What does that is looked up here when it is first needed,
so that the algorithms import none of it.
"""

from typing import Any

from sb3_quad.base.imports import import_name

PLUGINS = {
    # (policy) -> a Network that computes it faster than PyTorch does, or None
    "accelerate": "sb3_quad.fast:accelerate",
    # (name, vehicle) -> the expert of that name, such as "pid" or the path of a zip
    "expert": "sb3_quad.agents.resolve:resolve_expert",
    # (path or name) -> the model in a zip, for initial_policy="..."
    "agent": "sb3_quad.agents.transfer:model_of",
    # (label, model, flight settings) -> None; warns of a model that has learnt to observe otherwise
    "observation": "sb3_quad.agents.agent_settings:warn_of_observation",
}
"""Functions as ``module:function``, by what they are asked for."""
FLIGHT_SETTINGS = "flight_settings"
"""The attribute by which an environment says how it flies, and a model how it was trained to fly.

The algorithms copy it from one to the other: :meth:`write_into` of an environment's puts it into a
model's zips.
"""


def plugin(name: str) -> Any:
    """Return the function that ``PLUGINS`` names.

    :raises ConfigError: it cannot be imported.
    """
    return import_name(PLUGINS[name], name)
