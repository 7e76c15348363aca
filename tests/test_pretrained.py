"""Policies that come with the package, and the script that makes them."""

import base64
import importlib.util
import io
import json
import pickle
import sys
import types
import zipfile
from pathlib import Path

import numpy as np
import publish
import pytest
import yaml
from stable_baselines3 import PPO

import sb3_quad
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import FOLDER, agent_path, pretrained_names
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.base.errors import ConfigError, ControllerError
from sb3_quad.cli import main
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.evaluation.flights import fly

FAST = ("itm-recovery", "any-quadcopter", "itm-robust")
OTHERS = sorted(set(pretrained_names()) - set(FAST))
PICKLED = {
    "stable_baselines3.common.buffers.RolloutBuffer",
    "stable_baselines3.common.policies.ActorCriticPolicy",
}


@pytest.fixture(scope="module")
def observations(tmp_path_factory):
    """The path of some observations, and the observations."""
    env = QuadcopterVecEnv(32, task="state_recovery", seed=5)
    path = tmp_path_factory.mktemp("observations") / "observations.npy"
    seen = env.reset()
    np.save(path, seen)
    return path, seen


def test_there_are_some_each_with_a_card_of_its_own():
    assert {"itm-recovery", "itm-imitation"} <= set(pretrained_names())
    for name in pretrained_names():
        card = sb3_quad.pretrained_path(name).with_suffix(".md").read_text(encoding="utf-8")
        assert card.startswith(f"# {name}\n")
        for part in (
            "state recovery |",
            "targets 20 m away |",
            "| seed |",
            "| commit |",
            "sb3_quad.cli train",
        ):
            assert part in card, (name, part)
        assert "and changes" not in card


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in FAST else pytest.mark.slow)
        for name in pretrained_names()
    ],
)
def test_each_flies_as_its_card_says(name):
    own = {
        **agent_settings(sb3_quad.pretrained_path(name))[0].in_any_task(),
        "vehicle": vehicle_of(name),
    }
    flights = fly(sb3_quad.load_pretrained(name), "state_recovery", 480, 31_000_000, **own)
    assert 100 * flights.survival.mean() == pytest.approx(
        survival_on_the_card(name), abs=4.0 if "thesis" in name else 2.0
    )


def vehicle_of(name):
    kind = name.split("-")[0]
    return "itm" if kind in ("any", "thesis") else kind


def survival_on_the_card(name):
    lines = (
        sb3_quad.pretrained_path(name).with_suffix(".md").read_text(encoding="utf-8").splitlines()
    )
    rows = [line.split("|") for line in lines if line.startswith("|")]
    heading, recovery = (
        next(row for row in rows if any(part in cell for cell in row))
        for part in ("survival", "state recovery")
    )
    (column,) = (number for number, cell in enumerate(heading) if "survival" in cell)
    return float(recovery[column].split()[0])


@pytest.mark.slow
def test_the_robust_one_ends_at_its_target_under_disturbances():
    own = sb3_quad.env_kwargs("itm-robust")
    force = {"magnitude": 27**0.5, "direction": [-1, -1, -1]}  # the thesis's
    worlds = {"mass": [0.8, 1.2], "motor_gain": [0.7, 1.5], "force": {"magnitude": [0, 3]}}
    for randomize, largest in (({"force": force}, 0.04), (worlds, 0.1)):
        agent = sb3_quad.load_pretrained("itm-robust")
        flights = fly(agent, "target_tracking", 240, 32_000_000, **{**own, "randomize": randomize})
        assert (
            flights.survival.mean() > 0.98
            and np.quantile(flights.final_error[flights.survival], 0.95) < largest
        )


@pytest.mark.parametrize("vehicle", ["itm", "crazyflie", "hummingbird"])
def test_any_quadcopter_flies_vehicles_with_another_order_of_rotors(vehicle):
    own = {**sb3_quad.env_kwargs("any-quadcopter"), "vehicles": None, "vehicle": vehicle}
    flights = fly(
        sb3_quad.load_pretrained("any-quadcopter"),
        "state_recovery",
        480,
        33_000_000,
        max_episode_steps=600,
        **own,
    )
    assert (
        flights.survival.mean() > 0.96
    )  # of ITM, whose rotors do the least; without the layout it would be nearly none


