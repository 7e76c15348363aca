"""Every public callback shows how it is used, and the example does what it says."""

import doctest
import importlib
import re
from pathlib import Path

import pytest
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad import callbacks
from sb3_quad.callbacks.every import EveryTimesteps

ROOT = Path(__file__).resolve().parent.parent


def test_every_callback_is_public():
    modules = [
        f"sb3_quad.callbacks.{path.stem}"
        for path in (ROOT / "callbacks").glob("*.py")
        if path.stem != "__init__"
    ]
    everything = [
        (name, each)
        for module in map(importlib.import_module, modules)
        for name, each in vars(module).items()
    ]
    own = {each for _, each in everything if isinstance(each, type) and each.__module__ in modules}
    found = {
        each.__name__
        for each in own
        if issubclass(each, BaseCallback) and each is not EveryTimesteps
    }
    assert found == set(callbacks.__all__)


@pytest.mark.parametrize("name", callbacks.__all__)
def test_the_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    callback = getattr(callbacks, name)
    (test,) = doctest.DocTestFinder(recurse=False).find(
        callback, name, globs={name: callback, "Path": Path}
    )
    assert [example for example in test.examples if "model.learn(" in example.source], (
        "shows no training"
    )
    assert not [example for example in test.examples if example.options.get(doctest.SKIP)]
    report: list[str] = []
    doctest.DocTestRunner().run(test, out=report.append)
    assert not report, "".join(report)


def test_the_page_lists_every_callback_and_its_settings_are_read():
    from sb3_quad.base.yaml_files import parse_keys
    from sb3_quad.training.algorithms import import_class
    from sb3_quad.training.config import build_config

    page = (ROOT / "docs" / "callbacks.md").read_text(encoding="utf-8")
    assert set(callbacks.__all__) <= set(re.findall(r"^\| `(\w+)`", page, flags=re.MULTILINE))
    blocks = [
        parse_keys(text, "page") for text in re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL)
    ]
    settings = {"n_timesteps": 100, **blocks[0]}
    config = build_config("ppo_bc", "QuadStateRecovery-v0", settings)
    assert config.callback
    for path, keywords in config.callback:
        import_class(path, "callback")(**keywords)
