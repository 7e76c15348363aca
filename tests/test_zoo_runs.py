"""Run folders of rl_zoo3 in ours: their YAML, and agents of algorithms that we do not train. Needs
no rl_zoo3.
"""

from collections import OrderedDict

import pytest
import yaml
from stable_baselines3 import SAC

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.yaml_files import parse_keys
from sb3_quad.cli import main
from sb3_quad.envs.vec_env import QuadcopterVecEnv

ENV = "QuadStateRecovery-v0"
TAGGED = """!!python/object/apply:collections.OrderedDict
- - - env_kwargs
    - task: state_recovery
  - - policy_kwargs
    - activation_fn: !!python/name:torch.nn.modules.activation.Tanh ''
      net_arch: !!python/tuple [64, 64]
"""


def test_yaml_of_rl_zoo3_is_read_without_running_it():
    assert parse_keys(TAGGED, "config.yml") == {
        "env_kwargs": {"task": "state_recovery"},
        "policy_kwargs": {"activation_fn": "nn.Tanh", "net_arch": [64, 64]},
    }


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system ['true']",
        "!!python/name:os.system ''",
        "!!python/object/apply:collections.OrderedDict 3",
        "!!python/object/apply:collections.OrderedDict [[[1, 2, 3]]]",
        "!!python/object/apply:collections.OrderedDict []",
        "!!python/tuple 3",
    ],
)
def test_other_tags_are_refused(text):
    with pytest.raises(ConfigError, match=r"config\.yml: not valid YAML"):
        parse_keys(text, "config.yml")


@pytest.fixture
def foreign_run(tmp_path):
    """A folder as rl_zoo3 leaves it, of an algorithm that we do not train."""
    path = tmp_path / "logs" / "sac" / f"{ENV}_1"
    (path / ENV).mkdir(parents=True)
    SAC("MlpPolicy", QuadcopterVecEnv(1), buffer_size=1, device="cpu").save(path / f"{ENV}.zip")
    settings = {
        "env_kwargs": {"max_episode_steps": 30},
        "n_timesteps": 1000.0,
        "train_freq": 1,
        "normalize": False,
    }
    (path / ENV / "config.yml").write_text(yaml.dump(OrderedDict(settings)))
    (path / ENV / "args.yml").write_text(
        yaml.dump(OrderedDict(algo="sac", env=ENV, env_kwargs=None))
    )
    return path


def enjoy_sac(path):
    return main(
        ["enjoy", "--algo", "sac", "--env", ENV, "-f", str(path.parent.parent), "--no-render"]
    )


def test_ours_shows_runs_of_other_algorithms(foreign_run, capsys):
    assert enjoy_sac(foreign_run) == 0
    assert "after 0.30 s" in capsys.readouterr().out


def test_options_on_the_command_line_of_rl_zoo3_count(foreign_run, capsys):
    """It keeps env_kwargs in args.yml then, and lets them stand for all."""
    (foreign_run / ENV / "args.yml").write_text(
        yaml.dump(OrderedDict(algo="sac", env=ENV, env_kwargs={"max_episode_steps": 10}))
    )
    assert enjoy_sac(foreign_run) == 0
    assert "after 0.10 s" in capsys.readouterr().out


def test_a_run_behind_vec_normalize_is_refused(foreign_run, capsys):
    (foreign_run / ENV / "config.yml").write_text(yaml.dump(OrderedDict(normalize=True)))
    assert enjoy_sac(foreign_run) == 2
    assert "was trained with normalize" in capsys.readouterr().err