def test_any_quadcopter_is_exported_for_a_given_vehicle(tmp_path, capsys):
    command = ["export", "any-quadcopter", "--format", "onnx", "-o", str(tmp_path)]
    assert main(command) == 2
    assert "flies any vehicle; say with --vehicle" in capsys.readouterr().err
    assert main([*command, "--vehicle", "crazyflie"]) == 0
    assert "vehicle: crazyflie: hover thrust 0.0662" in capsys.readouterr().out


class Names(pickle.Unpickler):
    """Unpickles, and records the names of all classes and functions that it needs."""

    def __init__(self, content):
        super().__init__(io.BytesIO(content))
        self.names = set()

    def find_class(self, module, name):
        self.names.add(f"{module}.{name}")
        return super().find_class(module, name)


@pytest.mark.parametrize("name", pretrained_names())
def test_their_pickles_name_only_classes_of_all_versions(name):
    """SB3 2.4 and later load them (tried with 2.4.1 and 2.7.1)."""
    with zipfile.ZipFile(sb3_quad.pretrained_path(name)) as file:
        data = json.loads(file.read("data"))
    names = set()
    for value in data.values():
        if isinstance(value, dict) and ":serialized:" in value:
            unpickler = Names(base64.b64decode(value[":serialized:"]))
            unpickler.load()
            names |= unpickler.names
    ours = {name for name in names if name.startswith(("stable_baselines3.", "sb3_quad"))}
    assert ours == PICKLED
    assert {"learning_rate", "clip_range"} <= {
        key for key, value in data.items() if isinstance(value, float)
    }  # no schedules


def test_names_stand_where_zips_do(capsys):
    expert = resolve_expert("itm-recovery")
    assert isinstance(expert, PPO)
    assert agent_path("itm-recovery") == str(sb3_quad.pretrained_path("itm-recovery"))
    assert agent_path("some/agent.zip") == "some/agent.zip"
    assert main(["enjoy", "itm-recovery", "--no-render", "-n", "50"]) == 0
    assert "itm-recovery" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="did you mean 'itm-recovery'"):
        sb3_quad.pretrained_path("itm-recovry")
    assert main(["enjoy", "itm-recovry", "--no-render"]) == 2
    assert "did you mean 'itm-recovery'" in capsys.readouterr().err
    any_quadcopter, recovery = parse_controllers(["any-quadcopter", "itm-recovery"])
    assert not any_quadcopter.notice(
        "crazyflie"
    ) and "was trained on the vehicle itm" in recovery.notice("crazyflie")
    controllers = parse_controllers(["itm-recovery", "mine=itm-recovery"])
    labels = {controller.label: controller.spec for controller in controllers}
    assert labels == dict.fromkeys(
        ("itm-recovery", "mine"), str(sb3_quad.pretrained_path("itm-recovery"))
    )


