"""A table: the zip of each algorithm in each, by load, custom_objects and set_parameters."""

import inspect
import subprocess
import sys

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO, SAC

from sb3_quad import APG, PPOBC, DAgger, QuadcopterVecEnv
from sb3_quad.agents.zips import load_model, load_zip
from sb3_quad.algorithms import common
from sb3_quad.algorithms.common import warn_if_worse
from sb3_quad.base.errors import ConfigError
from sb3_quad.training.config import load_config

SHORT = {"n_steps": 20, "batch_size": 40, "n_epochs": 1, "seed": 0, "device": "cpu"}
SMALL = {"learning_starts": 8, "buffer_size": 1000, "batch_size": 16, "seed": 0, "device": "cpu"}
MAKERS = {
    PPO: SHORT,
    A2C: {"n_steps": 20, "seed": 0, "device": "cpu"},
    DAgger: {**SHORT, "expert": "pid"},
    PPOBC: {**SHORT, "expert": "pid"},
    APG: {"n_steps": 20, "seed": 0, "device": "cpu"},
    SAC: SMALL,
}
LOADERS = [PPO, DAgger, PPOBC, APG]
OURS = (DAgger, PPOBC, APG)


@pytest.fixture(scope="module")
def zips(tmp_path_factory):
    """The zip of each algorithm, and that of DAgger's agent after stock PPO went on with it."""
    folder = tmp_path_factory.mktemp("zips")
    env = QuadcopterVecEnv(4, seed=0)
    for algorithm, keywords in MAKERS.items():
        algorithm("MlpPolicy", env, **keywords).learn(80).save(folder / algorithm.__name__)
    again = PPO.load(folder / "DAgger", env=env, device="cpu").learn(80)
    again.save(folder / "DAgger then PPO")
    return folder


def keywords_of(loader, **keywords):
    if loader in OURS and loader is not APG:
        keywords["expert"] = "pid"
    return {"env": QuadcopterVecEnv(4, seed=0), "device": "cpu", **keywords}


MADE = ["PPO", "A2C", "PPOBC", "APG", "DAgger then PPO"]


@pytest.mark.parametrize("loader", OURS)
def test_a_zip_of_another_kind_is_refused_in_one_line(zips, loader):
    model = loader("MlpPolicy", QuadcopterVecEnv(4, seed=0), device="cpu")
    for load in (lambda path: loader.load(path, **keywords_of(loader)), model.set_parameters):
        with pytest.raises((RuntimeError, ValueError)) as raised:
            load(zips / "SAC")
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("made", MADE)
@pytest.mark.parametrize("loader", LOADERS)
def test_a_zip_goes_on_in_any_algorithm_of_its_kind(zips, made, loader):
    path = zips / made
    theirs = load_model(f"{path}.zip").policy.state_dict()
    other = loader("MlpPolicy", QuadcopterVecEnv(4, seed=0), device="cpu")
    other.set_parameters(path)
    model = loader.load(path, **keywords_of(loader))
    for name, tensor in theirs.items():
        assert th.equal(tensor, model.policy.state_dict()[name])
        assert th.equal(tensor, other.policy.state_dict()[name])
    before = model.num_timesteps
    model.learn(80, reset_num_timesteps=False)
    assert model.num_timesteps >= before + 80


@pytest.mark.parametrize("loader", OURS)
@pytest.mark.parametrize("name", ["initial_policy", "demonstrations"])
def test_what_only_a_new_model_takes_is_refused_by_load(zips, loader, name):
    path = zips / loader.__name__
    with pytest.raises(ConfigError, match=rf"^{loader.__name__}.load does not take {name}; "):
        loader.load(path, **keywords_of(loader, **{name: "itm-imitation"}))
    loader.load(path, **keywords_of(loader, **{name: None}))


@pytest.mark.parametrize("loader", LOADERS)
def test_custom_objects_replace_what_a_zip_holds(zips, loader):
    objects = {"learning_rate": 1e-5, "lr_schedule": lambda _: 1e-5, "bc_coef": 0.25}
    model = loader.load(zips / "PPOBC", custom_objects=objects, **keywords_of(loader))
    assert model.lr_schedule(0.3) == 1e-5
    model.learn(80, reset_num_timesteps=False)
    assert loader is not PPOBC or model.bc_coef(0.3) == 0.25


@pytest.mark.parametrize("algorithm", [DAgger, PPOBC])
def test_parameters_of_other_layers_are_refused_in_one_line(algorithm):
    one = algorithm("MlpPolicy", QuadcopterVecEnv(2), device="cpu")
    other = algorithm(
        "MlpPolicy", QuadcopterVecEnv(2), policy_kwargs={"net_arch": [8]}, device="cpu"
    )
    with pytest.raises(RuntimeError, match="set_parameters") as raised:
        one.set_parameters(other.get_parameters())
    assert "\n" not in str(raised.value)


