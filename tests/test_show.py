"""Flights to look at: recordings are the flights, cameras see what they must, files are whole and
never lost.
"""

import errno
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from sb3_quad.base.errors import ConfigError, ControllerError
from sb3_quad.cli import main
from sb3_quad.envs.quadcopter_env import QuadcopterEnv
from sb3_quad.envs.rendering.camera import Camera, Lens, broadside, framing_camera
from sb3_quad.envs.rendering.picture import Trail, draw_trails
from sb3_quad.envs.rendering.scene import Scene
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.evaluation.scenarios.sample import sample_wrenches
from sb3_quad.evaluation.scenarios.scenario import Scenario
from sb3_quad.experts.pid import PIDExpert
from sb3_quad.show import film, sequence
from sb3_quad.show.episodes import fixed_setting, fly_all, scenario_setting
from sb3_quad.show.film import FPS, HOLD, film_frames, following_cameras, frame_times, write_film
from sb3_quad.training.config import load_config
from sb3_quad.training.runs import claim_run

HIT = {"start": 0.1, "duration": 0.02, "force": (-20, -20, 0), "torque": (-5, -5, -5)}
VIDEO = importlib.util.find_spec("imageio_ffmpeg") is not None


def flown(setting, n_timesteps=None):
    """The first episode of a setting, flown by the PID expert."""
    ((recording,),) = fly_all({"pid": PIDExpert()}, setting, 0, n_timesteps)
    return recording


@pytest.fixture(scope="module")
def fall():
    """An upside-down start that the PID expert does not survive."""
    return flown(scenario_setting("thesis:recovery_s1"))


@pytest.fixture(scope="module")
def hit():
    """A hit on the way to a target."""
    setting = fixed_setting(FlightSettings(task="target_tracking", noise=0.0), target=(3, 0, 16))
    scenario = Scenario(name="hit", wrenches=[HIT])
    wrenches = sample_wrenches(scenario, [np.random.default_rng(0)])
    plan = setting.plan(0)._replace(wrenches=wrenches)
    return flown(setting._replace(plan=lambda seed: plan), 60)


def test_a_recording_is_the_flight_of_the_environment():
    expert = PIDExpert()
    setting = fixed_setting(FlightSettings(task="state_recovery", max_episode_steps=40))
    ((recording,),) = fly_all({"pid": expert}, setting, 3, None)
    env = QuadcopterEnv(task="state_recovery")
    env.reset(seed=3)
    total = 0.0
    for step in range(40):
        np.testing.assert_array_equal(recording.state.array[:, step], env.true_state().array[:, 0])
        total += env.step(expert.actions(env.true_state())[0])[1]
    np.testing.assert_array_equal(recording.state.array[:, 40], env.true_state().array[:, 0])
    assert recording.flights.reward[0] == pytest.approx(total) and recording.lost == ""
    env.close()


def test_a_lost_flight_ends_where_it_was_lost(fall):
    assert fall.lost == "crashed"
    assert fall.state.position[-1, 2] <= fall.vehicle.collision_radius < fall.state.position[-2, 2]
    assert fall.times[-1] == pytest.approx(
        1.71, abs=0.02
    )  # the specification's expert, velocity in the body frame


def test_a_blow_is_recorded_when_it_acts_and_seen_for_a_while(hit):
    acting = np.flatnonzero(hit.wrench.any(axis=1))
    np.testing.assert_array_equal(
        acting, [11, 12]
    )  # during the steps that begin at 0.10 and 0.11 s
    assert hit.disturbances == [11]
    np.testing.assert_array_equal(hit.wrench_around(40)[:3], [-20, -20, 0])
    assert not hit.wrench_around(10).any() and not hit.wrench_around(59).any()
    np.testing.assert_array_equal(hit.targets, [[3, 0, 16]])


def test_disturbances_of_randomize_are_recorded():
    setting = fixed_setting(
        FlightSettings(
            task="target_tracking", randomize={"force": {"magnitude": [3, 3]}, "gusts": {"std": 1}}
        )
    )
    recording = flown(setting, 20)
    np.testing.assert_allclose(recording.wrench[1:], recording.state.wrench[:, :-1].T)
    assert recording.wrench[1:, :3].any() and recording.disturbances == [1]


