"""Agents on the Hugging Face Hub."""

from sb3_quad.base.errors import ConfigError, raised_as
from sb3_quad.base.imports import require

ADDRESS = "hf:"


def hub_agent(address: str) -> str:
    """Download an agent's zip into the Hub's cache, unless it is there; return its path.

    :param address: ``hf:ORG/NAME`` for the file ``NAME.zip`` of that repository, as rl_zoo3 and
        ``examples/publish.py`` name it, or ``hf:ORG/NAME/FILE.zip``.
    :raises ConfigError: an address of another form, or a download that fails.
    :raises MissingExtra: huggingface_hub is not installed.
    """
    owner, name, file = (*address.removeprefix(ADDRESS).split("/", 2), "", "")[:3]
    if not owner or not name:
        raise ConfigError(f"{address}: must be hf:ORG/NAME or hf:ORG/NAME/FILE.zip")
    hub = require("huggingface_hub", "hub", "an agent of the Hub")
    with raised_as(ConfigError, f"{address}: cannot be downloaded"):
        return str(hub.hf_hub_download(f"{owner}/{name}", file or f"{name}.zip"))
