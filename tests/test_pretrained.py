"""Policies that come with the package, and the script that makes them."""

import base64
import itertools
import pickletools
import re

import numpy as np
import publish
import pytest
from stable_baselines3 import PPO

import sb3_quad
from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import agent_path, pretrained_names
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.agents.zips import saved_data
from sb3_quad.base.errors import ConfigError, ControllerError
from sb3_quad.cli import main
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.evaluation.flights import fly

FAST = ("itm-recovery", "any-quadcopter")
MARKED = [
    pytest.param(name, marks=[] if name in FAST else [pytest.mark.slow, pytest.mark.campaign])
    for name in pretrained_names()
]
# What the pickles of a zip may name, so that all versions of SB3 since 2.4 load it.
PICKLED = {
    "stable_baselines3.common.buffers.RolloutBuffer",
    "stable_baselines3.common.policies.ActorCriticPolicy",
}


def card_of(name):
    return sb3_quad.pretrained_path(name).with_suffix(".md").read_text(encoding="utf-8")


def vehicle_of(name):
    kind = name.split("-")[0]
    return "itm" if kind in ("any", "thesis") else kind


@pytest.mark.parametrize("name", MARKED)
def test_each_flies_as_its_card_says(name):
    card = card_of(name)
    rows = [line.split("|") for line in card.splitlines() if line.startswith("|")]
    (heading,) = (row for row in rows if any("survival" in cell for cell in row))
    column = next(number for number, cell in enumerate(heading) if "survival" in cell)
    (recovery,) = (row for row in rows if "state recovery" in row[1])
    settings, source = agent_settings(sb3_quad.pretrained_path(name))
    assert source == sb3_quad.pretrained_path(name)
    assert settings.vehicle.flies_as(load_vehicle(vehicle_of(name)))
    own = {**settings.in_any_task(), "vehicle": vehicle_of(name)}
    flights = fly(sb3_quad.load_pretrained(name), "state_recovery", 240, 31_000_000, **own)
    on_card = float(recovery[column].split()[0])
    assert 100 * flights.survival.mean() == pytest.approx(on_card, abs=6.0)


@pytest.mark.parametrize("name", pretrained_names())
def test_each_has_a_card_and_names_only_classes_of_all_versions(name):
    card = card_of(name)
    for part in (f"# {name}\n", "targets 20 m away |", "| seed |", "| commit |"):
        assert part in card
    data = saved_data(sb3_quad.pretrained_path(name))
    names = set()
    for value in data.values():
        if isinstance(value, dict) and ":serialized:" in value:
            content = base64.b64decode(value[":serialized:"])
            # Names are texts in a pickle, module and class one after the other.
            texts = [text for _, text, _ in pickletools.genops(content) if isinstance(text, str)]
            names |= {".".join(pair) for pair in itertools.pairwise(texts)}
    of_sb3 = re.compile(r"(stable_baselines3|sb3_quad)\.\S*\.[A-Z]\w*")
    ours = {*filter(of_sb3.fullmatch, names)}
    assert ours == PICKLED
    # No schedules.
    assert isinstance(data["learning_rate"], float) and isinstance(data["clip_range"], float)


def test_names_stand_where_zips_do(capsys):
    assert isinstance(resolve_expert("itm-recovery"), PPO)
    assert agent_path("itm-recovery") == str(sb3_quad.pretrained_path("itm-recovery"))
    assert agent_path("some/agent.zip") == "some/agent.zip"
    assert main(["enjoy", "itm-recovery", "--no-render", "-n", "50"]) == 0
    assert main(["enjoy", "itm-recovry", "--no-render"]) == 2
    assert "'itm-recovery'" in capsys.readouterr().err
    for wrong in (sb3_quad.pretrained_path, sb3_quad.env_kwargs):
        with pytest.raises(ConfigError, match="'itm-recovery'"):
            wrong("itm-recovry")
    for controller in parse_controllers(["itm-recovery", "mine=itm-recovery"]):
        assert controller.spec == str(sb3_quad.pretrained_path("itm-recovery"))
        assert controller.notice("crazyflie")
    (any_quadcopter,) = parse_controllers(["any-quadcopter"])
    assert not any_quadcopter.notice("crazyflie")


def test_publish_copies_the_policy_and_writes_where_it_comes_from(
    dagger_run, tmp_path, short_cards, capsys
):
    source = dagger_run / "QuadStateRecovery-v0.zip"
    (dagger_run / "QuadStateRecovery-v0" / "command.txt").write_text("typed\n```\nso\n")
    command = [str(source), "--name", "mine", "-o", str(tmp_path), "--episodes", "4"]
    assert publish.main(command) == 0
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    for part in ("# mine", "```bash\ntyped ''' so\n```", "| seed | 3 |", "| state recovery |"):
        assert part in card
    slim, whole = (PPO.load(path, device="cpu") for path in (tmp_path / "mine.zip", source))
    seen = QuadcopterVecEnv(32, task="state_recovery", seed=5).reset()
    expected, _ = whole.predict(seen, deterministic=True)
    np.testing.assert_array_equal(slim.predict(seen, deterministic=True)[0], expected)
    assert (tmp_path / "mine.zip").stat().st_size < 0.5 * source.stat().st_size
    assert publish.main(command) == 2
    assert publish.main([str(tmp_path / "none.zip"), "--name", "x", "-o", str(tmp_path)]) == 2
    assert publish.main([str(source), "--name", "a/b", "-o", str(tmp_path)]) == 2


@pytest.mark.slow
def test_the_robust_one_ends_at_its_target_under_disturbances():
    own = sb3_quad.env_kwargs("itm-robust")
    force = {"magnitude": 27**0.5, "direction": [-1, -1, -1]}  # the thesis's
    worlds = {"mass": [0.8, 1.2], "motor_gain": [0.7, 1.5], "force": {"magnitude": [0, 3]}}
    for randomize, largest in (({"force": force}, 0.04), (worlds, 0.1)):
        agent = sb3_quad.load_pretrained("itm-robust")
        flights = fly(agent, "target_tracking", 60, 32_000_000, **{**own, "randomize": randomize})
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
        96,
        33_000_000,
        max_episode_steps=400,
        **own,
    )
    assert (
        flights.survival.mean() > 0.9
    )  # of ITM, whose rotors do the least; without the layout it would be nearly none


def test_the_keywords_of_an_agent_that_does_not_say_how_it_flies_are_refused(tmp_path):
    PPO("MlpPolicy", sb3_quad.QuadcopterVecEnv(1)).save(tmp_path / "silent.zip")
    with pytest.raises(ConfigError, match=r"silent\.zip: does not say how its agent flies"):
        sb3_quad.env_kwargs(tmp_path / "silent.zip")


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


def test_keywords_of_your_own_replace_those_of_the_agent():
    own = sb3_quad.env_kwargs("any-quadcopter", vehicle="hummingbird", noise=0.0)
    assert "vehicles" not in own and own["vehicle"] == "hummingbird" and own["noise"] == 0.0
    assert "vehicles" in sb3_quad.env_kwargs("any-quadcopter", noise=0.0)