def test_controllers_fly_the_same_episodes_until_the_steps_are_used_up():
    setting = fixed_setting(FlightSettings(task="state_recovery", max_episode_steps=20))
    episodes = list(
        fly_all({"a": PIDExpert(), "b": lambda observation: np.zeros((1, 4))}, setting, 5, 50)
    )
    assert [len(a.times) - 1 for a, _ in episodes] == [20, 20, 10]
    for first, second in episodes:
        np.testing.assert_array_equal(first.state.array[:, 0], second.state.array[:, 0])
        assert not np.array_equal(first.state.array[:, -1], second.state.array[:, -1])
    assert not np.array_equal(episodes[0][0].state.array[:, 0], episodes[1][0].state.array[:, 0])


def test_a_controller_that_fails_is_named():
    setting = fixed_setting(FlightSettings(task="state_recovery"))
    with pytest.raises(ControllerError, match=r"controller odd: .*shape"):
        list(fly_all({"odd": lambda observation: np.zeros((1, 3))}, setting, 0, 5))


def looking_along_x():
    return Camera(
        np.zeros(3), np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]]), Lens(80, 40, 0.5)
    )


def test_points_are_seen_where_they_are():
    columns, rows, depth = (
        looking_along_x().project(np.array([[4.0, 0, 0], [4, -2, 0], [4, 0, 2], [2, 0, 0]])).T
    )
    np.testing.assert_allclose(columns, [40, 60, 40, 40])
    np.testing.assert_allclose(rows, [20, 20, 0, 20])
    np.testing.assert_allclose(depth, [4, 4, 4, 2])


@pytest.mark.parametrize(("distance", "seen"), [(3.0, True), (-3.0, False)])
def test_trails_are_drawn_unless_they_are_behind_the_camera(distance, seen):
    points = np.array([[distance, -0.5, 0.0], [distance, 0.5, 0.0], [distance, 0.0, 0.5]])
    picture = Image.new("RGBA", (80, 40))
    draw_trails(picture, [Trail(points, "red")], looking_along_x())
    drawn = np.asarray(picture)
    assert (drawn[..., 3] == 255).any() == (drawn[..., 3] > 0).any() == seen
    assert (drawn[drawn[..., 3] > 0, :3] == (255, 0, 0)).all()


def test_vehicles_hide_trails(hit):
    camera = looking_along_x()._replace(eye=hit.state.position[-1] - (1.0, 0.0, 0.0))
    scene = Scene(hit.vehicle)
    scene.place([hit.pose(60)], hit.state.target[-1:])
    without = np.array(scene.picture(camera))
    across = hit.state.position[-1] + np.outer([-1.0, 1.0], [0.0, 1.0, 0.0])
    drawn = (np.array(scene.picture(camera, [Trail(across, "red")])) != without).any(axis=2)
    assert drawn[:, :10].any() and drawn[:, -10:].any() and not drawn[:, 40].any()
    scene.close()


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


def test_a_following_camera_never_loses_the_vehicle(fall, hit):
    for recording in (fall, hit):
        times = frame_times([recording], 1.0)
        cameras = [
            *following_cameras([recording], times, 1.0, np.array([0.0, 1.0, 0.0]), Lens(100, 100))
        ]
        assert len(cameras) == len(times)
        for seconds, camera in zip(times, cameras, strict=True):
            column, row, _ = camera.project(recording.state.position[[recording.at(seconds)]])[0]
            assert 0 < column < 100 and 0 < row < 100
        eyes = np.array([camera.eye for camera in cameras])
        assert np.abs(np.diff(eyes, n=2, axis=0)).max() < 0.6  # m per frame²: no jolts


def test_broadside_looks_across_the_motion():
    line = np.outer(np.linspace(0, 5, 20), [3.0, 4.0, 1.0])
    assert abs(broadside(line) @ [0.6, 0.8, 0.0]) < 1e-6


