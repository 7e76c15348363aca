"""Quadcopter environments, experts, DAgger, PPO with behavioural cloning, and training by the
gradient of the model, for Stable-Baselines3.
"""

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

# Ctrl-C ends a command at once while it imports, see interrupts_leave; imports begin here.
_is_command = "sb3_quad.cli" in sys.orig_argv or Path(sys.argv[0]).stem == "sb3-quad"
if _is_command and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from sb3_quad.base import __version__  # noqa: E402
from sb3_quad.base.imports import lazy_names  # noqa: E402
from sb3_quad.envs.registration import register_environments  # noqa: E402

if TYPE_CHECKING:
    from sb3_quad.agents.agent_settings import env_kwargs
    from sb3_quad.agents.pretrained import load_pretrained, pretrained_path
    from sb3_quad.algorithms.apg import APG
    from sb3_quad.algorithms.dagger import DAgger
    from sb3_quad.algorithms.ppo_bc import PPOBC
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
