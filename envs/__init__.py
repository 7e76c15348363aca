"""Gymnasium and Stable-Baselines3 environments of the quadcopter."""

from typing import TYPE_CHECKING

from sb3_quad.base.imports import lazy_names

if TYPE_CHECKING:
    from sb3_quad.envs.batch_vec_env import BatchVecEnv
    from sb3_quad.envs.quadcopter_env import QuadcopterEnv
    from sb3_quad.envs.simulation.tasks import TASKS, Task
    from sb3_quad.envs.vec_env import QuadcopterVecEnv

# 15 s of control steps of 0.01 s (thesis 4.2.3)
MAX_EPISODE_STEPS = 1500

__all__ = [
    "TASKS",
    "BatchVecEnv",
    "QuadcopterEnv",
    "QuadcopterVecEnv",
    "Task",
]

# Imported on first use, so that `import sb3_quad` need not wait for pybullet, numba and torch.
_LAZY = {
    "BatchVecEnv": "sb3_quad.envs.batch_vec_env",
    "QuadcopterEnv": "sb3_quad.envs.quadcopter_env",
    "QuadcopterVecEnv": "sb3_quad.envs.vec_env",
    "TASKS": "sb3_quad.envs.simulation.tasks",
    "Task": "sb3_quad.envs.simulation.tasks",
}

__getattr__, __dir__ = lazy_names(__name__, _LAZY)
