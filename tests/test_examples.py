"""Each script in examples/ runs as a newcomer would run it, but for a short while."""

import re
import runpy
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch as th
from joystick import fly as steer
from load_in_plain_sb3 import Observation
from sac_bc import SACBC, swing_up
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import sb3_quad
from sb3_quad import GeometricExpert, QuadcopterVecEnv, load_vehicle
from sb3_quad.envs.simulation.frames import PositionIntegral
from sb3_quad.envs.simulation.state import X

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
SHORT = ("--timesteps", "100")  # a single rollout
# Scripts with what makes them short, and a part of what they print. Others have tests below, or in
# test_zoo.py, test_crazyflie_app.py, test_pretrained.py and test_zip_portability.py.
SCRIPTS = {
    "two_stages.py": (("--timesteps", "100", "100"), "agent, target_tracking: success"),
    "own_expert.py": (SHORT, "agent: success"),
    "own_vehicle.py": (SHORT, "agent: success"),
    "own_reward.py": (SHORT, "agent after training: mean reward"),
    "own_callback.py": (("--timesteps", "100000"), "crashed"),
    "sac_bc.py": (("quadcopter", *SHORT), "agent: success"),
}


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run_script(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run_script


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_runs(run, monkeypatch, name):
    monkeypatch.setattr(sb3_quad, "fly", few_flights)
    arguments, printed = SCRIPTS[name]
    assert printed in run(name, *arguments)


def few_flights(controller, task, n_episodes, seed, **settings):
    from sb3_quad.evaluation.flights import fly

    return fly(controller, task, 2, seed, max_episode_steps=50, **settings)


WEEKLY = [pytest.mark.slow, pytest.mark.campaign]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("own_reward", marks=pytest.mark.slow),
        *(pytest.param(f"own_{name}", marks=WEEKLY) for name in ("expert", "vehicle", "callback")),
    ],
)
def test_an_agent_succeeds_as_it_is_shipped(run, name):
    output = run(f"{name}.py")
    shares = re.findall(r"^agent.*: .*success ([\d.]+)%", output, flags=re.MULTILINE)
    assert float(shares[-1]) > 90.0


def test_a_batch_of_ones_own_learns(run):
    output = run("own_batch.py", "--timesteps", "30000")
    before, after = map(float, re.findall(r": ([\d.]+) of 200 steps upright", output))
    assert after > 1.2 * before


def test_a_gradient_of_ones_own_leads_to_the_mark(run):
    output = run("gradient_of_your_environment.py", "--updates", "40")
    before, after = map(float, re.findall(r"([\d.]+) m from the mark", output))
    assert after < 0.8 * before


def test_an_agent_follows_a_stick():
    """Without a window, from a stick that a test moves: forward, turning, then at rest."""
    moves = iter([*200 * [(1.0, 0.0, 0.2, 0.5)], *300 * [(0.0, 0.0, 0.0, 0.0)]])
    off = []
    for env, guide in steer("itm-robust", partial(next, moves, None), render_mode=None):
        off.append(np.linalg.norm(env.true_state().position[0] - guide.position))
    assert len(off) == 500 and max(off) < 1.0 and off[-1] < 0.2


def test_the_observation_in_plain_sb3_is_that_of_the_environment():
    """Along a figure eight with a heading that turns, of an agent with frames and a preview."""
    sees = {"history": [0, 2], "last_action": True, "preview": [0, 5]}
    sees["position_integral"] = PositionIntegral().model_dump()
    curve = {"curve": "figure_eight", "speed": 1.0, "heading": 0.3, "heading_rate": 0.5}
    env = QuadcopterVecEnv(
        1, task_kwargs={"target_distance": 0.5}, noise=0.0, reference=curve, **sees
    )
    observation = Observation({**sees, "vehicle": load_vehicle("itm").model_dump(mode="json")})
    expert = GeometricExpert()
    table = env.batch.tracks
    seen = env.reset()[0]
    action = np.zeros(4)
    for step in range(60):
        state = env.true_state()
        ours = observation(
            (state.position - state.target)[0],
            state.rotation[0],
            (state.velocity - state.target_velocity)[0],
            state.body_rates[0],
            action,
            heading=np.arctan2(*state.target_heading[0, ::-1]),
            heading_rate=state.array[X.target_heading_rate, 0],
            accelerations=table[[step, step + 5], 6:9],
        )
        np.testing.assert_allclose(ours, seen, atol=1e-5, err_msg=f"step {step}")
        action = expert.actions(state)[0]
        seen = env.step(action[None])[0][0]


def pendulums(seed, **changes):
    settings = {"learning_starts": 0, "policy_kwargs": {"net_arch": [8]}, "seed": seed}
    return SACBC(
        "MlpPolicy",
        VecNormalize(make_vec_env("Pendulum-v1", 2, seed=seed)),
        label=lambda env: swing_up(env.get_original_obs()),
        device="cpu",
        **settings,
        **changes,
    )


def test_without_cloning_sac_bc_is_sac():
    agents = []
    for algorithm in (SAC, partial(SACBC, label=lambda env: np.zeros((2, 1)), bc_coef=0.0)):
        env = make_vec_env("Pendulum-v1", 2, seed=0)
        agents.append(algorithm("MlpPolicy", env, seed=0, device="cpu").learn(160))
    for ours, theirs in zip(*(agent.policy.parameters() for agent in agents), strict=True):
        assert th.equal(ours, theirs)


def test_sac_bc_stores_the_experts_action_beside_each_state():
    model = pendulums(0).learn(60)
    buffer = model.replay_buffer
    labels = swing_up(buffer.observations[:30].reshape(-1, 3)) / 2.0
    np.testing.assert_allclose(buffer.labels[:30].reshape(-1, 1), labels, atol=1e-6)


def test_sac_bc_leaves_frozen_layers_alone_and_saves_a_zip_of_sac(tmp_path):
    model = pendulums(0, q_filter=True)
    first = model.actor.latent_pi[0]
    first.requires_grad_(False)
    before = first.weight.clone()
    after = model.actor.mu.weight.clone()
    model.learn(60)
    assert th.equal(first.weight, before) and not th.equal(model.actor.mu.weight, after)
    model.save(tmp_path / "agent.zip")
    observation = np.ones((1, 3), np.float32)
    flown = SAC.load(tmp_path / "agent.zip", device="cpu").predict(observation, deterministic=True)
    np.testing.assert_array_equal(flown[0], model.predict(observation, deterministic=True)[0])
    again = SACBC.load(tmp_path / "agent.zip", env=model.env, label=model.label)
    again.learn(60)
    with pytest.raises(ValueError, match="label"):
        SACBC("MlpPolicy", "Pendulum-v1").learn(10)
