"""The experts fly as the specification measured (section 8), and answer SB3's ``predict`` as they
answer the true state.
"""

import sys
import types

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sb3_quad  # noqa: F401  (registers the environments)
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.base.errors import ConfigError, ExpertError
from sb3_quad.base.imports import import_name
from sb3_quad.envs.simulation.observation import DEFAULT_MEAN, DEFAULT_STD
from sb3_quad.envs.simulation.state import (
    QUATERNION,
    STATE_SIZE,
    QuadcopterState,
    X,
)
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import Hook, fly
from sb3_quad.experts.geometric import GeometricExpert
from sb3_quad.experts.geometric_gains import derived_gains
from sb3_quad.experts.pid import PIDExpert
from sb3_quad.training.algorithms import import_class


def test_pid_tracking_figures():
    flights = fly(PIDExpert(), task="target_tracking", n_episodes=480, seed=11)
    assert flights.success.all()
    for tolerance, seconds in ((0.1, 7.71), (0.2, 6.89), (0.5, 5.80), (1.0, 4.90)):
        assert np.mean(flights.time_to[tolerance]) == pytest.approx(seconds, rel=0.03)
    assert flights.path_length.mean() == pytest.approx(10.42, rel=0.03)
    assert flights.reward.mean() == pytest.approx(-8.10, rel=0.04)


def test_pid_recovery_figure():
    flights = fly(PIDExpert(), task="state_recovery", n_episodes=960, seed=12)
    assert 100 * flights.survival.mean() == pytest.approx(31.9, abs=8.0)


def test_pid_error_under_a_constant_force():
    env = QuadcopterVecEnv(1, noise=0.0, seed=0)
    env.reset()
    env.set_target((10.0, 10.0, 25.0))
    env.set_wrench(force=(-3.0, -3.0, -3.0))
    state, expert = env.true_state(), PIDExpert()
    for _ in range(1499):
        env.step(expert.actions(state))
    assert state.distance[0] == pytest.approx(5.6, rel=0.01)


def test_pid_gains_of_itm_are_those_of_table_a1():
    (kp, kd, ki_dt, *_), (proportional, derivative), *_ = PIDExpert()._constants
    assert (kp, kd, ki_dt) == (1.5, 4.1, 50 * 0.01)
    np.testing.assert_allclose(proportional, [0.54165, 0.81810, 0.80676], rtol=1e-4)
    np.testing.assert_allclose(derivative, [0.12037, 0.18180, 0.17928], rtol=1e-4)


def test_the_scaling_is_that_of_table_a2():
    np.testing.assert_array_equal(DEFAULT_MEAN, np.zeros(18))
    np.testing.assert_array_equal(
        DEFAULT_STD, np.repeat([10 / np.sqrt(3), np.sqrt(3), 5.0, 5.0], [3, 9, 3, 3])
    )


def test_geometric_gains_come_from_the_vehicle_or_its_authority():
    itm = load_vehicle("itm")
    assert GeometricExpert().gains == itm.geometric_gains
    assert GeometricExpert(gains=derived_gains(itm)).gains.measured is None
    slow = itm.model_copy(
        update={"motor_gain": 10.0, "inertia": tuple(3 * moment for moment in itm.inertia)}
    )
    gains = GeometricExpert(slow).gains
    # A vehicle that turns more slowly gets smaller gains.
    assert gains.attitude < itm.geometric_gains.attitude
    assert gains.angular_deceleration == pytest.approx(derived_gains(itm).angular_deceleration / 3)


@pytest.mark.parametrize("expert", [PIDExpert(), GeometricExpert()], ids=["pid", "geometric"])
def test_predict_on_noise_free_observations_equals_actions_on_the_true_state(expert):
    env = QuadcopterVecEnv(64, task="state_recovery", noise=0.0, seed=5)
    observations = env.reset()
    for _ in range(20):
        expected = expert.actions(env.true_state())
        actions, state = expert.predict(observations)
        assert state is None and actions.shape == (64, 4) and actions.dtype == np.float32
        np.testing.assert_allclose(actions, expected, atol=2e-3)
        np.testing.assert_array_equal(expert.predict(observations[0])[0], actions[0])
        assert expert.predict(observations[:0])[0].shape == (0, 4)
        observations, *_ = env.step(expected)


@pytest.mark.parametrize("expert", [PIDExpert(), GeometricExpert()], ids=["pid", "geometric"])
@given(data=st.data())
def test_actions_are_always_valid(expert, data):
    """Any state at all gives finite actions within [-1, 1]."""
    number = st.floats(-1e3, 1e3)
    array = np.array(data.draw(st.lists(number, min_size=STATE_SIZE, max_size=STATE_SIZE)))[:, None]
    norm = np.linalg.norm(array[QUATERNION])
    array[QUATERNION] = (
        array[QUATERNION] / norm if norm > 1e-3 else np.array([[1.0], [0], [0], [0]])
    )
    actions = expert.actions(QuadcopterState(array))
    assert np.isfinite(actions).all() and np.abs(actions).max() <= 1.0


