"""What all environments can be asked and told in flight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import FloatArray
from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.batch import QuadcopterBatch, Rows
from sb3_quad.simulation.state import TARGET, QuadcopterState
from sb3_quad.simulation.tasks import TaskSpec
from sb3_quad.vehicles.vehicle import Vehicle


class InFlight:
    """An environment whose rows are those of ``batch``; ``QuadcopterEnv`` has one, and its values are without a row axis.

    ``indices`` says which rows are set: a number, several, a slice, or None for all. What is set holds until it is set anew,
    a target until its row's next reset. A value that does not fit raises :class:`~sb3_quad.base.errors.ConfigError`.
    """

    batch: QuadcopterBatch

    def _by_row(self, columns: FloatArray) -> FloatArray:
        """A copy of ``columns``, (..., n) or (..., 1) for all rows together, as (n, ...)."""
        return np.broadcast_to(columns.T, (self.batch.n, *columns.shape[:-1])).copy()

    def true_state(self) -> QuadcopterState:
        """The true state of all rows, a live view."""
        return self.batch.true_state()

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle of row 0 (of all rows, unless a sequence was given)."""
        return self.batch.vehicle_list[0]

    @property
    def target(self) -> FloatArray:
        """Targets r_T, (n, 3), world frame, m."""
        return self._by_row(self.batch.state[TARGET])

    @property
    def noise(self) -> Any:
        """Relative standard deviations of the observation noise, (n,)."""
        return self._by_row(self.batch.noise_level)

    @property
    def observation_mean(self) -> FloatArray:
        """μ of Eq. 3.16, (n, 18)."""
        return self._by_row(self.batch.mean)

    @property
    def observation_std(self) -> FloatArray:
        """σ of Eq. 3.16, (n, 18)."""
        return self._by_row(self.batch.std)

    def set_target(self, position: npt.ArrayLike, indices: Rows = None) -> None:
        """Move targets, (3,) or (rows, 3), world frame, m."""
        self.batch.set_target(position, indices)

    def set_wrench(self, *arguments: Any, indices: Rows = None, **keywords: Any) -> None:
        """Apply an external force (N) and torque (N m), (3,) or (rows, 3) each, at the centre of mass.

        The arguments are ``force``, ``torque``, ``force_frame`` ("world") and ``torque_frame`` ("body"), as of
        :meth:`~sb3_quad.simulation.batch.QuadcopterBatch.set_wrench`; without any, nothing pushes any more.
        """
        self.batch.set_wrench(*arguments, **(keywords if indices is None else {**keywords, "rows": indices}))

    def set_noise(self, level: npt.ArrayLike, indices: Rows = None) -> None:
        """Set the relative standard deviation of the observation noise, () or (rows,); 0: none."""
        self.batch.set_noise(level, indices)

    def set_observation_scaling(
        self, mean: npt.ArrayLike | None = None, std: npt.ArrayLike | None = None, indices: Rows = None
    ) -> None:
        """Set μ and σ of Eq. 3.16, (18,) or (rows, 18) each; None leaves one as it is."""
        self.batch.set_observation_scaling(mean, std, indices)

    def set_task(self, task: TaskSpec, task_kwargs: Mapping[str, Any] | None = None, indices: Rows = None) -> None:
        """Set the task of all episodes that begin from now on; it is one for all rows."""
        if np.unique(self.batch.rows(indices)).size < self.batch.n:
            raise ConfigError(
                "set_task: holds for all rows; give a mixture such as {'target_tracking': 1, 'state_recovery': 1}"
            )
        self.batch.set_task(task, task_kwargs)
