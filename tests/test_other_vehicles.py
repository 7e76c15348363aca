"""Training, flying and evaluating a vehicle that is not the default one: by name, or by the file of
a user's own.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_pipeline import TINY

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.training.config import load_config

ROOT = Path(__file__).resolve().parent.parent
ENV = "QuadStateRecovery-v0"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A user's folder with a vehicle and a small pipeline in it."""
    folder = tmp_path / "here"
    folder.mkdir()
    data = load_vehicle("crazyflie").model_dump(mode="json", exclude={"geometric_gains"})
    (folder / "my.yaml").write_text(yaml.safe_dump({**data, "name": "my", "mass": 0.03}))
    stages = [
        {
            "name": name,
            "algo": algo,
            "env": ENV,
            "conf_file": f"nominal/{algo}.yml",
            "pass_on": "last",
            "correct_offset": 1.0,
            "settings": {**TINY, "expert": "geometric"},
        }
        for name, algo in (("one", "dagger"), ("two", "ppo_bc"))
    ]
    stages[1]["settings"] = {**stages[1]["settings"], "n_epochs": 1}
    (folder / "stages.yml").write_text(yaml.safe_dump({"stages": stages}))
    monkeypatch.chdir(folder)
    # Agents that have hardly learnt crash on the way.
    monkeypatch.setattr(
        "sb3_quad.evaluation.offset_correction.hover_offset", lambda *_, **__: np.zeros(3)
    )
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["my.yaml", "hummingbird"])
def test_both_stages_are_trained_and_their_agents_flown_from_anywhere(
    vehicle, here, tmp_path, monkeypatch
):
    command = f"train --conf-file stages.yml --env-kwargs vehicle:{vehicle} --eval-episodes 0"
    assert main([*command.split(), "-f", str(here / "logs")]) == 0
    settings = yaml.safe_load(
        (here / "logs" / "ppo_bc" / f"{ENV}_1" / ENV / "config.yml").read_text()
    )
    flown = load_vehicle(settings["env_kwargs"]["vehicle"])
    assert flown == load_vehicle(vehicle)
    (stage,) = yaml.safe_load(
        next((here / "logs" / "stages").rglob("stage_0.yml")).read_text()
    ).values()
    assert load_vehicle(stage["env_kwargs"]["vehicle"]) == flown

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    command = ["enjoy", "--algo", "ppo_bc", "--env", ENV, "-f", str(here / "logs")]
    assert main([*command, "--no-render", "-n", "20"]) == 0


def test_the_file_that_the_documentation_writes_flies(here):
    text = (ROOT / "docs" / "vehicles.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(.*?)```", text, flags=re.DOTALL)
    (here / "mine.yaml").write_text(block)
    assert main(["check-vehicle", "mine.yaml", "-n", "12"]) == 0


@pytest.mark.parametrize("name", ["five_inch", "my_quadcopter"])
def test_the_files_of_the_examples_fly(name):
    assert main(["check-vehicle", str(ROOT / "examples" / f"{name}.yaml"), "-n", "12"]) == 0


def test_the_path_of_a_vehicle_is_kept_whole_and_a_name_is_a_name(here):
    config = load_config("dagger", ENV, None, {"env_kwargs": {"vehicle": "my.yaml"}})
    assert config.env_kwargs["vehicle"] == str(here / "my.yaml")
    (here / "itm").write_text("a file that only happens to be called so")
    config = load_config("dagger", ENV, None, {"env_kwargs": {"vehicle": "itm"}})
    assert config.env_kwargs["vehicle"] == "itm"


def test_a_suite_flown_by_another_vehicle(here):
    command = "evaluate pid geometric --suite quick --scenario tracking -n 4 --no-report"
    command = [*command.split(), "-o", "out"]
    assert main([*command, "--vehicle", "my.yaml"]) == 0
    (scenario,) = json.loads((here / "out" / "results.json").read_text())["scenarios"]
    assert scenario["vehicle"] == load_vehicle("my.yaml").model_dump(mode="json")
    assert scenario["published"] == {}
    # Other flights of the same name
    assert main([*command, "--vehicle", "hummingbird"]) == 2


def test_a_scenario_that_a_vehicle_cannot_fly_is_named(here):
    data = yaml.safe_load((here / "my.yaml").read_text())
    (here / "huge.yaml").write_text(yaml.safe_dump({**data, "collision_radius": 16.0}))
    with pytest.raises(ConfigError, match="tracking"):
        load_suite("quick").with_changes(vehicle="huge.yaml")
