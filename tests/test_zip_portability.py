"""Saved and shipped zips fly in stock Stable-Baselines3, where sb3_quad is not installed."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.utils import LinearSchedule

import sb3_quad
from sb3_quad import PPOBC, SACBC, DAgger, GeometricExpert, PIDExpert
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import pretrained_names
from sb3_quad.callbacks import CoefficientSchedule
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle

FLY = """
import json, sys
sys.modules["sb3_quad"] = None  # importing it, or unpickling anything of it, fails
import numpy as np
from stable_baselines3 import PPO, SAC
observations, *zips = sys.argv[1:]
models = [(SAC if path.startswith("sac") else PPO).load(path, device="cpu") for path in zips]
assert not any(name.startswith("sb3_quad.") for name in sys.modules)
assert all(model.flight_settings["vehicle"]["mass"] > 0 for model in models)
models[0].save("again.zip")
seen = np.load(observations)
# Some agents observe more than 18 features.
own = [np.resize(seen, (len(seen), *model.observation_space.shape)) for model in models]
actions = [model.predict(x, deterministic=True)[0].tolist() for model, x in zip(models, own)]
json.dump([actions, [model.num_timesteps for model in models]], sys.stdout)
"""
EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "load_in_plain_sb3.py"
RUN = (
    "import runpy, sys; sys.modules['sb3_quad'] = None; "
    "runpy.run_path(sys.argv.pop(1), run_name='__main__')"
)
# Agents that do not end at their target, and the greatest distance that is allowed, m.
NEXT_TO_TARGET = {"thesis-ppo": 1.5, "thesis-printed-recovery": 1.0, "thesis-printed-ppo": 9.0}
SMALL = {
    "n_steps": 32,
    "batch_size": 128,
    "learning_rate": LinearSchedule(1e-3, 0.0, 1.0),
    "seed": 0,
    "device": "cpu",
}


@pytest.mark.slow
def test_ppo_loads_them_where_sb3_quad_cannot_be_imported(tmp_path):
    env = QuadcopterVecEnv(8, seed=0, max_episode_steps=20)
    envs = [
        QuadcopterVecEnv(
            8,
            seed=0,
            max_episode_steps=20,
            vehicle="crazyflie",
            noise=0.1 * number,
            observation_mean=np.full(18, 0.5),
        )
        for number in range(4)
    ]
    models = [
        DAgger("MlpPolicy", envs[0], expert=PIDExpert(), **SMALL),
        DAgger("MlpPolicy", envs[1], expert=PIDExpert(), clip_range_vf=0.2, **SMALL),
        PPOBC("MlpPolicy", envs[2], expert=PIDExpert(), clip_range_vf=0.2, **SMALL),
        PPOBC(
            "MlpPolicy",
            envs[3],
            expert=PIDExpert(),
            bc_coef=LinearSchedule(1.0, 0.0, 0.5),
            **SMALL,
        ),
    ]
    for number, model in enumerate(models):
        model.learn(256, callback=CoefficientSchedule("bc_coef", 1.0, 0.0) if number == 2 else None)
        assert model.ep_info_buffer  # it is saved too, so it must not be empty here
        model.save(tmp_path / f"{number}.zip")
    additions = {"bc_coef": LinearSchedule(0.5, 0.0, 1.0)}
    sac = SACBC(
        "MlpPolicy",
        env,
        expert=PIDExpert(),
        buffer_size=2000,
        learning_starts=0,
        seed=0,
        device="cpu",
        **additions,
    )
    sac.learn(320)
    sac.save(tmp_path / "sac.zip")
    observations = env.reset()
    np.save(tmp_path / "observations.npy", observations)
    files = ["observations.npy", *(f"{number}.zip" for number in range(len(models))), "sac.zip"]
    shipped = [sb3_quad.pretrained_path(name) for name in pretrained_names()]
    command = [sys.executable, "-W", "error", "-c", FLY, *files, *map(str, shipped)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert result.returncode == 0, result.stderr
    actions, timesteps = json.loads(result.stdout)
    assert timesteps[: len(models)] == [256] * len(models)
    for path, noise in (("again.zip", 0.0), ("2.zip", 0.2)):
        settings, source = agent_settings(tmp_path / path)
        assert source == tmp_path / path and settings.vehicle == load_vehicle("crazyflie")
        assert (settings.noise, settings.observation_mean, settings.task) == (
            noise,
            [0.5] * 18,
            "target_tracking",
        )
    for model, flown in zip([*models, sac, *map(PPO.load, shipped)], actions, strict=True):
        seen = np.resize(observations, (len(observations), *model.observation_space.shape))
        # Both processes may use different numbers of threads, whose sums round differently.
        np.testing.assert_allclose(
            np.float32(flown), model.predict(seen, deterministic=True)[0], atol=1e-5
        )


def save_extended(folder):
    """Save a zip as `train` does, of an agent that observes frames, its last action and the
    integral, with a scaling of its own.
    """
    scaling = {
        "observation_mean": np.linspace(-0.3, 0.4, 18),
        "observation_std": np.linspace(2.0, 3.0, 18),
    }
    integral = {"gain": 2.0, "distance": 2.0, "speed": 9.0, "limit": 0.1}
    frames = {"last_action": True, "history": [0, 2, 5], "position_integral": integral}
    settings = FlightSettings(vehicle="hummingbird", **frames, **scaling)
    model = DAgger(
        "MlpPolicy",
        QuadcopterVecEnv(4, **settings.in_any_task()),
        expert=GeometricExpert("hummingbird"),
        **SMALL,
    )
    model.save(folder / "extended.zip")
    return folder / "extended.zip"


@pytest.mark.slow
@pytest.mark.parametrize("name", [*pretrained_names(), "extended"])
def test_the_example_builds_the_observation_that_the_package_builds(name, tmp_path):
    """Both are compared in closed loop: the action for the example's observation flies."""
    path = save_extended(tmp_path) if name == "extended" else sb3_quad.pretrained_path(name)
    model = PPO.load(path, device="cpu")
    settings = {**sb3_quad.env_kwargs(path), "noise": 0.0, "vehicles": None}
    env = QuadcopterVecEnv(
        1,
        "state_recovery",
        task_kwargs={"velocity_std": 1.0},
        max_episode_steps=1000,
        seed=3,
        **settings,
    )
    observation, action = (
        runpy.run_path(str(EXAMPLE))["Observation"](model.flight_settings),
        np.zeros((1, 4)),
    )
    expected = env.reset()
    for _ in range(150 if name == "extended" else 500):
        state = env.true_state()
        position = (state.position - state.target)[0]
        seen = observation(
            position, state.rotation[0], state.velocity[0], state.body_rates[0], action[0]
        )
        np.testing.assert_allclose(seen, expected[0], rtol=1e-6, atol=1e-6)
        action = model.predict(seen[None], deterministic=True)[0]
        expected, _, done, _ = env.step(action)
        if done[0]:
            break
    assert len(observation.frames) == observation.ages[-1] + 1
    assert (observation.integral != 0.0).any() == (observation.rule is not None)


@pytest.mark.slow
def test_the_example_flies_every_zip_where_sb3_quad_cannot_be_imported(tmp_path):
    zips = [str(sb3_quad.pretrained_path(name)) for name in pretrained_names()]
    command = [sys.executable, "-W", "error", "-c", RUN, str(EXAMPLE)]
    result = subprocess.run(
        [*command, *zips, str(save_extended(tmp_path))], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    distances = [
        float(line.rpartition(": ")[2].split(" m from")[0])
        for line in result.stdout.splitlines()
        if " m from" in line
    ]
    assert len(distances) == len(zips) + 1
    for name, distance in zip(pretrained_names(), distances, strict=False):
        assert distance < NEXT_TO_TARGET.get(name, 0.1), name
    model = PPO("MlpPolicy", QuadcopterVecEnv(4), seed=0, device="cpu")
    model.save(tmp_path / "silent.zip")
    result = subprocess.run(
        [*command, str(tmp_path / "silent.zip")], capture_output=True, text=True, check=False
    )
    assert (
        result.returncode == 1
        and "flight_settings" in result.stderr
        and "Traceback" not in result.stderr
    )
