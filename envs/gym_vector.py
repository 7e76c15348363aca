"""``QuadcopterGymVectorEnv``: n quadcopters as one Gymnasium vector environment."""

from collections.abc import Sequence

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from typing_extensions import Unpack

from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import AnyArray, BoolArray, Float32Array, StrDict
from sb3_quad.envs.batch_env import INFOS, BatchEnv, FlightKeywords, quadcopter_spaces
from sb3_quad.envs.simulation.tasks import TaskSpec

MODES = ("NextStep", "SameStep")


class QuadcopterGymVectorEnv(BatchEnv, VectorEnv[Float32Array, Float32Array, AnyArray]):
    """The batched environment for users outside Stable-Baselines3.

    ``gymnasium.make_vec("QuadTargetTracking-v0", num_envs=8,
    vectorization_mode="vector_entry_point")`` makes one. The learning problem, the arguments and
    the setters are those of :class:`~sb3_quad.envs.quadcopter_env.QuadcopterEnv`. Row i of
    ``reset(seed=s)`` flies as that environment does after ``reset(seed=row_seeds(s, n)[i])``, see
    :func:`~sb3_quad.base.seeds.row_seeds`.

    The infos of every step hold ``is_success``, ``survival``, ``distance``, ``collision`` and
    ``out_of_range``, (n,) each. ``_is_success`` and so on are masks of the rows that have a value.

    Further keywords are the fields of :class:`~sb3_quad.envs.simulation.settings.FlightSettings`.

    :param autoreset_mode: a ``gymnasium.vector.AutoresetMode``, or its value. With ``"SameStep"`` a
        row that ends returns the first observation and infos of its next episode; the last ones are
        in ``final_obs[i]`` and ``final_info``. With ``"NextStep"`` it returns the last ones, and
        the next step begins its next episode; its action is then ignored, but must be finite.
    :raises ConfigError: an argument that does not fit.
    """

    metadata: StrDict = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        task: TaskSpec = "target_tracking",
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        seed: int | None = None,
        n_threads: int | None = None,
        **keywords: Unpack[FlightKeywords],
    ) -> None:
        if render_mode is not None:
            raise ConfigError(
                f"render_mode {render_mode!r}: the batched environment draws nothing; "
                "use QuadcopterEnv"
            )
        mode = str(getattr(autoreset_mode, "value", autoreset_mode))
        refuse_unknown("autoreset_mode", [mode], MODES)
        self._next_step = mode == "NextStep"
        self.metadata = {**self.metadata, "autoreset_mode": AutoresetMode(mode)}
        self._make_batch(num_envs, seed, n_threads, task, autoreset=False, **keywords)
        self.num_envs = self.batch.n
        # The batch does not reset rows by itself, since both modes need their last observations.
        # Rows that the next step resets, in mode NextStep.
        self._ended = np.zeros(self.num_envs, bool)
        self.single_observation_space, self.single_action_space = quadcopter_spaces(
            self.batch.observation.size
        )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: StrDict | None = None,
    ) -> tuple[Float32Array, StrDict]:
        """Begin new episodes in all rows.

        :param seed: one number, from which each row gets its own stream, or a number or None for
            each row. None: continue with the current streams.
        """
        if options:
            raise ConfigError(
                "reset options: the batched environment takes none; call set_target after reset()"
            )
        if not (seed is None or isinstance(seed, (Sequence, np.ndarray))):
            seed = row_seeds(seed, self.num_envs)
        if seed is not None and len(seed) != self.num_envs:
            raise ConfigError(
                f"seed: {len(seed)} numbers for {self.num_envs} environments; "
                "give one, or one for each"
            )
        # Rows whose seed is None continue with their stream.
        for row, number in enumerate(seed or ()):
            if number is not None:
                self.batch.seed([number], row)
        everything = np.ones(self.num_envs, bool)
        self._ended = ~everything
        return self._begin(everything), self._infos(everything)

    def step(
        self, actions: AnyArray
    ) -> tuple[Float32Array, Float32Array, BoolArray, BoolArray, StrDict]:
        """Fly one control step.

        :param actions: (n, 4), clipped to [-1, 1].
        :return: observations (n, observation size), rewards (n,), terminated (n,), truncated (n,),
            infos.
        """
        observations, rewards, done = self._fly(actions)
        # In mode NextStep a step of a row that has ended is its reset, without reward.
        if self._next_step and self._ended.any():
            observations = self._begin(self._ended)
            rewards[self._ended] = 0.0
            done[self._ended] = False
        truncated = done & self.batch.outcome["truncated"]
        terminated = done & ~truncated
        final: StrDict = {}
        if self._next_step:
            self._ended = done
        elif done.any():
            # Gymnasium wants an array of objects, with None for the rows that continue.
            last = np.full(self.num_envs, None, object)
            for row in np.flatnonzero(done):
                last[row] = observations[row]
            final = {
                "final_obs": last,
                "_final_obs": done,
                "final_info": self._infos(done),
                "_final_info": done,
            }
            observations = self._begin(done)
        infos = self._infos(np.ones_like(done)) | final
        return observations, rewards, terminated, truncated, infos

    def _begin(self, rows: BoolArray) -> Float32Array:
        """Begin the next episodes of rows, bool (n,), and return the observations of all rows."""
        observations = self.batch.reset(rows)
        self.batch.clear_outcome(rows)
        return observations

    def _infos(self, rows: BoolArray) -> StrDict:
        """Return the infos of the last step of some rows, bool (n,), with zeros for the others."""
        # Gymnasium's form: values of all rows, and a mask of those that have one.
        infos = {key: self.batch.outcome[field] * rows for key, field in INFOS.items()}
        return infos | {f"_{key}": rows for key in infos}
