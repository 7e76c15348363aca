"""Snapshots of a batch: what does not fit is refused."""

import numpy as np
import pytest

from sb3_quad.base.errors import ConfigError
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.simulation.settings import FlightSettings

TASK = {"target_tracking": 1.0, "state_recovery": 1.0}


@pytest.mark.parametrize(
    ("name", "wrong", "says"),
    [
        ("task_index", np.full(3, 7), "task_index"),
        ("streams", np.zeros((4, 2), np.uint32), r"\(4, 2\)"),
        ("state", np.zeros((20, 3), np.float32), "float32"),
        ("vehicles", np.zeros((3, 3)), "vehicles"),
    ],
)
def test_arrays_that_compiled_code_would_misread_are_refused(name, wrong, says):
    batch = QuadcopterBatch(3, FlightSettings(task=TASK), seed=0)
    batch.reset()
    before = batch.snapshot()
    with pytest.raises(ConfigError, match=says):
        batch.restore({**before, name: wrong})
    for key, array in batch.snapshot().items():
        np.testing.assert_array_equal(array, before[key])
