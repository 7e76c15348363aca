"""Quadcopter environments, experts, DAgger, and PPO and SAC with behavioural cloning for Stable-Baselines3."""

from pathlib import Path
from typing import TYPE_CHECKING

# In a checkout, `envs/`, `callbacks/` and `zoo_configs/` lie beside this folder rather than inside it; an installed
# package holds them inside, and then this does nothing.
_checkout = Path(__file__).resolve().parent.parent
if (_checkout / "setup.cfg").is_file() and (_checkout / "envs" / "__init__.py").is_file():
    __path__.append(str(_checkout))

from sb3_quad.base.imports import lazy_names  # noqa: E402
from sb3_quad.envs.registration import register_environments  # noqa: E402

if TYPE_CHECKING:
    from sb3_quad.dagger.dagger import DAgger
    from sb3_quad.dagger.recurrent import RecurrentDAgger as RecurrentDAgger
    from sb3_quad.experts.geometric import GeometricExpert
    from sb3_quad.experts.pid import PIDExpert
    from sb3_quad.ppo_bc.ppo_bc import PPOBC
    from sb3_quad.pretrained_policies import load_pretrained, pretrained
    from sb3_quad.sac_bc.sac_bc import SACBC
    from sb3_quad.settings.flight import env_kwargs
    from sb3_quad.simulation.designs import sample_vehicles

__version__ = "0.1.0"
__all__ = [  # less RecurrentDAgger, which needs an extra
    "PPOBC",
    "SACBC",
    "DAgger",
    "GeometricExpert",
    "PIDExpert",
    "__version__",
    "env_kwargs",
    "load_pretrained",
    "pretrained",
    "sample_vehicles",
]

_LAZY = {  # imported on first use, so that `import sb3_quad` and `--help` do not wait for torch
    "DAgger": "sb3_quad.dagger.dagger",
    "GeometricExpert": "sb3_quad.experts.geometric",
    "PIDExpert": "sb3_quad.experts.pid",
    "PPOBC": "sb3_quad.ppo_bc.ppo_bc",
    "RecurrentDAgger": "sb3_quad.dagger.recurrent",
    "SACBC": "sb3_quad.sac_bc.sac_bc",
    "env_kwargs": "sb3_quad.settings.flight",
    "load_pretrained": "sb3_quad.pretrained_policies",
    "pretrained": "sb3_quad.pretrained_policies",
    "sample_vehicles": "sb3_quad.simulation.designs",
}

register_environments()

__getattr__, __dir__ = lazy_names(__name__, _LAZY)
