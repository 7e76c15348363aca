"""``QuadcopterVectorEnv``: n quadcopters as one Gymnasium vector environment."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from typing_extensions import Unpack

from sb3_quad.base.arrays import BoolArray, Float32Array
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs.in_flight import InFlight, quadcopter_spaces
from sb3_quad.simulation.batch import BatchKeywords, QuadcopterBatch
from sb3_quad.simulation.tasks import TaskSpec


class QuadcopterVectorEnv(InFlight, VectorEnv[Float32Array, Float32Array, npt.NDArray[Any]]):
    """The batched environment for users outside Stable-Baselines3.

    ``gymnasium.make_vec("QuadTargetTracking-v0", num_envs=8, vectorization_mode="vector_entry_point")`` makes one. The
    learning problem, the arguments and the setters are those of :class:`~sb3_quad.envs.quadcopter_env.QuadcopterEnv`; row i of
    ``reset(seed=s)`` flies as that environment does after ``reset(seed=row_seeds(s, n)[i])``, see
    :func:`~sb3_quad.base.seeds.row_seeds`.

    Autoreset is ``SAME_STEP``: a row that ends returns the first observation of its next episode, and the infos hold the last
    one in ``final_obs[i]`` and ``is_success``, ``distance``, ``collision`` and ``out_of_range`` in ``final_info``, each with
    the mask ``_final_obs``, ``_final_info`` and so on. Where no episode ends, infos are empty.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # type: ignore[misc]

    def __init__(
        self,
        num_envs: int = 1,
        task: TaskSpec = "target_tracking",
        task_kwargs: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        **keywords: Unpack[BatchKeywords],
    ) -> None:
        if render_mode is not None:
            raise ConfigError(f"render_mode {render_mode!r}: the batched environment draws nothing; use QuadcopterEnv")
        self.batch = QuadcopterBatch(num_envs, task, task_kwargs, **keywords)
        self.num_envs = self.batch.n
        self.single_observation_space, self.single_action_space = quadcopter_spaces()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Begin new episodes in all rows, or where ``options["reset_mask"]``, bool (n,), says so.

        :param seed: one number, from which each row gets its own stream, or a number for each row; None: the next episodes.
        """
        n, options = self.num_envs, dict(options or {})
        seeds = [None] * n if seed is None else seed
        seeds = row_seeds(int(seeds), n) if isinstance(seeds, (int, np.integer)) else list(seeds)
        if len(seeds) != n:
            raise ConfigError(f"seed: {len(seeds)} numbers for {n} environments; give one, or one for each")
        mask = np.asarray(options.pop("reset_mask", np.ones(n, dtype=np.bool_)))
        for key in options:
            raise ConfigError(f"reset option {key!r}: the only one is 'reset_mask', bool of shape ({n},)")
        if mask.shape != (n,) or mask.dtype != np.bool_:
            raise ConfigError(f"reset_mask: must be bool of shape ({n},)")
        seeded = [row for row in np.flatnonzero(mask).tolist() if seeds[row] is not None]
        if seeded:
            self.batch.seed([seeds[row] for row in seeded], seeded)
        return self.batch.reset(mask), {}

    def step(self, actions: npt.NDArray[Any]) -> tuple[Float32Array, Float32Array, BoolArray, BoolArray, dict[str, Any]]:
        """Fly one control step: observations (n, 18), rewards (n,), terminated (n,), truncated (n,), infos."""
        outcome = self.batch.outcome
        observations, rewards, done = self.batch.step(actions)
        truncated = done & outcome["truncated"]
        infos: dict[str, Any] = {}
        if done.any():
            final = np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(done):
                final[row] = outcome["observation"][row].copy()
            info: dict[str, Any] = {
                "is_success": truncated.copy(),
                "distance": np.where(done, outcome["distance"], 0.0),
                "collision": done & outcome["collision"],
                "out_of_range": done & outcome["out_of_range"],
            }
            info |= {f"_{key}": done.copy() for key in info}
            infos = {"final_obs": final, "_final_obs": done.copy(), "final_info": info, "_final_info": done.copy()}
        return observations, rewards, done & ~truncated, truncated, infos
