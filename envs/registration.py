"""Registration of the environments with Gymnasium.

It names modules by their paths, so that nothing heavy is imported before it is used.
"""

import gymnasium

from sb3_quad.envs import MAX_EPISODE_STEPS

ENVIRONMENTS = {
    "QuadTargetTracking-v0": "target_tracking",
    "QuadStateRecovery-v0": "state_recovery",
}


def register_environments() -> None:
    """Register ``QuadTargetTracking-v0`` and ``QuadStateRecovery-v0``.

    It is called when ``sb3_quad`` is imported.
    """
    for env_id, task in ENVIRONMENTS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                id=env_id,
                entry_point="sb3_quad.envs.quadcopter_env:QuadcopterEnv",
                max_episode_steps=MAX_EPISODE_STEPS,
                kwargs={"task": task},
            )