NUMBERS = {
    "n_steps": np.int64(20),
    "batch_size": np.int64(40),
    "gamma": np.float64(0.9),
    "n_epochs": np.int32(1),
    "gae_lambda": np.float32(0.5),
    "policy_kwargs": {"net_arch": [np.int64(16)]},
}
OWN = {"learning_rate": np.float32(1e-3), "seed": np.int64(3), "expert": "pid"}
RARE = {
    "learning_starts": np.int64(8),
    "buffer_size": np.int64(1000),
    "batch_size": np.int64(16),
    "gradient_steps": np.int64(1),
    "tau": np.float32(0.01),
    "target_entropy": np.float32(-2.0),
}


@pytest.mark.parametrize(
    ("algorithm", "keywords"),
    [
        (PPO, NUMBERS),
        (SAC, RARE),
        (DAgger, {**NUMBERS, **OWN, "beta": np.float32(0.5)}),
        (PPOBC, {**NUMBERS, **OWN, "bc_coef": np.float32(0.1)}),
    ],
)
def test_numbers_of_numpy_do_not_keep_a_zip_from_being_read(algorithm, keywords, tmp_path):
    path = tmp_path / "agent.zip"
    env = QuadcopterVecEnv(4, seed=0)
    algorithm("MlpPolicy", env, device="cpu", **keywords).learn(80).save(path)
    observation = np.zeros((1, 18), np.float32)
    actions, _ = algorithm.load(path, device="cpu").predict(observation, deterministic=True)
    np.testing.assert_array_equal(
        load_model(path).predict(observation, deterministic=True)[0], actions
    )
    loaded = load_zip(algorithm, path, device="cpu", env=env)
    loaded.set_env(env)
    if algorithm not in (PPO, SAC):
        loaded.set_expert("pid")
        plain = [value for value in vars(loaded).values() if isinstance(value, np.generic)]
        assert not plain
    loaded.learn(80)


@pytest.mark.parametrize(
    ("algorithm", "name"), [(PPOBC, "ppo_bc"), (DAgger, "dagger"), (APG, "apg")]
)
def test_a_recipe_repeats_no_default(algorithm, name):
    """What the constructor and the settings file say is said once, in the constructor."""
    config = load_config(name, "QuadStateRecovery-v0")
    parameters = inspect.signature(algorithm).parameters
    for key, value in config.hyperparams.items():
        assert parameters[key].default != value, key


def test_learning_needs_nothing_of_the_simulator():
    code = (
        "import sys\n"
        "from sb3_quad import DAgger\n"
        "print(*[name for name in sys.modules if name.startswith('sb3_quad')])\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert len(run.stdout.split()) <= 20


def episodes(crashed, n=100, length=500.0):
    """Return the returns and lengths of episodes that fly well, but for a share that crashes."""
    well = np.stack([np.random.default_rng(0).normal(-1.0, 0.3, n), np.full(n, length)], axis=1)
    well[: int(crashed * n)] = (-20.0, 60.0)
    return well


@pytest.mark.parametrize(("before", "after"), [(0.0, 1.0), (0.0, 0.3), (0.1, 0.8)])
def test_a_training_that_ends_far_below_its_start_is_told(before, after):
    with pytest.warns(UserWarning, match="PPOBC: the training ends far below its start"):
        warn_if_worse("PPOBC", episodes(before), episodes(after))


@pytest.mark.parametrize(
    ("before", "after", "lengths"),
    [
        (0.0, 0.02, (500.0, 500.0)),  # as a clone is beside its expert
        (1.0, 1.0, (500.0, 500.0)),  # from nothing
        (0.5, 0.6, (500.0, 500.0)),
        (0.0, 0.0, (50.0, 500.0)),  # the first episodes were cut short
    ],
)
def test_other_trainings_are_not(before, after, lengths, recwarn):
    first, last = (
        episodes(share, length=length) * [length / 500.0, 1.0]
        for share, length in zip((before, after), lengths, strict=True)
    )
    warn_if_worse("PPOBC", first, last)
    assert not recwarn


@pytest.mark.parametrize("algorithm", OURS)
def test_the_first_and_last_episodes_are_compared(algorithm, monkeypatch):
    """Those that the agent flies: DAgger's expert flies the first rollout."""
    compared = []
    monkeypatch.setattr(common, "warn_if_worse", lambda *given: compared.append(given))
    settings = dict(MAKERS[algorithm])
    if algorithm is DAgger:
        settings |= {"beta": 1.0, "beta_decay": 0.6, "beta_final": 0.0}
    flown = []
    original = algorithm._update_info_buffer

    def watch(self, infos, dones):
        original(self, infos, dones)
        if dones.all():
            flown.append([info["episode"]["r"] for info in infos])

    monkeypatch.setattr(algorithm, "_update_info_buffer", watch)
    env = QuadcopterVecEnv(16, max_episode_steps=20, seed=0)
    algorithm("MlpPolicy", env, **settings).learn(3 * 16 * 20)
    ((name, first, last),) = compared
    assert name == algorithm.__name__
    np.testing.assert_allclose(first[:, 0], flown[algorithm is DAgger])
    np.testing.assert_allclose(last[:, 0], flown[2])
