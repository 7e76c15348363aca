"""``compare``: all fly the same episodes, each agent as it was trained; the numbers are those of
``fly``.
"""

import numpy as np
import pytest

from sb3_quad import PIDExpert, env_kwargs, load_pretrained, pretrained_path
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.evaluation.compare import compare
from sb3_quad.evaluation.flights import fly, fly_settings

SHORT = {"max_episode_steps": 60}


def hover(observation):
    return np.zeros((len(observation), 4), dtype=np.float32)


def test_each_flies_as_it_was_trained_through_the_same_episodes():
    controllers = {
        "hover": hover,
        "zip": pretrained_path("crazyflie-recovery"),
        "model": load_pretrained("crazyflie-recovery"),
        "other": "itm-robust",
        "PID": "pid",
        "object": PIDExpert("crazyflie"),
    }
    result = compare(controllers, ["state_recovery"], n_episodes=6, seed=3, **SHORT)
    metrics = {label: result[label]["state_recovery"] for label in controllers}
    assert metrics["zip"] == metrics["model"] != metrics["other"]
    # Those that do not say how they fly take the vehicle of the first agent.
    assert metrics["PID"] == metrics["object"]
    for label, name in (("zip", "crazyflie-recovery"), ("other", "itm-robust")):
        settings = FlightSettings(task="state_recovery", **env_kwargs(name), **SHORT)
        flights = fly_settings(load_pretrained(name), settings, row_seeds(3, 6))
        assert metrics[label].reward.value == pytest.approx(flights.reward.mean(), abs=1e-12)
    assert "hover flies crazyflie" in result.tables[0].caption
    assert "other flies itm" in result.tables[0].caption


def scaled(vehicle):
    """A factory's agent that observed in a scaling of its own."""
    model = load_pretrained("crazyflie-recovery")
    scaling = np.linspace(1.0, 3.0, 18)
    FlightSettings(vehicle="crazyflie", observation_std=scaling).write_into(model)
    return model


def test_an_agent_of_a_factory_observes_as_it_was_trained(capsys):
    agent = scaled(None)
    both = {"model": agent, "made": f"{__name__}:scaled"}
    result = compare(both, ["state_recovery"], 4, max_episode_steps=50)
    assert result["made"] == result["model"]
    assert not capsys.readouterr().err
    fly(agent, n_episodes=2, max_episode_steps=2, vehicle="crazyflie")
    assert "observation_std" in capsys.readouterr().err


def test_those_that_fly_another_vehicle_are_named(recwarn):
    controllers = {"PID": PIDExpert("crazyflie"), "agent": "crazyflie-recovery"}
    compare(controllers, ["state_recovery"], 2, max_episode_steps=2)
    assert not recwarn.list
    compare(controllers, ["state_recovery"], 2, vehicle="itm", max_episode_steps=2)
    messages = [str(warning.message) for warning in recwarn.list]
    assert "PIDExpert" in messages[0] and "agent" in messages[1]


def test_settings_for_all_override_those_of_the_agents():
    controllers = {"agent": "crazyflie-recovery", "PID": "pid"}
    how = {"vehicle": "itm", "noise": 0.0, "max_episode_steps": 50}
    result = compare(controllers, n_episodes=4, seed=1, **how)
    pid = fly(PIDExpert(), "target_tracking", 4, 1, **how)
    assert result["PID"]["target_tracking"].reward.value == pytest.approx(pid.reward.mean())
    assert [*result["agent"]] == ["target_tracking", "state_recovery"]
    assert "flies" not in result.tables[0].caption


def test_a_comparison_is_plain_text_and_a_table_in_notebooks():
    tasks = ["target_tracking", {"target_tracking": 1, "state_recovery": 3}]
    both = {"still": hover, "PID": "pid"}
    result = compare(both, tasks, 4, max_episode_steps=20)
    text = str(result)
    for part in ("75% state_recovery", "survival, %", "mean reward"):
        assert part in text
    assert "\x1b" not in text and "thesis" not in text
    assert result._repr_markdown_().count("| mean reward |") == 2
    beside = {"thesis_columns": ["expert"], "max_episode_steps": 20}
    assert "thesis: expert" in str(compare({"PID": "pid"}, "target_tracking", 2, **beside))