def test_publish_copies_the_policy_and_writes_where_it_comes_from(
    dagger_run, tmp_path, capsys, observations
):
    source = dagger_run / "QuadStateRecovery-v0.zip"
    (dagger_run / "QuadStateRecovery-v0" / "command.txt").write_text("typed\n```\nso\n")
    command = [str(source), "--name", "mine", "-o", str(tmp_path), "--episodes", "4"]
    assert publish.main(command) == 0
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    for part in (
        "# mine",
        "```bash\ntyped ''' so\n```",
        "| seed | 3 |",
        "`dagger`, ",
        "16 fresh recoveries and 4 fresh targets",
        "| state recovery |",
        "| 1.94 |",  # the physical limit, next to the settling time
    ):
        assert part in card
    slim, whole = (PPO.load(path, device="cpu") for path in (tmp_path / "mine.zip", source))
    for observation in (observations[1], -3.0 * observations[1]):
        np.testing.assert_array_equal(
            slim.predict(observation, deterministic=True)[0],
            whole.predict(observation, deterministic=True)[0],
        )
    assert (tmp_path / "mine.zip").stat().st_size < 0.5 * source.stat().st_size
    before = (tmp_path / "mine.zip").read_bytes()
    assert publish.main(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (tmp_path / "mine.zip").read_bytes() == before


def test_publish_uploads_what_the_hub_takes(tmp_path, monkeypatch):
    """It does what huggingface_sb3 does; calls that need a network are recorded."""
    called = []

    class HfApi:
        def create_repo(self, **given):
            called.append(given)

        def upload_folder(self, **given):
            called.append(given)
            called.append(
                sorted(
                    str(path.relative_to(given["folder_path"]))
                    for path in given["folder_path"].rglob("*.*")
                )
            )

    monkeypatch.setitem(sys.modules, "huggingface_hub", types.SimpleNamespace(HfApi=HfApi))
    given = ["itm-recovery", "--name", "mine", "-o", str(tmp_path), "--episodes", "2"]
    assert publish.main([*given, "--push", "somebody/mine"]) == 0
    folder = tmp_path / "mine"
    parts = ["policy.pth", "policy.optimizer.pth", "pytorch_variables.pth", "system_info.txt"]
    files = sorted(
        [
            "README.md",
            "config.json",
            "results.json",
            "mine.zip",
            *(f"mine/{part}" for part in parts),
        ]
    )
    upload = {"repo_id": "somebody/mine", "folder_path": folder, "commit_message": "Add mine"}
    assert called == [{"repo_id": "somebody/mine", "exist_ok": True}, upload, files]
    _, metadata, card = (folder / "README.md").read_text().split("---\n", 2)
    metadata = yaml.safe_load(metadata)
    results, config = (
        json.loads((folder / f"{name}.json").read_text()) for name in ("results", "config")
    )
    assert card.startswith("\n# mine\n") and metadata["library_name"] == "stable-baselines3"
    assert (
        "QuadStateRecovery-v0" in metadata["tags"] and "reinforcement-learning" in metadata["tags"]
    )
    (result,) = metadata["model-index"][0]["results"]
    assert (
        result["dataset"]["type"] == "QuadStateRecovery-v0"
        and result["task"]["type"] == "reinforcement-learning"
    )
    assert (
        results["n_eval_episodes"] == 8
        and results["is_deterministic"]
        and results["std_reward"] > 0
    )
    assert (
        result["metrics"][0]["value"]
        == f"{results['mean_reward']:.2f} +/- {results['std_reward']:.2f}"
    )
    assert f"| {results['mean_reward']:.2f} ".replace("-", "−") in card
    assert config["num_timesteps"] == PPO.load(folder / "mine.zip", device="cpu").num_timesteps
    assert "Python" in config["system_info"]


def test_publish_says_what_an_upload_needs(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert (
        publish.main(
            ["itm-recovery", "--name", "mine", "-o", str(tmp_path), "--push", "somebody/mine"]
        )
        == 2
    )
    assert capsys.readouterr().err.rstrip().endswith("pip install huggingface-hub") and not [
        *tmp_path.iterdir()
    ]


@pytest.mark.parametrize("name", pretrained_names())
def test_each_says_how_it_flies(name):
    settings, source = agent_settings(sb3_quad.pretrained_path(name))
    assert source == sb3_quad.pretrained_path(name) and settings.vehicle.flies_as(
        load_vehicle(vehicle_of(name))
    )
    imitates_pid = name in ("thesis-imitation", "thesis-printed-imitation")
    assert settings.task == ("target_tracking" if imitates_pid else "state_recovery")


def test_a_misspelt_name_is_guessed():
    with pytest.raises(ConfigError, match="itm-robus: no such file; did you mean 'itm-robust'"):
        sb3_quad.env_kwargs("itm-robus")


def test_the_keywords_of_an_agent_that_does_not_say_how_it_flies_are_refused(tmp_path):
    PPO("MlpPolicy", sb3_quad.QuadcopterVecEnv(1)).save(tmp_path / "silent.zip")
    with pytest.raises(ConfigError, match=r"silent\.zip: does not say how its agent flies"):
        sb3_quad.env_kwargs(tmp_path / "silent.zip")


def test_keywords_of_your_own_replace_those_of_the_agent():
    own = sb3_quad.env_kwargs("any-quadcopter", vehicle="hummingbird", noise=0.0)
    assert "vehicles" not in own and own["vehicle"] == "hummingbird" and own["noise"] == 0.0
    assert sb3_quad.QuadcopterVecEnv(2, **own).observation_space.shape == (188,)
    assert "vehicles" in sb3_quad.env_kwargs("any-quadcopter", noise=0.0)


def test_an_agent_of_rows_that_differ_flies_anywhere():
    sigma = [[1.0] * 18, [2.0] * 18]
    vehicles = ["itm", "crazyflie"]
    env = sb3_quad.QuadcopterVecEnv(2, vehicle=vehicles, noise=[0.0, 0.1], observation_std=sigma)
    own = sb3_quad.env_kwargs(sb3_quad.APG("MlpPolicy", env))
    assert (own["vehicle"].name, own["noise"], own["observation_std"]) == ("itm", 0.05, sigma[0])
    sb3_quad.QuadcopterVecEnv(3, **own)


def test_fly_warns_of_a_vehicle_that_an_agent_was_not_trained_on(recwarn):
    model = sb3_quad.load_pretrained("crazyflie-recovery")
    fly(model, n_episodes=1, max_episode_steps=1, **sb3_quad.env_kwargs(model))
    # Its own is the default.
    fly(model, n_episodes=1, max_episode_steps=1)
    assert not recwarn.list
    with pytest.warns(UserWarning, match="vehicle crazyflie and flies itm; sb3_quad"):
        fly(model, n_episodes=1, max_episode_steps=1, vehicle="itm")
    with pytest.raises(ControllerError, match=r"the environment's \(18,\); give \*\*env_kwargs"):
        fly("itm-robust", n_episodes=1, max_episode_steps=1)


@pytest.mark.slow
def test_outputs_go_where_the_command_is_called(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = sorted(FOLDER.iterdir())
    assert main(["export", "crazyflie-recovery", "--format", "onnx"]) == 0
    output = capsys.readouterr().out
    assert "vehicle: crazyflie" in output and "crazyflie-recovery.zip" in output
    assert main(["export", "itm-recovery", "--format", "onnx", "-o", "there"]) == 0
    assert sorted(path.name for path in tmp_path.rglob("*.onnx")) == [
        "crazyflie-recovery.onnx",
        "itm-recovery.onnx",
    ]
    assert (tmp_path / "there" / "itm-recovery.onnx").is_file()
    assert (
        main(["enjoy", "crazyflie-recovery", "-n", "40", "-o", "film.gif", "--size", "64x64"]) == 0
    )
    assert (tmp_path / "film.gif").is_file() and "warning" not in capsys.readouterr().err
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        assert main(["enjoy", "itm-recovery", "-n", "3", "--size", "64x64", "-o", "b.mp4"]) == 0
        assert (tmp_path / "b.mp4").is_file()
    assert sorted(FOLDER.iterdir()) == before


def test_publish_calls_missing_facts_unrecorded(tmp_path, capsys):
    env = QuadcopterVecEnv(2, seed=0)
    PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu", seed=0).save(
        tmp_path / "alone.zip"
    )
    assert (
        publish.main(
            [str(tmp_path / "alone.zip"), "--name", "x", "-o", str(tmp_path), "--episodes", "2"]
        )
        == 0
    )
    card = (tmp_path / "x.md").read_text()
    for part in (
        "`PPO`, 0 timesteps",
        "| run | not recorded |",
        "# not recorded",
        "not recorded; measured on `itm`",
    ):
        assert part in card
    for part in ("commit", "seed", "versions", "None"):
        assert part not in card
    assert agent_settings(tmp_path / "x.zip") == (FlightSettings(), None)


def test_publish_refuses_agents_that_it_cannot_describe(dagger_run, tmp_path, capsys):
    source = dagger_run / "QuadStateRecovery-v0.zip"
    for arguments, message in (
        ([str(tmp_path / "none.zip"), "--name", "x"], "no such file"),
        ([str(tmp_path), "--name", "x"], "no run with an agent"),
        *(([str(source), "--name", name], "--name") for name in ("", "..", "a/b", "two\nlines")),
        ([str(source), "--name", "x", "--episodes", "0"], "must be at least 1"),
    ):
        assert publish.main([*arguments, "--command", "typed so", "-o", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists() or not list(Path(tmp_path / "out").iterdir())
