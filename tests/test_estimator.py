"""The errors of an estimator: their size and memory, what sees them, and what does not."""

import numpy as np
import pytest

from sb3_quad.base.errors import ConfigError
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.estimator import ERRORS, E
from sb3_quad.envs.simulation.observation import DEFAULT_MEAN, DEFAULT_STD
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.protocol import observed_state

TRUE_SIZES = {"position": 0.02, "velocity": 0.07, "attitude": 2.5, "body_rates": 0.1}
# m, m/s, rad/s, rad
STD = np.repeat([0.02, 0.07, 0.1, np.radians(2.5)], 3)
HOVER = {"task_kwargs": {"target_distance": 0.0}}


def new_batch(n, **errors):
    noise = {"estimator": {**TRUE_SIZES, **errors}}
    return QuadcopterBatch(n, FlightSettings(noise=noise, **HOVER), seed=1)


def flown(batch, steps):
    """Fly hover commands; return the errors before each control step, (steps, 12, n)."""
    batch.reset()
    errors = []
    for _ in range(steps):
        errors.append(batch.estimate[: E.std].copy())
        batch.step(np.zeros((batch.n, 4)))
    return np.array(errors)


def test_errors_have_their_size_from_the_first_step_and_fade_with_their_time_constant():
    errors = flown(new_batch(4000, time_constant=0.1), 21) / STD[:, None]
    for step in (0, 1, 20):
        np.testing.assert_allclose(errors[step].std(axis=1), 1.0, atol=0.06)
        np.testing.assert_allclose(errors[step].mean(axis=1), 0.0, atol=0.08)
    for lag in (1, 10, 20):
        fading = (errors[0] * errors[lag]).mean(axis=1)
        np.testing.assert_allclose(fading, np.exp(-0.1 * lag), atol=0.09)
    correlation = np.corrcoef(errors[0]) - np.eye(12)
    assert np.abs(correlation).max() < 0.08


def test_magnitudes_and_the_share_are_sampled_for_each_episode():
    batch = new_batch(3000, position=[0.0, 1.0], share=0.25)
    batch.reset()
    std = batch.estimate[E.std :]
    assert std.shape == (len(ERRORS), 3000)
    wrong = std[0] > 0.0
    assert wrong.mean() == pytest.approx(0.25, abs=0.03)
    assert std[0, wrong].mean() == pytest.approx(0.5, abs=0.04)
    assert not batch.estimate[:, ~wrong].any() and (std[1:, wrong].min(axis=1) > 0.0).all()
    before = std.copy()
    batch.reset()
    assert (std != before).any()


def test_observations_show_the_estimate_and_rewards_the_truth():
    exact = QuadcopterBatch(30, FlightSettings(noise=0.0, task="state_recovery"), seed=3)
    settings = FlightSettings(noise={"estimator": TRUE_SIZES}, task="state_recovery")
    off = QuadcopterBatch(30, settings, seed=3)
    exact.reset(), off.reset()
    for _ in range(30):
        plain, rewards, _ = exact.step(np.zeros((30, 4)))
        seen, scored, _ = off.step(np.zeros((30, 4)))
        np.testing.assert_array_equal(scored, rewards)
        np.testing.assert_array_equal(off.state, exact.state)
        assert (np.abs(seen - plain).max(axis=1) > 1e-4).all()
        np.testing.assert_array_equal(off.observe(), seen)
    # It is a rotation, turned by the angle that the errors say.
    shown = observed_state(seen.astype(float), DEFAULT_MEAN, DEFAULT_STD)
    estimate = off.estimated_state()
    np.testing.assert_allclose(shown.rotation, estimate.rotation, atol=1e-6)
    np.testing.assert_allclose(shown.position, estimate.position - estimate.target, atol=1e-6)
    np.testing.assert_allclose(shown.velocity, estimate.velocity, atol=1e-5)
    np.testing.assert_allclose(shown.body_rates, estimate.body_rates, atol=1e-6)
    relative = np.einsum("nji,njk->nik", off.true_state().rotation, estimate.rotation)
    angle = np.arccos((np.trace(relative, axis1=1, axis2=2) - 1.0) / 2.0)
    turned = np.linalg.norm(off.estimate[E.attitude : E.std], axis=0)
    np.testing.assert_allclose(angle, turned, atol=1e-6)


def test_the_integral_is_that_of_the_estimate():
    noise = {"estimator": {"position": 0.05, "time_constant": 1e6}}
    batch = QuadcopterBatch(3, FlightSettings(noise=noise, position_integral={}, **HOVER), seed=0)
    errors = flown(batch, 11)
    offset = errors[-1, :3]
    np.testing.assert_allclose(batch.integral, 0.5 * 0.01 * 11 * offset, rtol=0.02)


def test_an_expert_flies_by_the_estimate():
    noise = {"estimator": {"position": 0.1, "time_constant": 1e6}}
    found = fly("geometric", n_episodes=40, noise=noise, max_episode_steps=600, **HOVER)
    assert found.survival.all()
    # As far from its target as the estimate is from the truth
    assert np.sqrt(np.square(found.final_offset).mean()) == pytest.approx(0.1, rel=0.25)


def test_set_noise_leaves_the_errors_as_they_are():
    env = QuadcopterVecEnv(2, noise={"estimator": TRUE_SIZES}, **HOVER)
    env.reset()
    env.set_noise(0.1)
    assert env.batch.estimate.any()
    with pytest.raises(ConfigError, match="estimator"):
        env.set_noise({"estimator": {"position": 1.0}})
