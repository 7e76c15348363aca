"""Quadcopter environments, experts, DAgger, PPO with behavioural cloning, and training by the
gradient of the model, for Stable-Baselines3.
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
    from sb3_quad.base.seeds import row_seeds
    from sb3_quad.callbacks.best_model import BestModel
    from sb3_quad.callbacks.every import Checkpoint, EpisodeLog, ProgressLine
    from sb3_quad.envs.flight_cost import FlownStates, flight_cost
    from sb3_quad.envs.quadcopter_env import QuadcopterEnv
    from sb3_quad.envs.simulation.randomization import Randomization
    from sb3_quad.envs.simulation.tasks import Task
    from sb3_quad.envs.vec_env import QuadcopterVecEnv
    from sb3_quad.envs.vehicles.vehicle import load_vehicle
    from sb3_quad.evaluation.compare import compare
    from sb3_quad.evaluation.flights import fly
    from sb3_quad.experts.geometric import GeometricExpert
    from sb3_quad.experts.pid import PIDExpert
    from sb3_quad.experts.protocol import Expert
    from sb3_quad.fast.policy import accelerate

__all__ = [
    "APG",
    "PPOBC",
    "BestModel",
    "Checkpoint",
    "DAgger",
    "EpisodeLog",
    "Expert",
    "FlownStates",
    "GeometricExpert",
    "PIDExpert",
    "ProgressLine",
    "QuadcopterEnv",
    "QuadcopterVecEnv",
    "Randomization",
    "Task",
    "__version__",
    "accelerate",
    "compare",
    "env_kwargs",
    "flight_cost",
    "fly",
    "load_pretrained",
    "load_vehicle",
    "pretrained_path",
    "row_seeds",
]

# Imported on first use, so that `import sb3_quad` and `--help` do not wait for torch
_LAZY = {
    "APG": "sb3_quad.algorithms.apg",
    "BestModel": "sb3_quad.callbacks.best_model",
    "Checkpoint": "sb3_quad.callbacks.every",
    "DAgger": "sb3_quad.algorithms.dagger",
    "EpisodeLog": "sb3_quad.callbacks.every",
    "Expert": "sb3_quad.experts.protocol",
    "FlownStates": "sb3_quad.envs.flight_cost",
    "GeometricExpert": "sb3_quad.experts.geometric",
    "PIDExpert": "sb3_quad.experts.pid",
    "PPOBC": "sb3_quad.algorithms.ppo_bc",
    "ProgressLine": "sb3_quad.callbacks.every",
    "QuadcopterEnv": "sb3_quad.envs.quadcopter_env",
    "QuadcopterVecEnv": "sb3_quad.envs.vec_env",
    "Randomization": "sb3_quad.envs.simulation.randomization",
    "Task": "sb3_quad.envs.simulation.tasks",
    "accelerate": "sb3_quad.fast.policy",
    "compare": "sb3_quad.evaluation.compare",
    "env_kwargs": "sb3_quad.agents.agent_settings",
    "flight_cost": "sb3_quad.envs.flight_cost",
    "fly": "sb3_quad.evaluation.flights",
    "load_pretrained": "sb3_quad.agents.pretrained",
    "load_vehicle": "sb3_quad.envs.vehicles.vehicle",
    "pretrained_path": "sb3_quad.agents.pretrained",
    "row_seeds": "sb3_quad.base.seeds",
}

register_environments()

__getattr__, __dir__ = lazy_names(__name__, _LAZY)
