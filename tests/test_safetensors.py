"""Agents as safetensors files: the same agents as their zips, without a pickle."""

import json
import struct

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.vec_env import VecNormalize

import sb3_quad
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.agents.zips import load_model, saved_algorithm, saved_data
from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.export.policy import export_policy

torch_files = pytest.importorskip("safetensors.torch")
MODELS = {
    "ppo": (PPO, {"net_arch": [16, 12], "log_std_init": -1.0}),
    "a2c": (A2C, {"net_arch": {"pi": [24], "vf": [8]}, "activation_fn": torch.nn.ReLU}),
    "sac": (SAC, {"net_arch": {"pi": [16], "qf": [8]}, "n_critics": 3}),
    "td3": (TD3, {"net_arch": [16]}),
    "ddpg": (DDPG, {"net_arch": [16], "optimizer_class": torch.optim.AdamW}),
}


@pytest.fixture(scope="module")
def zips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    for kind, (algorithm, kwargs) in MODELS.items():
        further = {} if algorithm in (PPO, A2C) else {"buffer_size": 10}
        env = QuadcopterVecEnv(2, seed=0)
        model = algorithm("MlpPolicy", env, policy_kwargs=kwargs, device="cpu", **further)
        model.save(folder / f"{kind}.zip")
    return folder


def written(zip_file, folder, name="agent"):
    path = folder / f"{name}.safetensors"
    path.write_bytes(export_policy(zip_file, "safetensors").content)
    return path


@pytest.mark.parametrize("kind", MODELS)
def test_it_is_the_agent_of_the_zip(zips, tmp_path, kind):
    old = zips / f"{kind}.zip"
    new = written(old, tmp_path)
    mine, theirs = load_model(new), load_model(old)
    for name, tensor in theirs.policy.state_dict().items():
        assert torch.equal(mine.policy.state_dict()[name], tensor)
    seen = np.random.default_rng(0).normal(size=(300, 18)).astype(np.float32)
    actions, _ = mine.predict(seen, deterministic=True)
    np.testing.assert_array_equal(actions, theirs.predict(seen, deterministic=True)[0])
    assert saved_algorithm(new) == saved_algorithm(old)
    assert agent_settings(new)[0] == agent_settings(old)[0]


@pytest.mark.parametrize("name", ["itm-recovery", "any-quadcopter", "crazyflie-robust"])
def test_shipped_agents_keep_all_that_their_zips_say(tmp_path, name):
    old = sb3_quad.pretrained_path(name)
    new = written(old, tmp_path)
    settings, source = agent_settings(new)
    assert settings == agent_settings(old)[0] and source == new
    assert saved_data(new)["num_timesteps"] == saved_data(old)["num_timesteps"]
    # What it holds is a header of JSON and numbers, and nothing else.
    content = new.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    data = json.loads(header.pop("__metadata__")["sb3_quad"])
    assert ":serialized:" not in json.dumps(data)
    assert max(entry["data_offsets"][1] for entry in header.values()) == len(content) - 8 - length


def test_a_run_that_says_beside_its_zip_how_it_flies_says_it_in_the_file(zips, tmp_path):
    folder = tmp_path / "QuadTargetTracking-v0"
    folder.mkdir()
    (folder / "config.yml").write_text("env_kwargs: {vehicle: crazyflie, noise: 0.1}\n")
    model = PPO.load(zips / "ppo.zip", device="cpu")
    model.save(tmp_path / "agent.zip")
    new = written(tmp_path / "agent.zip", tmp_path / "QuadTargetTracking-v0")
    settings, source = agent_settings(new)
    assert source == new and settings.vehicle.name == "crazyflie" and settings.noise == 0.1


