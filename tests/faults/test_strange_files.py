"""Files that never end, are larger than they say, or lie behind a link: each is refused at once, in
one line, and nothing is written elsewhere.
"""

import errno
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import yaml

from sb3_quad.algorithms.buffers import AggregatedDataset
from sb3_quad.base import files
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import read_arrays, read_text, refuse_outside, write_text
from sb3_quad.base.yaml_files import LONGEST, parse_keys
from sb3_quad.callbacks.every import EpisodeLog
from sb3_quad.cli import main
from sb3_quad.envs.simulation.motions import LARGEST_TABLE, read_points
from sb3_quad.envs.simulation.vehicle_distribution import DISTRIBUTIONS
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.evaluate import _flown_before
from sb3_quad.evaluation.results import load_results
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.training.config import SETTINGS, TrainingJob, build_config
from sb3_quad.training.runs import refuse_elsewhere

READERS = {
    "vehicle": load_vehicle,
    "distribution": DISTRIBUTIONS.read,
    "suite": load_suite,
    "settings": lambda path: SETTINGS.read(Path(path)),
    "reference": lambda path: read_points(Path(path)),
    "demonstrations": AggregatedDataset(8, (2,), 1).load,
    "arrays": read_arrays,
}
MOST_SECONDS = 20


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    def late(number, frame):
        raise TimeoutError("a file is read for too long")

    monkeypatch.chdir(tmp_path)
    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(MOST_SECONDS)
    yield tmp_path
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def link(path):
    path.symlink_to("/dev/zero")


def hole(path):
    """A file that says 20 GB and takes no room."""
    path.touch()
    os.truncate(path, 20 * 2**30)


@pytest.mark.parametrize("make", [os.mkfifo, link, os.mkdir, hole])
@pytest.mark.parametrize("name", READERS)
def test_what_never_ends_is_refused_before_it_is_read(name, make):
    path = Path("evaluations.npz")
    make(path)
    with pytest.raises(ConfigError, match=r"evaluations\.npz: ") as raised:
        READERS[name](str(path))
    assert "\n" not in str(raised.value)


def test_a_file_of_linux_without_a_size_is_empty():
    assert read_text("/proc/self/maps" if Path("/proc/self/maps").is_file() else os.devnull) == ""


