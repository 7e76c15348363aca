"""The search for gains: it finds better ones, goes on where it was left, and loses no file."""

import os
import re
import signal
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.cli.commands import tune_expert
from sb3_quad.tuning import expert
from sb3_quad.tuning.expert import ExpertObjective, ExpertSearch, with_gains
from sb3_quad.vehicles.gains import GAIN_NAMES, GeometricGains, GeometricMetrics
from sb3_quad.vehicles.vehicle import VEHICLES, load_vehicle

ITM = load_vehicle("itm")
GAINS = ITM.geometric_gains
ITM_YAML, _ = VEHICLES.text("itm")
SMALL = ["--starts", "120", "--targets", "8"]
positive = st.floats(0.01, 1e3).map(lambda value: float(f"{value:.4g}"))


@pytest.fixture(autouse=True)
def little_to_fly(monkeypatch):
    monkeypatch.setattr(tune_expert, "FRESH_EPISODES", 16)
    monkeypatch.setattr(tune_expert, "FRESH_SETS", 2)
    for name, steps in (("DESCENT", 250), ("WAY", 450), ("RECOVERY", 150)):
        monkeypatch.setattr(expert, name, steps)


@pytest.fixture
def slow_itm(tmp_path):
    """ITM's file, commented as it is, with gains that can be improved on."""
    poor = GAINS.model_copy(update={"position": 0.9 * GAINS.position, "measured": None})
    path = tmp_path / "slow.yaml"
    path.write_text(with_gains(ITM_YAML, poor))
    return path


figures = st.builds(
    GeometricMetrics,
    recovery_survival=st.floats(0, 1),
    recovery_episodes=st.integers(1, 10**6),
    tracking_survival=st.floats(0, 1),
    tracking_episodes=st.integers(1, 10**6),
    time_to_0_1_m=positive,
    tracking_reward=st.floats(-50, 0),
    observation_noise=st.floats(0, 1),
    seeds=st.lists(st.integers(0, 10**9), min_size=1, max_size=5).map(tuple),
)


@given(st.fixed_dictionaries(dict.fromkeys(GAIN_NAMES, positive)), st.none() | figures, st.integers(0, 2))
def test_gains_survive_the_file_and_leave_the_rest_of_it(values, measured, where):
    gains = GeometricGains(**values, measured=measured)
    block = ITM_YAML[ITM_YAML.index("geometric_gains:") :]
    head = ITM_YAML.removesuffix(block)
    other_places = (ITM_YAML, head, block + head)  # at the end, nowhere, at the beginning
    text = with_gains(other_places[where], gains)
    loaded = yaml.safe_load(text)
    assert GeometricGains.model_validate(loaded.pop("geometric_gains")) == gains
    assert loaded == yaml.safe_load(head)
    assert all(line in text for line in head.splitlines())  # comments and all
    assert with_gains(text, gains) == text


def test_gains_in_another_form_are_not_cut_in_half():
    with pytest.raises(ConfigError, match="remove it"):
        with_gains('{"name": "x", "geometric_gains": {"position": 1}}', GAINS)


def test_the_cost_tells_better_gains_from_worse_and_repeats_itself():
    objective = ExpertObjective(ITM, starts=600, targets=16, seed=3)
    good = objective.cost(GAINS)
    assert objective.cost(GAINS) == good
    assert good.lost == 0 and good.settling < 4
    timid = objective.cost(GAINS.model_copy(update={"position": GAINS.position / 2, "height_position": 0.5}))
    careless = objective.cost(GAINS.model_copy(update={"attitude": 1.0}))
    assert timid.settling > good.settling and timid.value > good.value
    assert careless.too_low > good.too_low and careless.value > good.value


@pytest.mark.slow
def test_it_writes_a_vehicle_that_flies_and_goes_on_where_it_was_left(slow_itm, tmp_path, capsys):
    output = tmp_path / "tuned.yaml"
    command = ["tune-expert", "--vehicle", str(slow_itm), "-o", str(output), *SMALL, "--no-progress"]
    assert main([*command, "-n", "3"]) == 0
    assert "3 gains tried" in capsys.readouterr().out
    first = load_vehicle(output).geometric_gains
    assert first is not None and first.measured is not None and first.measured.recovery_episodes == 32
    assert main([*command, "-n", "20", "--overwrite"]) == 0  # on from its own journal
    assert "20 gains tried" in capsys.readouterr().out
    tuned = load_vehicle(output)
    assert tuned.geometric_gains != load_vehicle(slow_itm).geometric_gains
    assert tuned.model_copy(update={"geometric_gains": None}) == ITM.model_copy(update={"geometric_gains": None})
    objective = ExpertObjective(load_vehicle(slow_itm), starts=120, targets=8)
    assert objective.cost(tuned.geometric_gains).value < objective.cost(load_vehicle(slow_itm).geometric_gains).value

    assert main([*command, "-n", "20", "--seed", "1", "--overwrite"]) == 2
    assert "other gains, sizes or seed" in capsys.readouterr().err


@pytest.mark.slow
def test_gains_that_are_worse_on_fresh_episodes_are_not_written(tmp_path, monkeypatch, capsys):
    timid = GAINS.model_copy(update={"position": GAINS.position / 2, "measured": None})
    monkeypatch.setattr(ExpertSearch, "best", timid)  # as if the search's own episodes had been kind to it
    output = tmp_path / "tuned.yaml"
    assert main(["tune-expert", "-o", str(output), *SMALL, "-n", "1", "--no-progress"]) == 0
    printed = capsys.readouterr().out
    written = load_vehicle(output).geometric_gains
    assert written.model_copy(update={"measured": None}) == GAINS.model_copy(update={"measured": None})
    times = re.search(r"mean time to 0.1 m +│ +([\d.]+) s │ +([\d.]+) s", printed)
    assert float(times[1]) == written.measured.time_to_0_1_m < float(times[2]) and "nothing better" in printed


def test_an_interrupt_keeps_the_best(tmp_path, monkeypatch, capsys):
    output = tmp_path / "tuned.yaml"
    original = ExpertObjective.cost

    def interrupted(self, gains):
        if calls.append(gains) or len(calls) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return original(self, gains)

    calls: list[GeometricGains] = []
    monkeypatch.setattr(ExpertObjective, "cost", interrupted)
    assert main(["tune-expert", "-o", str(output), *SMALL, "-n", "50"]) == 130
    assert len(calls) == 2 and "best of 2" in capsys.readouterr().out
    assert load_vehicle(output).geometric_gains.measured is not None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-o", "tuned.txt"], ".yaml"),
        (["-o", "there.yaml"], "there.yaml: exists already"),
        (["--journal", "broken.journal"], "broken.journal"),
    ],
)
def test_mistakes_are_named(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("there.yaml").write_text("mine")
    Path("broken.journal").write_text("not a journal\n")
    assert main(["tune-expert", *SMALL, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert Path("there.yaml").read_text() == "mine"


def test_without_optuna_it_says_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "cmaes", None)
    assert main(["tune-expert", "-o", str(tmp_path / "tuned.yaml"), *SMALL]) == 2
    assert "pip install '.[tune]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
