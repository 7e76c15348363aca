"""Flights to look at: recordings are the flights, cameras see what they must, films are whole and
never lost.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import PPO

from sb3_quad.base.errors import ControllerError
from sb3_quad.cli import main
from sb3_quad.envs.quadcopter_env import QuadcopterEnv
from sb3_quad.envs.rendering.camera import Camera, Lens, broadside, framing_camera
from sb3_quad.envs.rendering.picture import Trail, draw
from sb3_quad.envs.rendering.window import FPS
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.experts.pid import PIDExpert
from sb3_quad.show.episodes import Setting, fly_all, scenario_setting
from sb3_quad.show.film import HOLD, film_frames, following_camera, frame_times, write_film
from sb3_quad.training.config import load_config
from sb3_quad.training.runs import claim_run

VIDEO = importlib.util.find_spec("imageio_ffmpeg") is not None
needs_video = pytest.mark.skipif(not VIDEO, reason="the extra [video] is not installed")


def recovery(**changes):
    return Setting(FlightSettings(task="state_recovery", **changes))


@pytest.fixture(scope="module")
def fall():
    """An upside-down start that the PID expert does not survive."""
    setting = scenario_setting("thesis:recovery_s1")
    ((recording,),) = fly_all({"pid": PIDExpert()}, setting, 0, None)
    return recording


def test_a_recording_is_the_flight_of_the_environment():
    expert = PIDExpert()
    setting = recovery(max_episode_steps=40)
    ((recording,),) = fly_all({"pid": expert}, setting, 3, None)
    env = QuadcopterEnv(task="state_recovery")
    env.reset(seed=3)
    near = partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9)
    total = 0.0
    for step in range(40):
        near(recording.state.position[step], env.true_state().position[0])
        total += env.step(expert.actions(env.true_state())[0])[1]
    near(recording.state.position[40], env.true_state().position[0])
    assert recording.flights.reward[0] == pytest.approx(total) and recording.lost == ""
    env.close()


def test_a_lost_flight_ends_where_it_was_lost(fall):
    assert fall.lost == "crashed"
    assert fall.state.position[-1, 2] <= fall.vehicle.collision_radius < fall.state.position[-2, 2]


def test_controllers_fly_the_same_episodes_until_the_steps_are_used_up():
    setting = recovery(max_episode_steps=20)
    still = np.zeros((1, 4))
    episodes = list(fly_all({"a": PIDExpert(), "b": lambda observation: still}, setting, 5, 50))
    assert [len(a.times) - 1 for a, _ in episodes] == [20, 20, 10]
    for first, second in episodes:
        np.testing.assert_array_equal(first.state.array[:, 0], second.state.array[:, 0])
        assert not np.array_equal(first.state.array[:, -1], second.state.array[:, -1])
    assert not np.array_equal(episodes[0][0].state.array[:, 0], episodes[1][0].state.array[:, 0])


def test_a_controller_that_fails_is_named():
    setting = recovery()
    with pytest.raises(ControllerError, match="odd"):
        list(fly_all({"odd": lambda observation: np.zeros((1, 3))}, setting, 0, 5))


def looking_along_x(eye):
    axes = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]])
    return Camera(np.array(eye), axes, Lens(80, 40, 0.5))


def test_points_are_seen_where_they_are():
    points = np.array([[4.0, 0, 0], [4, -2, 0], [4, 0, 2], [2, 0, 0]])
    columns, rows, depth = looking_along_x((0.0, 0.0, 0.0)).project(points).T
    np.testing.assert_allclose(columns, [40, 60, 40, 40])
    np.testing.assert_allclose(rows, [20, 20, 0, 20])
    np.testing.assert_allclose(depth, [4, 4, 4, 2])


@pytest.mark.parametrize(("distance", "seen"), [(3.0, True), (-3.0, False)])
def test_trails_are_drawn_unless_they_are_behind_the_camera(fall, distance, seen):
    points = np.array([[distance, y, 20.0] for y in (-0.5, 0.5)])
    camera = looking_along_x((0.0, 0.0, 20.0))
    drawn = np.array(draw(fall.vehicle, fall.state.array[:, 0], camera, [Trail(points, "red")]))
    assert (drawn == (255, 0, 0)).all(axis=2).any() == seen


coordinates = st.floats(-20, 20, allow_nan=False)
clouds = st.lists(
    st.tuples(coordinates, coordinates, st.floats(10, 40)), min_size=1, max_size=8
).map(np.array)


@given(points=clouds, aspect=st.floats(0.5, 2), course=st.floats(0, 6.28))
def test_a_framing_camera_has_everything_in_its_picture_and_no_room_to_spare(
    points, aspect, course
):
    ahead = np.array([np.cos(course), np.sin(course), 0.0])
    camera = framing_camera(points, 1.0, ahead, Lens(round(200 * aspect), 200))
    forward, *across = ((points - camera.eye) @ camera.axes.T).T
    filled = (np.abs(across) + 1.0) / camera.lens.slopes[:, None] / forward
    assert filled.max() == pytest.approx(1.0, abs=1e-6)


def test_a_following_camera_never_loses_the_vehicle(fall):
    for step in range(fall.state.n):
        state = fall.state.array[:, [step]]
        camera = following_camera(state, fall.vehicle, np.array([0.0, 1.0, 0.0]), Lens(100, 100))
        column, row, _ = camera.project(fall.state.position[[step]])[0]
        assert 0 < column < 100 and 0 < row < 100


def test_broadside_looks_across_the_motion():
    line = np.outer(np.linspace(0, 5, 20), [3.0, 4.0, 1.0])
    assert abs(broadside(line) @ [0.6, 0.8, 0.0]) < 1e-6


def test_a_film_runs_as_long_as_the_longest_flight_and_holds_its_end(fall):
    times = frame_times([fall], 0.5)
    assert len(times) == round((fall.times[-1] / 0.5 + HOLD) * FPS) + 1
    assert times[0] == 0.0 and times[-1] == fall.times[-1]
    frames = film_frames([fall, fall], 64, 48, 0.5)
    first, *_, sixth = [next(frames) for _ in range(6)]
    frames.close()
    assert first.shape == (48, 128, 3) and first.dtype == np.uint8
    np.testing.assert_array_equal(first[:, :64], first[:, 64:])
    assert not np.array_equal(first, sixth)


@needs_video
@pytest.mark.parametrize("name", ["film.mp4", "film.gif", "film.webp"])
def test_videos_hold_every_frame(tmp_path, name):
    import imageio.v2 as imageio

    frames = [np.full((48, 64, 3), 30 * k, np.uint8) for k in range(6)]
    write_film(tmp_path / name, frames)
    read = [np.asarray(frame) for frame in imageio.get_reader(tmp_path / name)]
    np.testing.assert_allclose([frame.mean() for frame in read], [30 * k for k in range(6)], atol=6)
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


@needs_video
def test_an_interrupted_video_leaves_what_was_there(tmp_path):
    def frames():
        yield np.zeros((48, 64, 3), np.uint8)
        raise KeyboardInterrupt

    (tmp_path / "film.mp4").write_bytes(b"earlier")
    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / "film.mp4", frames())
    assert [entry.name for entry in tmp_path.iterdir()] == ["film.mp4"]
    assert (tmp_path / "film.mp4").read_bytes() == b"earlier"


def test_missing_video_packages_are_named(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main(["enjoy", "pid", "-o", "film.mp4"]) == 2
    assert "[video]" in capsys.readouterr().err


@pytest.fixture
def run_folder(tmp_path):
    """A run with an agent that has learnt nothing."""
    own = {"eval_env_kwargs": {"noise": 0.0, "max_episode_steps": 30}}
    config = load_config("ppo", "QuadStateRecovery-v0", None, own)
    run = claim_run(tmp_path / "logs", "ppo", "QuadStateRecovery-v0")
    run.write_yaml(config.settings, {})
    env = QuadcopterVecEnv(1, task="state_recovery")
    model = PPO("MlpPolicy", env, n_steps=2, batch_size=2, device="cpu")
    model.save(run.best_model)
    return run


def test_a_run_is_found_by_algorithm_environment_and_number(run_folder, tmp_path, capsys):
    asked = ["enjoy", "--algo", "ppo", "--env", "QuadStateRecovery-v0"]
    asked += ["-f", str(run_folder.path.parent.parent)]
    film = tmp_path / "film.gif"
    shown = ["--size", "64x64", "-o", str(film)] if VIDEO else ["--no-render"]
    assert main([*asked, "pid", *shown]) == 0
    output = capsys.readouterr().out
    assert str(run_folder.best_model) in output and "0.30 s" in output  # the run's own episodes
    if VIDEO:
        # A film is not replaced silently.
        before = film.read_bytes()
        assert main([*asked, "-n", "5", *shown]) == 2
        assert "--overwrite" in capsys.readouterr().err and film.read_bytes() == before
    assert main([*asked, "--exp-id", "1", "--load-best", "--stochastic", "--no-render"]) == 0
    for wrong, key in (
        (["--exp-id", "7"], "QuadStateRecovery-v0_1"),
        (["--load-last-checkpoint"], "--save-freq"),
        (["--load-checkpoint", "500"], "best_model.zip"),
        (["--algo", "ppoo"], "'ppo'"),
    ):
        capsys.readouterr()
        assert main([*asked, "--no-render", *wrong]) == 2
        error = capsys.readouterr().err
        assert key in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        ([], "controller"),
        (["pdi", "--no-render"], "'pid'"),
        (["pid", "--env", "Pendulum-v1", "--no-render"], "rl_zoo3"),
        (["pid", "--task", "state-recovery", "--no-render"], "'state_recovery'"),
        (["pid", "--scenario", "side_hit", "--no-render"], "--scenario"),
        (
            ["pid", "--scenario", "thesis:side_hit", "--env-kwargs", "a:0", "--no-render"],
            "--scenario",
        ),
        (["pid", "--env-kwargs", "nois:0", "--no-render"], "nois"),
        (["pid", "-o", "poses.png"], ".mp4"),
        (["pid", "--size", "big"], "--size"),
        (["pid", "--speed", "0", "--no-render"], "--speed"),
        (["pid", "--load-best", "--no-render"], "--load-best"),
        (["pid", "--vehicle", "itm", "--env-kwargs", "vehicle:itm", "--no-render"], "--vehicle"),
    ],
)
def test_bad_input_is_one_line(arguments, key, capsys):
    assert main(["enjoy", *arguments]) == 2
    error = capsys.readouterr().err
    assert key in error and error.count("\n") == 1


def test_a_window_without_a_display_is_refused(monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert main(["enjoy", "pid"]) == 2
    assert "DISPLAY" in capsys.readouterr().err


@pytest.mark.parametrize("what", [["--task", "state_recovery"], ["--scenario", "thesis:side_hit"]])
def test_all_fly_the_vehicle_that_is_asked_for(capsys, what):
    flown = set()
    for vehicle in ("itm", "crazyflie"):
        asked = ["enjoy", "pid", *what, "--vehicle", vehicle, "--no-render", "-n", "50"]
        assert main(asked) == 0
        flown.add(capsys.readouterr().out)
    assert len(flown) == 2


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("xvfb-run") is None,
    reason="xvfb-run is not installed: no display to open a window on",
)
def test_flights_are_shown_in_a_window():
    # Python as it is built on servers has no Tk.
    pytest.importorskip("_tkinter", exc_type=ImportError)
    command = [
        sys.executable,
        "-m",
        "sb3_quad.cli",
        "enjoy",
        "pid",
        "geometric",
        "-n",
        "20",
        "--speed",
        "0.5",
    ]
    result = subprocess.run(
        ["xvfb-run", "-a", *command],
        cwd=Path(__file__).parent.parent,
        env={**os.environ, "LIBGL_ALWAYS_SOFTWARE": "1", "MPLBACKEND": "TkAgg"},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-2000:]
    assert "geometric: " in result.stdout