def test_a_film_runs_as_long_as_the_longest_flight_and_holds_its_end(fall, hit):
    times = frame_times([fall, hit], 0.5)
    assert len(times) == round((fall.times[-1] / 0.5 + HOLD) * FPS) + 1
    assert (
        times[0] == 0.0
        and times[-1] == fall.times[-1]
        and np.diff(times).max() == pytest.approx(0.5 / FPS)
    )
    frames = film_frames([fall, hit], 64, 48, 0.5)
    some = [next(frames) for _ in range(6)]
    frames.close()
    assert all(frame.shape == some[0].shape and frame.dtype == np.uint8 for frame in some)
    assert not np.array_equal(some[0], some[5])
    whole = list(film_frames([hit], 64, 48))
    assert len(whole) == len(frame_times([hit], 1.0))
    assert np.abs(whole[-1].astype(int) - whole[-FPS // 4]).mean() < 1.0


def test_a_sequence_shows_start_hit_and_end_without_overlap(fall, hit):
    assert len(hit.times) == 61
    view = sequence.view_of([fall, hit], Lens(300, 400))
    chosen = [sequence.pose_steps(flight, view) for flight in (fall, hit)]
    assert chosen[0][0] == 0 and chosen[0][-1] == len(fall.times) - 1
    assert hit.disturbances[0] in chosen[1]
    for steps, flight in zip(chosen, (fall, hit), strict=True):
        places, breadth = view.project(flight.state.position[steps])
        gaps = np.linalg.norm(places[:, None] - places[None], axis=2)[
            np.triu_indices(len(steps), 1)
        ]
        assert (gaps > 0.7 * breadth.min()).sum() >= len(gaps) - 1  # a push is shown in any case
    picture = sequence.sequence([fall, hit], 120, 100)
    assert picture.shape[0] > 100 and picture.shape[1] >= 240 and picture.std() > 20


class Plates:
    """Notes what is drawn on a picture: texts, and the boxes around them."""

    def __init__(self):
        self.boxes, self.texts = [], []

    def rounded_rectangle(self, box, radius, fill):
        self.boxes.append(box)

    def text(self, centre, text, **look):
        self.texts.append(text)


@pytest.mark.parametrize("size", [(300, 400), (600, 200)])
def test_texts_of_a_sequence_are_inside_the_picture_beside_their_poses(fall, size):
    view = sequence.view_of([fall], Lens(*size))
    steps = sequence.pose_steps(fall, view)
    places, breadth = view.project(fall.state.position[steps])
    drawn = Plates()
    sequence.draw_times(drawn, fall, steps, view, 12)
    assert drawn.texts == [f"{fall.times[step]:.2f} s" for step in steps]
    for (left, top, right, bottom), own in zip(drawn.boxes, places, strict=True):
        assert 0 <= left < right <= size[0] and 0 <= top < bottom <= size[1]
        away = np.linalg.norm(own - [(left + right) / 2, (top + bottom) / 2])
        assert 0.3 * breadth.min() < away < 1.5 * breadth.max() + (right - left) / 2


def test_a_sequence_explains_its_signs(fall, hit, monkeypatch):
    headers = []
    monkeypatch.setattr(
        sequence,
        "with_header",
        lambda picture, flight, lines, size: headers.append(lines) or picture,
    )
    sequence.sequence([fall, hit], 60, 60)
    assert [header[-1] for header in headers] == [
        "green hoops: target",
        "green hoops: target; arrows: force (red), torque (violet)",
    ]


def test_a_sequence_ends_when_the_vehicle_stays_at_its_target(fall, hit):
    near = flown(fixed_setting(FlightSettings(task="target_tracking"), target=(0, 0, 16)), 1000)
    ended = sequence.until_settled(near)
    assert 0 < ended.times[-1] < near.times[-1]
    assert (near.state.distance[ended.state.n - 1 :] <= sequence.SETTLED).all()
    assert ended.state.distance[-2] > sequence.SETTLED
    assert sequence.until_settled(fall) is fall
    assert sequence.until_settled(hit).state.n == hit.state.n


def test_a_film_tells_the_force(hit):
    assert "N" not in film._caption(hit, 5)
    assert film._caption(hit, 11).endswith("force 28.3 N")


@pytest.mark.skipif(not VIDEO, reason="the extra [video] is not installed")
def test_a_full_disk_is_one_line(tmp_path):
    def frames():
        raise OSError(errno.ENOSPC, "No space left on device")
        yield

    with pytest.raises(ConfigError, match=r"film\.gif: cannot be encoded \(No space left"):
        write_film(tmp_path / "film.gif", frames())


@pytest.mark.skipif(not VIDEO, reason="the extra [video] is not installed")
@pytest.mark.parametrize("name", ["film.mp4", "film.gif", "film.webp"])
def test_videos_hold_every_frame(tmp_path, name):
    import imageio.v2 as imageio

    frames = [np.full((48, 64, 3), 30 * k, np.uint8) for k in range(6)]
    write_film(tmp_path / name, frames)
    read = [np.asarray(frame) for frame in imageio.get_reader(tmp_path / name)]
    assert [frame.shape[:2] for frame in read] == [(48, 64)] * 6
    np.testing.assert_allclose([frame.mean() for frame in read], [30 * k for k in range(6)], atol=6)
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


@pytest.mark.skipif(not VIDEO, reason="the extra [video] is not installed")
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
    assert "pip install '.[video]'" in capsys.readouterr().err


def test_the_command_draws_and_reports(tmp_path, capsys):
    picture, film = tmp_path / "s.png", tmp_path / "f.gif"
    size = ["--size", "64x64", "-n", "12", "--seed", "3"]
    asked = [
        "enjoy",
        "pid",
        "still=geometric",
        "--task",
        "state_recovery",
        *size,
        "-P",
        "-o",
        str(picture),
    ]
    assert main([*asked, *([str(film)] if VIDEO else [])]) == 0
    output, progress = capsys.readouterr()
    assert not VIDEO or (
        "100%" in progress and re.search(r"\d:\d\d:\d\d", progress)
    )  # how much is done, and how long it takes
    assert (
        "pid: " in output and "still: " in output and "0.12 s" in output and str(picture) in output
    )
    with Image.open(picture) as image:
        assert image.width >= 128
    assert film.is_file() == VIDEO
    before = picture.read_bytes()
    assert main(asked) == 2
    assert "--overwrite" in capsys.readouterr().err and picture.read_bytes() == before
    assert main([*asked, "--overwrite", "--seed", "4"]) == 0
    assert picture.read_bytes() != before


@pytest.fixture
def run_folder(tmp_path):
    """A run with an agent that has learnt nothing."""
    from stable_baselines3 import PPO

    from sb3_quad.envs.vec_env import QuadcopterVecEnv

    config = load_config(
        "ppo",
        "QuadStateRecovery-v0",
        None,
        {"eval_env_kwargs": {"noise": 0.0, "max_episode_steps": 30}},
    )
    run = claim_run(tmp_path / "logs", "ppo", "QuadStateRecovery-v0")
    run.write_yaml(config.settings, {})
    env = QuadcopterVecEnv(1, task="state_recovery")
    PPO(
        "MlpPolicy", env, n_steps=2, batch_size=2, policy_kwargs={"net_arch": [4]}, device="cpu"
    ).save(run.best_model)
    return run


def test_a_run_is_found_by_algorithm_environment_and_number(run_folder, capsys):
    logs = str(run_folder.path.parent.parent)
    asked = ["enjoy", "--algo", "ppo", "--env", "QuadStateRecovery-v0", "-f", logs, "--no-render"]
    assert main(asked) == 0
    output = capsys.readouterr().out
    assert str(run_folder.best_model) in output and "0.30 s" in output  # the run's own episodes
    assert main([*asked, "--exp-id", "1", "--load-best", "--stochastic"]) == 0
    for wrong, message in (
        (["--exp-id", "7"], "QuadStateRecovery-v0_1"),
        (["--load-last-checkpoint"], "--save-freq"),
        (["--load-checkpoint", "500"], "best_model.zip"),
        (["--algo", "ppoo"], "did you mean 'ppo'"),
    ):
        capsys.readouterr()
        assert main([*asked, *wrong]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no controller given"),
        (["pdi", "--no-render"], "did you mean 'pid'"),
        (["nowhere.zip", "--no-render"], "no such file"),
        (["pid", "--env", "Pendulum-v1", "--no-render"], "rl_zoo3"),
        (["pid", "--task", "state-recovery", "--no-render"], "did you mean 'state_recovery'"),
        (
            ["pid", "--task", "state_recovery", "--scenario", "thesis:side_hit", "--no-render"],
            "not allowed with",
        ),
        (["pid", "--scenario", "thesis:side_hitt", "--no-render"], "did you mean 'side_hit'"),
        (["pid", "--scenario", "side_hit", "--no-render"], "suite:name"),
        (["pid", "--target", "0", "0", "-1", "--no-render"], "below ground"),
        (["pid", "--env-kwargs", "nois:0", "--no-render"], "nois"),
        (["pid", "-o", "film.avi"], ".mp4"),
        (["pid", "-o", "poses.jpg"], ".png"),
        (["pid", "-o", "poses.png", "--size", "big"], "640x480"),
        (["pid", "-n", "0", "--no-render"], "--n-timesteps"),
        (["pid", "--speed", "0", "--no-render"], "--speed"),
        (["pid", "pid", "--no-render"], "label"),
        (["pid", "--load-best", "--no-render"], "--load-best chooses a run's agent"),
        (["pid", "--load-last-checkpoint", "--no-render"], "--load-last-checkpoint chooses"),
        (["pid", "--load-checkpoint", "9", "--no-render"], "--load-checkpoint chooses"),
        (["pid", "--exp-id", "7", "--no-render"], "--exp-id chooses"),
        (["pid", "-f", "nowhere", "--no-render"], "--folder chooses"),
        (
            ["pid", "--vehicle", "itm", "--env-kwargs", "vehicle:crazyflie", "--no-render"],
            "vehicle: given by --vehicle and by --env-kwargs",
        ),
        (
            ["pid", "--reference", "circle", "--env-kwargs", "reference:line", "--no-render"],
            "reference: given by --reference and by --env-kwargs",
        ),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys):
    assert main(["enjoy", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_window_without_a_display_is_refused(monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert main(["enjoy", "pid"]) == 2
    assert "-o flight.mp4" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("xvfb-run") is None,
    reason="xvfb-run is not installed: no display to open a window on",
)
def test_flights_are_shown_in_a_window():
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
        env={**os.environ, "LIBGL_ALWAYS_SOFTWARE": "1"},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-2000:]
    assert "geometric: " in result.stdout


@pytest.mark.skipif(not VIDEO, reason="the extra [video] is not installed")
def test_the_agent_of_a_run_is_filmed_and_no_film_replaced(run_folder, tmp_path, capsys):
    import imageio.v2 as imageio

    logs, film = str(run_folder.path.parent.parent), tmp_path / "one.mp4"
    asked = [
        "enjoy",
        "--algo",
        "ppo",
        "--env",
        "QuadStateRecovery-v0",
        "-f",
        logs,
        "-n",
        "10",
        "--size",
        "64x64",
        "-o",
    ]
    assert main([*asked, str(film)]) == 0
    output = capsys.readouterr().out
    assert f"agent: {run_folder.best_model}" in output and f"saved {film}" in output
    before = film.read_bytes()
    assert main([*asked, str(film)]) == 2
    assert "--overwrite" in capsys.readouterr().err and film.read_bytes() == before
    assert main([*asked, str(tmp_path / "both.mp4"), "--n-envs", "2", "--seed", "4"]) == 0
    output = capsys.readouterr().out
    assert "seed 4, ppo best_model" in output and "seed 5, ppo best_model" in output
    widths = [
        next(iter(imageio.get_reader(path))).shape[1] for path in (film, tmp_path / "both.mp4")
    ]
    assert widths[1] >= 2 * widths[0]


def test_episodes_side_by_side_have_one_seed_after_the_other():
    setting = fixed_setting(FlightSettings(task="state_recovery", max_episode_steps=5))
    abreast = list(fly_all({"pid": PIDExpert()}, setting, 5, 10, n_envs=2))
    alone = list(fly_all({"pid": PIDExpert()}, setting, 5, 20))
    assert [len(episode) for episode in abreast] == [2, 2]
    for ours, theirs in zip([each for episode in abreast for each in episode], alone, strict=True):
        np.testing.assert_array_equal(ours.state.array, theirs[0].state.array)


@pytest.mark.parametrize("what", [["--task", "state_recovery"], ["--scenario", "thesis:side_hit"]])
def test_all_fly_the_vehicle_that_is_asked_for(capsys, what):
    flown = {}
    for vehicle in ("itm", "crazyflie"):
        asked = ["enjoy", "pid", *what, "--vehicle", vehicle, "--no-render", "-n", "100"]
        assert main(asked) == 0
        flown[vehicle] = capsys.readouterr().out
    assert flown["itm"] != flown["crazyflie"]
    assert main(["enjoy", "pid", "--vehicle", "crazyfly", "--no-render"]) == 2
    assert "crazyflie" in capsys.readouterr().err
