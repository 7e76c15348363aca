"""Observation noise with a part that is added."""

import numpy as np
import pytest

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs import QuadcopterEnv, QuadcopterVecEnv
from sb3_quad.simulation.settings import FlightSettings


def test_it_does_not_vanish_at_the_target():
    env = QuadcopterVecEnv(4000, task="state_recovery", noise={"relative": 0.05, "additive": 0.02}, seed=0)
    plain = QuadcopterVecEnv(4000, task="state_recovery", noise=0.0, seed=0)
    seen, true = env.reset(), plain.reset()
    assert np.std(seen[:, :3]) == pytest.approx(0.02, rel=0.03)  # r = r_T there, in σ
    spread = np.hypot(0.05 * true[:, 12:], 0.02)
    assert np.std((seen - true)[:, 12:] / spread) == pytest.approx(1.0, rel=0.02)
    assert env.get_attr("additive_noise")[0] == 0.02
    env.set_noise(0.0)
    assert env.get_attr("additive_noise")[0] == 0.0


def test_it_is_the_same_on_pybullet():
    noise = {"relative": 0.05, "additive": 0.1}
    batch, single = QuadcopterVecEnv(1, noise=noise, seed=3), QuadcopterEnv(noise=noise)
    observations = batch.reset()[0], single.reset(seed=row_seeds(3, 1)[0])[0]
    for _ in range(100):
        np.testing.assert_allclose(*observations, atol=1e-6)  # float32
        action = np.full((1, 4), 0.1, np.float32)
        observations = batch.step(action)[0][0], single.step(action[0])[0]
    single.close()


def test_nothing_added_is_the_noise_of_a_number():
    first, second = (QuadcopterVecEnv(8, noise=noise, seed=1).reset() for noise in (0.05, {"relative": 0.05}))
    np.testing.assert_array_equal(first, second)
    assert FlightSettings(noise=0.1).model_dump(mode="json")["noise"] == 0.1


@pytest.mark.parametrize("noise", [{"additive": -0.1}, {"relatve": 0.1}, -0.1])
def test_noise_that_cannot_be_is_refused(noise):
    with pytest.raises(ConfigError, match="noise"):
        QuadcopterVecEnv(2, noise=noise)