def test_a_module_of_the_current_folder_is_found_in_an_installed_command(tmp_path, monkeypatch):
    """An installed command finds it, but last on the path: it replaces no installed module."""
    (tmp_path / "my_own.py").write_text(
        "from stable_baselines3.common.callbacks import BaseCallback as Callback\n"
        "from sb3_quad import PIDExpert as Pilot\n"
    )
    (tmp_path / "torch.py").write_text("raise AssertionError('imported from the present folder')\n")
    before = [path for path in sys.path if path not in ("", str(tmp_path))]
    monkeypatch.chdir(tmp_path)
    for use in (
        lambda: resolve_expert("my_own:Pilot"),
        lambda: import_class("my_own.Callback", "callback"),
        lambda: import_name("my_own", "--gym-packages"),
    ):
        monkeypatch.setattr(sys, "path", [*before])
        monkeypatch.delitem(sys.modules, "my_own", raising=False)
        use()
        assert sys.path == [*before, str(tmp_path)]
    monkeypatch.setattr(sys, "path", [*before])
    import_name("torch", "--gym-packages")
    assert sys.path == before


def test_experts_by_name(tmp_path, monkeypatch):
    assert isinstance(resolve_expert("pid"), PIDExpert) and isinstance(
        resolve_expert("geometric"), GeometricExpert
    )
    module = types.ModuleType("my_experts")
    module.hover = lambda vehicle: lambda observation: np.zeros((len(observation), 4))
    module.broken = lambda vehicle: 1 / 0
    monkeypatch.setitem(sys.modules, "my_experts", module)
    assert resolve_expert("my_experts:hover")(np.zeros((3, 18))).shape == (3, 4)
    half_written = tmp_path / "half.zip"
    half_written.write_bytes(b"PK\x03\x04 and no more")
    for spec, error in (
        ("pidd", ConfigError),
        ("missing.zip", ConfigError),
        (str(half_written), ConfigError),
        ("no_such_module:factory", ConfigError),
        ("my_experts:nothing", ConfigError),
        ("my_experts:broken", ExpertError),
    ):
        with pytest.raises(error) as caught:
            resolve_expert(spec)
        assert spec in str(caught.value)


def some_states(n=64):
    random = np.random.default_rng(2)
    array = np.zeros((STATE_SIZE, n))
    array[: X.target_heading] = random.normal(0.0, 2.0, (X.target_heading, n))
    array[X.target_ahead :] = random.normal(0.0, 2.0, (3, n))
    array[QUATERNION] /= np.linalg.norm(array[QUATERNION], axis=0)
    return array


@pytest.mark.parametrize(
    ("expert", "heading"), [(PIDExpert(), 1.0), (GeometricExpert(), 1.0), (GeometricExpert(), 0.0)]
)
def test_a_heading_is_the_world_turned(expert, heading):
    """Whoever asks for another heading gets what they would get in a world that is turned so; so
    does, by the geometric expert, who asks for none.
    """
    array = some_states()
    array[X.target_heading] = heading
    turned = array.copy()
    c, s = np.cos(2.0), np.sin(2.0)
    vectors = ("position", "velocity", "target", "target_velocity", "target_acceleration")
    for row in [getattr(X, name) for name in (*vectors, "target_ahead", "target_heading")]:
        x, y = array[row], array[row + 1]
        turned[row], turned[row + 1] = c * x - s * y, s * x + c * y
    w, x, y, z = array[QUATERNION]
    c, s = np.cos(1.0), np.sin(1.0)
    turned[QUATERNION] = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
    actions = expert.actions(QuadcopterState(array))
    np.testing.assert_allclose(expert.actions(QuadcopterState(turned)), actions, atol=1e-5)
    if isinstance(expert, PIDExpert):
        # The thesis's heading is 0.
        array[X.target_heading] = 0.0
        np.testing.assert_array_equal(expert.actions(QuadcopterState(array)), actions)


class Following(Hook):
    """The errors of position, m, and heading, rad, after the first 2 s."""

    def __init__(self):
        self.position = []
        self.heading = []

    def after_step(self, step, state, actions, flying):
        assert flying.all()
        if step > 200:
            nose = state.rotation[:, :2, 0]
            c, s = state.target_heading.T
            error = np.arctan2(c * nose[:, 1] - s * nose[:, 0], c * nose[:, 0] + s * nose[:, 1])
            self.position.append(state.distance)
            self.heading.append(error)


def turning_eight(times):
    """A figure eight of 2.3 m/s, while the heading turns by 90 degrees a second."""
    angle = 0.8132 * times
    return np.stack([2 * np.sin(angle), np.sin(2 * angle), 0 * times, np.pi / 2 * times], axis=1)


@pytest.mark.parametrize(
    ("expert", "reference", "metres", "degrees"),
    [
        ("privileged_derived", {"speed": 2.3}, 0.02, None),
        ("geometric", turning_eight, 0.02, 5.0),
        ("pid", turning_eight, 0.8, 5.0),
    ],
)
def test_experts_follow(expert, reference, metres, degrees):
    itm = load_vehicle("itm")
    errors = Following()
    on_it = {"task_kwargs": {"target_distance": 0.0}, "reference": reference, "hooks": [errors]}
    fly(resolve_expert(expert, itm), n_episodes=2, max_episode_steps=1200, **on_it)
    assert np.sqrt(np.mean(np.square(errors.position))) <= metres
    if degrees is not None:
        assert np.degrees(np.abs(errors.heading).max()) <= degrees