def test_all_commands_take_it(zips, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    zip_file = str(zips / "ppo.zip")
    assert main(["export", "itm-recovery", "--format", "safetensors"]) == 0
    agent = "itm-recovery.safetensors"
    (spec,) = parse_controllers([agent])
    assert (spec.label, spec.kind) == ("itm-recovery", "model")
    assert resolve_expert(agent).num_timesteps is not None
    shown = ["--scenario", "tracking", "-n", "2", "-o", "results"]
    assert main(["evaluate", agent, zip_file, *shown]) == 0
    assert main(["enjoy", agent, "-n", "3", "-o", "flight.npz"]) in (0, 2)
    assert main(["export", agent, "--format", "torchscript", "-o", "again.pt"]) == 0
    small = ["-n", "256", "--hyperparams", "n_steps:64", "n_envs:2", "batch_size:64"]
    train = ["train", "--algo", "ppo", "--env", "QuadTargetTracking-v0", "-i", agent, *small]
    assert main([*train, "-f", "logs", "--eval-freq", "-1"]) == 0
    capsys.readouterr()
    assert main(["export", agent, "--format", "safetensors"]) == 2
    assert "is the model itself" in capsys.readouterr().err


def refused(path, message):
    with pytest.raises(ConfigError, match=message) as error:
        load_model(path)
    assert "\n" not in str(error.value)


def test_other_files_are_refused_in_one_line(zips, tmp_path):
    path = tmp_path / "agent.safetensors"
    refused(path, "no such file")
    path.mkdir()
    refused(path, "no such file")
    path.rmdir()
    foreign = "not what sb3-quad export --format safetensors writes"
    for content in (b"", b"PK\x03\x04", (zips / "ppo.zip").read_bytes()):
        path.write_bytes(content)
        refused(path, foreign)
    path.write_bytes(torch_files.save({"weight": torch.zeros(3)}))
    refused(path, foreign)
    path.write_bytes(torch_files.save({"weight": torch.zeros(3)}, {"sb3_quad": "[1]"}))
    refused(path, foreign)
    path.write_bytes(torch_files.save({"weight": torch.zeros(3)}, {"sb3_quad": "{}"}))
    refused(path, "is damaged|policy_class")
    whole = export_policy(zips / "ppo.zip", "safetensors").content
    path.write_bytes(whole[:-100])
    refused(path, foreign)


CHANGES = {
    "layers": ("policy_kwargs", {"net_arch": [100_000, 100_000]}, "its file holds fewer"),
    "many": ("policy_kwargs", {"net_arch": [1] * 2000}, "too many values"),
    "class": ("policy_kwargs", {"activation_fn": "nn.Evil"}, "nn.Evil"),
    "wide": ("observation_size", 10**12, "its file holds fewer"),
    "other": ("observation_size", 17, "cannot be loaded"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_settings_that_its_weights_do_not_bear_out_are_refused(zips, tmp_path, change):
    key, value, message = CHANGES[change]
    path = written(zips / "ppo.zip", tmp_path)
    tensors = torch_files.load(path.read_bytes())
    data = saved_data(path)
    data[key] = value
    path.write_bytes(torch_files.save(tensors, {"sb3_quad": json.dumps(data)}))
    refused(path, message)


def test_weights_that_are_not_finite_are_refused(zips, tmp_path):
    path = written(zips / "ppo.zip", tmp_path)
    tensors = torch_files.load(path.read_bytes())
    tensors["log_std"][0] = float("nan")
    path.write_bytes(torch_files.save(tensors, {"sb3_quad": json.dumps(saved_data(path))}))
    refused(path, "log_std contains NaN")


def test_what_it_cannot_hold_stays_in_a_zip(tmp_path):
    env = QuadcopterVecEnv(2, seed=0)
    normal = PPO("MlpPolicy", VecNormalize(env), device="cpu")
    normal.vec_normalize = normal.get_vec_normalize_env()
    gsde = PPO("MlpPolicy", env, use_sde=True, device="cpu")
    for number, model in enumerate((normal, gsde)):
        model.save(tmp_path / f"{number}.zip")
        with pytest.raises(ConfigError, match="has normalize or use_sde; only its zip holds these"):
            export_policy(tmp_path / f"{number}.zip", "safetensors")


@pytest.mark.parametrize("changes", [{"output": "speeds"}, {"vehicle": "crazyflie"}])
def test_it_is_the_agent_as_it_is(zips, changes):
    with pytest.raises(ConfigError, match="remove --output and --vehicle"):
        export_policy(zips / "ppo.zip", "safetensors", **changes)