@pytest.mark.parametrize(
    "text",
    [
        "a: [" + "1," * LONGEST,
        "a: " + "[" * (LONGEST - 9),
        "".join(f"a{number}: 1\n" for number in range(LONGEST // 10)) + "a7: 2",
        "? " * (LONGEST // 3),
        "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 60)),
    ],
    ids=["long", "deep", "a key twice among many", "keys of keys", "aliases"],
)
def test_a_text_that_would_take_long_is_refused(text):
    with pytest.raises(ConfigError, match="a file: ") as raised:
        parse_keys(text, "a file")
    assert len(str(raised.value)) < 500


@pytest.mark.parametrize("part", ["1,", '{"a":{}},'])
def test_results_of_many_faults_are_one_short_line(part):
    value = f"[{part * 10**5}1]"
    Path("results.json").write_text(f'{{"scenarios": {value}, "entries": {value}}}')
    with pytest.raises(ConfigError, match=r"results\.json: ") as raised:
        load_results(".")
    assert len(str(raised.value)) < 2000


@pytest.mark.parametrize(
    "content",
    [
        b"t,x,y,z" + b",a" * 10**6 + b"\n",
        b"t,x,y,z\n0,0,0,0\n" + b"1," * 10**6 + b"\n",
        b"t,x,y,z\n0,0,0,0\n" + b"1,0,0,0\n" * (LARGEST_TABLE // 8),
        b"t,x,x,z\n0,0,0,0\n1,0,0,0\n",
    ],
    ids=["columns", "a long row", "rows", "a column twice"],
)
def test_a_table_that_would_take_much_is_refused(content):
    Path("curve.csv").write_bytes(content)
    with pytest.raises(ConfigError, match=r"curve\.csv: "):
        read_points(Path("curve.csv"))


def test_arrays_may_not_take_far_more_than_their_file(monkeypatch):
    monkeypatch.setattr(files, "LARGEST_ARRAYS", 10**5)
    np.savez_compressed("small.npz", a=np.zeros(10**4))
    np.savez("large.npz", a=np.zeros(10**6))
    np.savez_compressed("bomb.npz", a=np.zeros(10**6))
    for name in ("small", "large"):
        assert not read_arrays(f"{name}.npz")["a"].any()
    with pytest.raises(ConfigError, match=r"bomb\.npz: .*8,000,128 bytes"):
        read_arrays("bomb.npz")


def test_a_temporary_file_is_not_written_through_a_link():
    Path("victim").write_text("kept")
    Path(f".new.{os.getpid()}.tmp").symlink_to("victim")
    write_text("new", "content")
    assert Path("victim").read_text() == "kept"
    assert Path("new").read_text() == "content" and not Path("new").is_symlink()
    assert {path.name for path in Path().iterdir()} == {"victim", "new"}


@pytest.mark.parametrize("path", ["/etc/x", "../x", "run/link/x", "a\0b", "run/itself/x"])
def test_a_path_out_of_a_folder_is_refused(path):
    Path("run").mkdir()
    Path("run/link").symlink_to("/tmp")
    Path("run/itself").symlink_to("itself")
    refuse_outside("run/sub/../model.zip", "here", Path("run"))
    with pytest.raises(ConfigError, match="here: "):
        refuse_outside(path, "here", Path("run"))


@pytest.mark.parametrize(
    ("key", "name", "keyword"),
    [
        ("callback", "stable_baselines3.common.callbacks.CheckpointCallback", "save_path"),
        ("env_wrapper", "stable_baselines3.common.monitor.Monitor", "filename"),
        ("vec_env_wrapper", "stable_baselines3.common.vec_env.VecMonitor", "filename"),
    ],
)
def test_a_run_that_is_resumed_names_no_place_elsewhere(key, name, keyword, monkeypatch):
    def check(path):
        settings = {"n_timesteps": 10, "vec_env": "dummy", key: {name: {keyword: path}}}
        config = build_config("ppo", "QuadTargetTracking-v0", settings)
        refuse_elsewhere(TrainingJob(config=config), "config.yml", Path("logs"), {})

    check("logs/here")
    with pytest.raises(ConfigError, match=r"config\.yml: .*/etc/there is outside of"):
        check("/etc/there")
    monkeypatch.setenv("SB3_QUAD_TRUST", "1")
    check("/etc/there")


@pytest.mark.parametrize("line", ["1,2", "text", "1,2,nan", "1,2,1e300", "1,2,-5", "\x00,,"])
def test_a_damaged_log_of_episodes_is_named(line):
    Path("0.monitor.csv").write_text(f'#{{"t_start": 0}}\nr,l,t,is_success\n1,2,3,True\n{line}\n')
    with pytest.raises(ConfigError, match=r"0\.monitor\.csv: ") as raised:
        EpisodeLog("0.monitor.csv")._on_training_start()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["flights", "flights/pid", "figures"])
def test_results_are_not_written_through_links(here, name):
    (here / "elsewhere").mkdir()
    (here / "out" / name).parent.mkdir(parents=True)
    (here / "out" / name).symlink_to(here / "elsewhere")
    with pytest.raises(ConfigError, match=name):
        _flown_before(here / "out", None)


def test_a_removed_folder_and_too_little_memory_are_named(monkeypatch, capsys):
    def removed():
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    with monkeypatch.context() as patched:
        patched.setattr(os, "getcwd", removed)
        assert main(["check-vehicle", "itm"]) == 2
    assert "current folder was removed" in capsys.readouterr().err


def test_a_bomb_of_scenarios_names_a_few_keys():
    suite = {"name": "many", "scenarios": [1] * 2_000}
    Path("many.yaml").write_text(yaml.safe_dump(suite, default_flow_style=True))
    with pytest.raises(ConfigError, match="scenarios") as raised:
        load_suite("many.yaml")
    assert len(str(raised.value)) < 5000
