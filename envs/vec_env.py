"""``QuadcopterVecEnv``: n quadcopters as one Stable-Baselines3 vectorised environment."""

import secrets
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from typing_extensions import Unpack

from sb3_quad.base.errors import unknown
from sb3_quad.base.seeds import row_seeds
from sb3_quad.base.types import IntArray
from sb3_quad.envs.batch_env import BatchEnv, FlightKeywords, quadcopter_spaces
from sb3_quad.envs.batch_vec_env import BatchVecEnv, refuse_options
from sb3_quad.envs.flight_cost import FlownStates, calm_cost, cost_and_gradients, flight_cost
from sb3_quad.envs.infos import Ended, Infos
from sb3_quad.envs.simulation.tape import FlightTape
from sb3_quad.envs.simulation.tasks import TaskSpec

_OF_ROWS = (
    "target",
    "noise",
    "observation_mean",
    "observation_std",
    "wrench",
    "wind",
    "max_episode_steps",
)
_METHODS = ("set_target", "set_reference", "set_wrench", "set_wind", "set_noise")


class RowSeeds(VecEnv):
    """A vectorised environment whose rows share no random numbers, whatever the seeds.

    SB3 seeds row i with ``seed + i``, so that 480 rows of seed 0 and 480 of seed 1 share 479
    streams of random numbers.
    """

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seed all rows from their next reset on.

        :param seed: None: a random number.
        :return: the seed of each row, :func:`~sb3_quad.base.seeds.row_seeds`.
        """
        if seed is None:
            seed = secrets.randbits(32)
        self._seeds = [*row_seeds(seed, self.num_envs)]
        return self._seeds.copy()


class QuadcopterVecEnv(BatchEnv, RowSeeds, BatchVecEnv):
    """n quadcopters stepped together by compiled code; flights equal PyBullet's to 1e-9.

    The learning problem, the arguments and the setters are those of
    :class:`~sb3_quad.envs.quadcopter_env.QuadcopterEnv`. Row i flies exactly as that environment
    does after ``reset(seed=row_seeds(seed, n)[i])``; ``seed()`` returns these seeds
    (:func:`~sb3_quad.base.seeds.row_seeds`).

    A row that ends begins its next episode within the same step. Its info then holds
    ``terminal_observation``, ``TimeLimit.truncated``, ``episode`` (``r``, ``l``, ``t`` as of SB3's
    Monitor), ``is_success``, ``survival``, ``distance``, ``collision`` and ``out_of_range``. The
    infos of other rows are empty. All of them are new in each step, as are the arrays.

    Further keywords are the fields of :class:`~sb3_quad.envs.simulation.settings.FlightSettings`.

    :param n_envs: number of rows.
    :param staggered: whether the episodes that :meth:`reset` begins end at times spread evenly over
        ``max_episode_steps``. The first mean return and success of a training then come from all
        kinds of episodes, not from early crashes alone.
    :param seed: seeds a random stream for each row; None: random.
    :param n_threads: threads that share the work, at most; None: the CPUs this process may use.
        Results do not depend on it.
    :raises ConfigError: an argument that does not fit.
    """

    def __init__(
        self,
        n_envs: int,
        task: TaskSpec = "target_tracking",
        *,
        staggered: bool = False,
        seed: int | None = None,
        n_threads: int | None = None,
        **keywords: Unpack[FlightKeywords],
    ) -> None:
        self._make_batch(n_envs, seed, n_threads, task, autoreset=True, **keywords)
        self._staggered = staggered
        self._nothing = [None] * self.batch.n
        self._start = time.time()
        super().__init__(self.batch.n, *quadcopter_spaces(self.batch.observation.size))

    @property
    def max_episode_steps(self) -> IntArray:  # type: ignore[override]
        """Control steps after which an episode is truncated, (n,), as the constructor took them."""
        return self.batch.max_steps.copy()

    def reset(self) -> VecEnvObs:
        """Begin a new episode in every row; observations float32 (n, observation size)."""
        refuse_options(self)
        if any(seed is not None for seed in self._seeds):
            self.batch.seed(self._seeds)
            self._reset_seeds()
        observations = self.batch.reset()
        if self._staggered:
            self.batch.stagger()
        return observations

    def step_wait(self) -> VecEnvStepReturn:
        """Fly one control step.

        :return: observations (n, observation size), rewards (n,), done (n,), infos.
        """
        observations, rewards, dones = self._fly(self._actions)
        rows = dones.nonzero()[0]
        ended = None
        if rows.size:
            elapsed = round(time.time() - self._start, 6)
            places = {row: k for k, row in enumerate(rows.tolist())}
            # `take` is four times as fast as an index here.
            last = self.batch.last_observations.take(rows, axis=0)
            ended = Ended(places, self.batch.outcome.take(rows), last, elapsed)
        return observations, rewards, dones, Infos(self._nothing, ended)

    def record(
        self,
        n_steps: int,
        substeps: int | None = None,
        cost: Callable[[FlownStates], th.Tensor] = flight_cost,
        calm_coef: float = 0.0,
        end_at_ground: bool = True,
    ) -> FlightTape:
        """Return a tape that records flights of this environment and differentiates them.

        :param n_steps: control steps of a recording.
        :param substeps: physics steps in a control step of a recording; None: as in :meth:`step`.
        :param cost: the cost of each control step, in PyTorch.
        :param calm_coef: weight of :func:`~sb3_quad.envs.flight_cost.calm_cost`, which is added.
        :param end_at_ground: False: a crash does not end a recorded flight, which continues below
            the ground.
        """
        control_step = self.vehicle.control_step

        def with_calm(flown: FlownStates) -> th.Tensor:
            return cost(flown) + calm_coef * calm_cost(flown, control_step)

        differentiated = partial(cost_and_gradients, with_calm if calm_coef else cost)
        return FlightTape(self.batch, n_steps, substeps, differentiated, end_at_ground)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the given rows, one value per row."""
        if attr_name == "vehicle":
            values = self.batch.vehicle_list
        elif attr_name in _OF_ROWS:
            values = getattr(self, attr_name)
        else:
            # It belongs to the environment, not to a row.
            return super().get_attr(attr_name, indices)
        return [values[row] for row in self.batch.rows(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set ``target``, ``wind`` or ``noise`` of the given rows."""
        self.env_method(f"set_{attr_name}", value, indices=indices)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method for the given rows and return one result per row."""
        rows = self.batch.rows(indices)
        if method_name == "true_state":
            state = self.true_state()
            return [state.rows(slice(row, row + 1)) for row in rows]
        if method_name not in _METHODS:
            raise AttributeError(unknown("method of rows", method_name, ("true_state", *_METHODS)))
        getattr(self, method_name)(*method_args, indices=indices, **method_kwargs)
        return [None] * rows.size
