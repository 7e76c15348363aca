"""A table: the zip of each algorithm in each, by load, custom_objects and set_parameters."""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO, SAC

from sb3_quad import APG, PPOBC, DAgger, QuadcopterVecEnv
from sb3_quad.agents.zips import load_model, load_zip
from sb3_quad.base.errors import ConfigError

SHORT = {"n_steps": 20, "batch_size": 40, "n_epochs": 1, "seed": 0, "device": "cpu"}
SMALL = {"learning_starts": 8, "buffer_size": 1000, "batch_size": 16, "seed": 0, "device": "cpu"}
MAKERS = {
    PPO: SHORT,
    A2C: {"n_steps": 20, "seed": 0, "device": "cpu"},
    DAgger: {**SHORT, "expert": "pid", "max_grad_norm": None},
    PPOBC: {**SHORT, "expert": "pid"},
    APG: {"n_steps": 20, "seed": 0, "device": "cpu"},
    SAC: SMALL,
}
LOADERS = [PPO, DAgger, PPOBC, APG, SAC]
OURS = (DAgger, PPOBC, APG)


@pytest.fixture(scope="module")
def zips(tmp_path_factory):
    """The zip of each algorithm, and that of PPOBC's agent after stock PPO went on with it."""
    folder = tmp_path_factory.mktemp("zips")
    env = QuadcopterVecEnv(4, seed=0)
    for algorithm, keywords in MAKERS.items():
        algorithm("MlpPolicy", env, **keywords).learn(80).save(folder / algorithm.__name__)
    for name in ("PPOBC", "DAgger"):
        again = PPO.load(folder / name, env=env, device="cpu").learn(80)
        again.save(folder / f"{name} then PPO")
    return folder


def keywords_of(loader, **keywords):
    if loader in OURS and loader is not APG:
        keywords["expert"] = "pid"
    return {"env": QuadcopterVecEnv(4, seed=0), "device": "cpu", **keywords}


def is_of_its_kind(made, loader):
    return (made == "SAC") == (loader is SAC)


MADE = [*(algorithm.__name__ for algorithm in MAKERS), "PPOBC then PPO", "DAgger then PPO"]


@pytest.mark.parametrize("made", MADE)
@pytest.mark.parametrize("loader", LOADERS)
def test_a_zip_goes_on_in_any_algorithm_of_its_kind(zips, made, loader):
    path = zips / made
    if not is_of_its_kind(made, loader):
        # What stock algorithms raise is SB3's.
        error = ConfigError if loader in OURS else Exception
        with pytest.raises(error) as raised:
            loader.load(path, **keywords_of(loader))
        if loader in OURS:
            assert "expert=" in str(raised.value) and "\n" not in str(raised.value)
        return
    model = loader.load(path, **keywords_of(loader))
    mine = model.predict(np.zeros((1, 18), np.float32), deterministic=True)[0]
    theirs = load_model(f"{path}.zip")
    np.testing.assert_array_equal(
        mine, theirs.predict(np.zeros((1, 18), np.float32), deterministic=True)[0]
    )
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


@pytest.mark.parametrize("made", MADE)
@pytest.mark.parametrize("loader", LOADERS)
def test_custom_objects_replace_what_a_zip_holds(zips, made, loader):
    if not is_of_its_kind(made, loader):
        pytest.skip("refused by the test above")
    objects = {"learning_rate": 1e-5, "lr_schedule": lambda _: 1e-5, "bc_coef": 0.25}
    model = loader.load(zips / made, custom_objects=objects, **keywords_of(loader))
    assert model.lr_schedule(0.3) == 1e-5
    model.learn(80, reset_num_timesteps=False)
    if "bc_coef" in vars(model) and made.startswith("PPOBC") and loader in OURS:
        assert loader in (DAgger, APG) or model.bc_coef(0.3) == 0.25


@pytest.mark.parametrize("made", MADE)
@pytest.mark.parametrize("loader", LOADERS)
def test_parameters_are_taken_or_refused(zips, made, loader):
    model = loader("MlpPolicy", QuadcopterVecEnv(4, seed=0), device="cpu")
    if not is_of_its_kind(made, loader):
        with pytest.raises((RuntimeError, ValueError)) as raised:
            model.set_parameters(zips / made)
        assert loader not in OURS or "\n" not in str(raised.value)
        return
    model.set_parameters(zips / made)
    for name, tensor in load_model(f"{zips / made}.zip").policy.state_dict().items():
        assert th.equal(tensor, model.policy.state_dict()[name])


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


@pytest.mark.parametrize("name", ["bc_coef", "l2_coef", "gamma", "clip_range", "critic_warmup"])
@pytest.mark.parametrize("value", ["x", [1.0]])
def test_what_is_no_number_is_named(name, value):
    with pytest.raises(ConfigError, match=f"{name} .*must be a number"):
        PPOBC("MlpPolicy", QuadcopterVecEnv(2), **{name: value})


@pytest.mark.parametrize(
    ("algorithm", "keywords"),
    [(PPOBC, {"bc_coef": "x"}), (DAgger, {"beta": "x"})],
)
def test_what_is_no_number_is_named_by_all(algorithm, keywords):
    with pytest.raises(ConfigError, match="'x': must be a number"):
        algorithm("MlpPolicy", QuadcopterVecEnv(2), **keywords)


def test_a_batch_of_more_rows_than_are_kept_is_refused():
    with pytest.raises(ConfigError, match="batch_size 1000000000"):
        DAgger("MlpPolicy", QuadcopterVecEnv(2), batch_size=10**9)
