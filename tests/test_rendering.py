"""Pictures: without a display, of the asked size, showing what is there, and without touching the
flight.
"""

from typing import Any

import gymnasium
import numpy as np
import pytest

from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.bullet import BulletBody
from sb3_quad.envs.quadcopter_env import QuadcopterEnv
from sb3_quad.envs.rendering.window import Window
from sb3_quad.envs.vehicles.vehicle import load_vehicle

HOVER = np.zeros(4, dtype=np.float32)


@pytest.fixture
def env():
    made = QuadcopterEnv(render_mode="rgb_array", noise=0.0, render_width=160, render_height=120)
    yield made
    made.close()


def _greenest(picture):
    """Where the target marker's green is."""
    red, green, blue = picture.astype(int).transpose(2, 0, 1)
    return np.asarray((green > 70) & (green - red > 50) & (green - blue > 35))


def _orange(picture):
    """Where the vehicle's front is."""
    red, green, blue = picture.astype(int).transpose(2, 0, 1)
    return np.asarray((red - green > 60) & (red - blue > 80))


def test_picture_of_the_asked_size():
    size = 161, 97
    env = gymnasium.make(
        "QuadTargetTracking-v0",
        render_mode="rgb_array",
        render_width=size[0],
        render_height=size[1],
    )
    env.reset(seed=0)
    env.step(HOVER)
    picture: Any = env.render()
    assert picture.shape == (size[1], size[0], 3) and picture.dtype == np.uint8
    assert (
        env.metadata["render_modes"] == ["human", "rgb_array"] and env.metadata["render_fps"] == 100
    )
    env.close()


@pytest.mark.parametrize("direction", [(1, 0, 0), (-0.6, 0.6, 0.5), (0, 0, 1), (0, 0, -1)])
def test_vehicle_and_target_are_in_the_picture(env, direction):
    env.reset(seed=0, options={"target": np.array([0, 0, 15.0]) + 8.0 * np.array(direction)})
    picture = env.render()
    assert picture is not None
    assert _orange(picture).sum() > 20
    assert _greenest(picture).sum() > 1


def test_pictures_do_not_touch_the_flight(env):
    plain = QuadcopterEnv(noise=0.0)
    actions = np.random.default_rng(0).uniform(-1, 1, (30, 4)).astype(np.float32)
    for each in (env, plain):
        each.reset(seed=4)
        each.set_wrench(force=(1, 0, 0), torque=(0, 0.01, 0))
    for number, action in enumerate(actions):
        assert all(
            np.array_equal(a, b) for a, b in zip(env.step(action), plain.step(action), strict=True)
        )
        # Some steps are drawn, others are not.
        if number % 5 == 0:
            env.render()
    np.testing.assert_array_equal(env.true_state().array, plain.true_state().array)
    plain.close()


def test_human_mode_without_a_display_still_flies(monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    env = QuadcopterEnv(render_mode="human")
    assert "DISPLAY" in capsys.readouterr().err
    env.reset(seed=0)
    assert np.isfinite(env.step(HOVER)[0]).all() and env.render() is None
    env.close()


@pytest.fixture
def toolkit(monkeypatch):
    """Let matplotlib draw into memory as if that were a window."""
    from matplotlib import pyplot
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    pyplot.switch_backend("agg")
    monkeypatch.setattr(FigureCanvasAgg, "required_interactive_framework", "none")
    monkeypatch.setattr("matplotlib.figure.Figure.show", lambda figure: None)
    monkeypatch.setenv("DISPLAY", ":0")


def test_human_mode_shows_the_pictures_in_real_time(toolkit, monkeypatch):
    shown = []
    monkeypatch.setattr(Window, "show", lambda window, *what: shown.append(what))
    env = QuadcopterEnv(render_mode="human", render_width=64, render_height=48)
    env.reset(seed=0)
    for _ in range(20):
        env.step(HOVER)
    env.close()
    assert [seconds for _, seconds in shown] == [0.04] * 6
    assert all(_orange(picture).any() for picture, _ in shown)


def test_a_window_shows_what_it_is_given_until_it_is_closed(toolkit):
    window = Window(64, 48)
    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    window.show(picture, 0.01)
    canvas: Any = window.figure.canvas
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())[..., :3]
    np.testing.assert_array_equal(drawn, picture)
    assert window.is_open
    window.close()
    assert not window.is_open


def test_a_window_needs_a_toolkit():
    with pytest.raises(ConfigError, match="PyQt6"):
        Window(64, 48)


def test_render_without_a_mode_warns():
    env = QuadcopterEnv()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None
    env.close()


@pytest.mark.parametrize("size", [0, 5000, 64.0, True])
def test_bad_size_is_refused(size):
    with pytest.raises(ConfigError, match=r"render_width .*to 2048"):
        QuadcopterEnv(render_mode="rgb_array", render_width=size)


def test_the_body_has_the_numbers_of_the_vehicle():
    vehicle = load_vehicle("itm")
    body = BulletBody(vehicle)
    mass, _, inertia, *at = body.client.getDynamicsInfo(body.body, -1)[:5]
    assert mass == vehicle.mass and tuple(inertia) == vehicle.inertia
    assert at == [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)]
    assert body.client.getNumBodies() == 1 and body.client.getNumJoints(body.body) == 0
    body.close()


def test_any_name_of_a_vehicle_will_do():
    QuadcopterEnv(vehicle=load_vehicle("itm").model_copy(update={"name": '"& ü'})).close()
