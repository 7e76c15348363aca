"""Each script in examples/ runs as a newcomer would run it, but for a short while."""

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from load_in_plain_sb3 import Observation

import sb3_quad
from sb3_quad import GeometricExpert, QuadcopterVecEnv, load_vehicle
from sb3_quad.envs.simulation.frames import PositionIntegral

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
SHORT = ("--timesteps", "100")  # a single rollout
# Scripts with what makes them short, and a part of what they print. Others have tests below, or in
# test_zoo.py, test_crazyflie_app.py, test_pretrained.py and test_zip_portability.py.
SCRIPTS = {
    "own_expert.py": (SHORT, "agent: success"),
    "own_reward.py": (SHORT, "agent after training: mean reward"),
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
        pytest.param("own_expert", marks=WEEKLY),
    ],
)
def test_an_agent_succeeds_as_it_is_shipped(run, name):
    output = run(f"{name}.py")
    shares = re.findall(r"^agent.*: .*success ([\d.]+)%", output, flags=re.MULTILINE)
    assert float(shares[-1]) > 90.0


def test_a_gradient_of_ones_own_leads_to_the_mark(run):
    output = run("gradient_of_your_environment.py", "--updates", "40")
    before, after = map(float, re.findall(r"([\d.]+) m from the mark", output))
    assert after < 0.8 * before


def test_the_observation_in_plain_sb3_is_that_of_the_environment():
    """Of an agent with frames and a preview, on its way to a target that rests."""
    sees = {"history": [0, 2], "last_action": True, "preview": [0, 5]}
    sees["position_integral"] = PositionIntegral().model_dump()
    env = QuadcopterVecEnv(1, task_kwargs={"target_distance": 0.5}, noise=0.0, **sees)
    observation = Observation({**sees, "vehicle": load_vehicle("itm").model_dump(mode="json")})
    expert = GeometricExpert()
    seen = env.reset()[0]
    action = np.zeros(4)
    for step in range(60):
        state = env.true_state()
        ours = observation(
            (state.position - state.target)[0],
            state.rotation[0],
            state.velocity[0],
            state.body_rates[0],
            action,
        )
        np.testing.assert_allclose(ours, seen, atol=1e-5, err_msg=f"step {step}")
        action = expert.actions(state)[0]
        seen = env.step(action[None])[0][0]
