"""Quadcopter environments, experts, DAgger, PPO and SAC with behavioural cloning, and training by
the gradient of the model, for Stable-Baselines3.
"""

from typing import TYPE_CHECKING

from sb3_quad.base import __version__
from sb3_quad.base.imports import lazy_names
from sb3_quad.envs.registration import register_environments

if TYPE_CHECKING:
    from sb3_quad.agents.agent_settings import env_kwargs
    from sb3_quad.agents.pretrained import load_pretrained, pretrained_path
    from sb3_quad.algorithms.apg import APG
    from sb3_quad.algorithms.dagger import DAgger
    from sb3_quad.algorithms.ppo_bc import PPOBC
    from sb3_quad.algorithms.sac_bc import SACBC
    from sb3_quad.envs.gym_vector import QuadcopterGymVectorEnv
    from sb3_quad.envs.quadcopter_env import QuadcopterEnv
    from sb3_quad.envs.simulation.sampled_vehicles import sample_vehicles
    from sb3_quad.envs.vec_env import QuadcopterVecEnv
    from sb3_quad.envs.vehicles.vehicle import load_vehicle
    from sb3_quad.evaluation.compare import compare
    from sb3_quad.evaluation.flights import fly
    from sb3_quad.experts.geometric import GeometricExpert
    from sb3_quad.experts.pid import PIDExpert

__all__ = [
    "APG",
    "PPOBC",
    "SACBC",
    "DAgger",
    "GeometricExpert",
    "PIDExpert",
    "QuadcopterEnv",
    "QuadcopterGymVectorEnv",
    "QuadcopterVecEnv",
    "__version__",
    "compare",
    "env_kwargs",
    "fly",
    "load_pretrained",
    "load_vehicle",
    "pretrained_path",
    "sample_vehicles",
]

# Imported on first use, so that `import sb3_quad` and `--help` do not wait for torch
_LAZY = {
    "APG": "sb3_quad.algorithms.apg",
    "DAgger": "sb3_quad.algorithms.dagger",
    "GeometricExpert": "sb3_quad.experts.geometric",
    "PIDExpert": "sb3_quad.experts.pid",
    "PPOBC": "sb3_quad.algorithms.ppo_bc",
    "QuadcopterEnv": "sb3_quad.envs.quadcopter_env",
    "QuadcopterVecEnv": "sb3_quad.envs.vec_env",
    "QuadcopterGymVectorEnv": "sb3_quad.envs.gym_vector",
    "SACBC": "sb3_quad.algorithms.sac_bc",
    "compare": "sb3_quad.evaluation.compare",
    "env_kwargs": "sb3_quad.agents.agent_settings",
    "fly": "sb3_quad.evaluation.flights",
    "load_pretrained": "sb3_quad.agents.pretrained",
    "load_vehicle": "sb3_quad.envs.vehicles.vehicle",
    "pretrained_path": "sb3_quad.agents.pretrained",
    "sample_vehicles": "sb3_quad.envs.simulation.sampled_vehicles",
}

register_environments()

__getattr__, __dir__ = lazy_names(__name__, _LAZY)
