"""What comes from strangers, zips, run folders and settings, runs nothing of theirs: each would
leave a file named MARK.
"""

import base64
import copy
import io
import json
import os
import pickle
import pickletools
import random
import resource
import sys
import zipfile
from contextlib import suppress
from pathlib import Path

import cloudpickle
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pickles import read_pickle
from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.agents.zips import load_model, load_zip, saved_data
from sb3_quad.algorithms.dagger import DAgger
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.process import trusted
from sb3_quad.cli import main

MARK = Path("foreign_code_ran")
AGENT = pretrained_path("itm-imitation")
COMMAND = f"echo > {MARK}"
SECONDS = 5


class Calls:
    """Calls a function when it is unpickled."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def text(value):
    return b"\x8c" + bytes([len(value)]) + value.encode()


CALLS = pickle.dumps(Calls(os.system, COMMAND))
DOTTED = text("torch") + text("serialization.os.system") + b"\x93" + text(COMMAND) + b"\x85R."
BY_VALUE = cloudpickle.dumps(Calls(eval("lambda name: open(name, 'w')"), str(MARK)))
# Sets an attribute of a class, by which each is taken for a subclass of it.
BUFFER = text("stable_baselines3.common.buffers") + text("RolloutBuffer") + b"\x93"
HOOK = text("__subclasshook__") + text("builtins") + text("bool") + b"\x93"
CHANGES = BUFFER + b"N}" + HOOK + b"s\x86b"

DEEP = b")" + b"\x85" * 200_000
PAIRS = b")" + b"".join(b"\x94h" + bytes([k]) + b"\x86" for k in range(60))
# They would crash Python, never end, or take much memory.
MONSTERS = {
    "a deep key": b"}" + DEEP + b"Ns.",
    "pairs": PAIRS + b".",
    "a key of pairs": b"}" + PAIRS + b"Ns.",
    "itself": b"]\x94h\0a.",
    "many": b"}\x94" * 10**6 + b".",
    "a long array": b"\x96" + (1 << 40).to_bytes(8, "little") + b".",
}


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SB3_QUAD_TRUST", raising=False)
    return tmp_path


def zip_with(changes, source=AGENT, path="foreign.zip"):
    """A copy of an agent's zip, some parts of which, or attributes in whose JSON, are others. An
    attribute in bytes is a pickle.
    """
    with zipfile.ZipFile(source) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(parts["data"])
    for key, value in changes.items():
        if key.endswith(".pth"):
            parts[key] = value
        elif isinstance(value, bytes):
            data[key] = {":type:": "x", ":serialized:": base64.b64encode(value).decode()}
        else:
            data[key] = value
    parts["data"] = json.dumps(data).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return path


def weights(content=b"", compression=0, **tensors):
    """A file of torch.save, whose pickle may be another."""
    plain = io.BytesIO()
    torch.save(tensors, plain)
    changed = io.BytesIO()
    with zipfile.ZipFile(plain) as archive, zipfile.ZipFile(changed, "w", compression) as copied:
        for name in archive.namelist():
            is_pickle = content and name.endswith("/data.pkl")
            copied.writestr(name, content if is_pickle else archive.read(name))
    return changed.getvalue()


def the_line(capsys):
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "warning" not in line)
    return line


def same_actions(*models):
    observation = models[0].observation_space.sample()
    first, second = (model.predict(observation, deterministic=True)[0] for model in models)
    return np.array_equal(first, second)


@pytest.mark.parametrize("content", [CALLS, b"\x80\x04" + DOTTED, BY_VALUE])
def test_a_pickle_that_calls_a_function_is_refused(content):
    with pytest.raises(ConfigError, match=r"its policy_kwargs .*--trust"):
        load_model(zip_with({"policy_kwargs": content}))
    assert not MARK.exists()
    pickle.loads(content)
    # So it does what it is here for.
    assert MARK.exists()


@pytest.mark.parametrize(
    ("command", "key"),
    [
        ("enjoy foreign.zip --no-render -n 1", "action_space"),
        ("export foreign.zip --format c", "observation_space"),
        ("train --algo dagger --expert foreign.zip -n 100 --eval-episodes 0", "vec_normalize"),
        ("train --algo ppo -i foreign.zip -n 100 --eval-episodes 0", "policy.pth"),
    ],
)
def test_no_command_runs_what_a_zip_holds(command, key, capsys):
    zip_with({key: weights(CALLS) if key == "policy.pth" else CALLS})
    assert main(command.split()) != 0
    lines = [line for line in capsys.readouterr().err.splitlines() if f"its {key} " in line]
    assert lines and "--trust" in lines[0]
    assert not MARK.exists()


def test_a_run_folder_that_is_resumed_runs_nothing(capsys, dagger_run):
    model = np.fromfile(zip_with({"anything": CALLS}), np.uint8)
    np.savez(dagger_run / "resume.npz", model=model)
    assert main(["train", "--resume", str(dagger_run)]) == 2
    assert "its anything" in the_line(capsys)
    assert not MARK.exists()


def test_trust_ends_with_the_command_and_has_to_be_meant(monkeypatch):
    export = ["export", zip_with({"observation_space": CALLS}), "--format", "c"]
    main([*export, "--trust"])
    assert MARK.exists()
    MARK.unlink()
    for value in ("false", "no", "0", "", " ", "off", "00", "maybe"):
        monkeypatch.setenv("SB3_QUAD_TRUST", value)
        assert main(export) == 2
    assert not MARK.exists()
    with pytest.raises(ConfigError, match="SB3_QUAD_TRUST='maybe'"):
        trusted()
    for value in ("True", "on"):
        monkeypatch.setenv("SB3_QUAD_TRUST", value)
        assert trusted()


def test_no_class_is_changed():
    """SB3 would set variables wherever their names lead, and Python attributes of a class."""
    before = {kind: dict(vars(kind)) for kind in (RolloutBuffer, ActorCriticPolicy, PPO)}
    variables = weights(**{"policy.action_net.weight.__class__": torch.zeros(1)})
    # PyTorch would read the first of two files in one, zipfile the second.
    two_files = io.BytesIO()
    torch.save({}, two_files, _use_new_zipfile_serialization=False)
    for changes in (
        {"policy_kwargs": b"\x80\x04" + CHANGES + b"."},
        {"pytorch_variables.pth": variables},
        {"pytorch_variables.pth": two_files.getvalue() + weights()},
    ):
        with pytest.raises(ConfigError):
            load_model(zip_with(changes))
    assert {kind: dict(vars(kind)) for kind in before} == before
    assert isinstance(torch.nn.Parameter.data, type(torch.Tensor.data))


def status(job):
    """The exit code of a process that does a job, below 0 the signal that ended it, and how much
    memory it took.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    child = os.fork()
    if child == 0:
        code = 70
        try:
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
            job()
            code = 0
        except ConfigError:
            code = 1
        finally:
            os._exit(code)
    _, ended, usage = os.wait4(child, 0)
    return os.waitstatus_to_exitcode(ended), (usage.ru_maxrss - before) / 1024


@pytest.mark.parametrize("name", MONSTERS)
def test_a_small_zip_that_would_take_long_or_much_is_refused(name):
    load_model(AGENT)
    content = b"\x80\x04" + MONSTERS[name]
    for changes in ({"policy_kwargs": content}, {"policy.pth": weights(content)}):
        foreign = zip_with(changes)
        code, megabytes = status(lambda foreign=foreign: load_model(foreign))
        assert (code, megabytes < 300) == (1, True)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("policy_kwargs", {"net_arch": [20_000] * 3}),
        ("policy_kwargs", {"net_arch": [1] * 10**6}),
        ("policy_kwargs", {"n_critics": 10**9}),
        ("anything", [[]] * 10**6),
        ("policy.pth", weights(compression=8)),
        ("policy.optimizer.pth", weights(a=torch.zeros(1).expand(9_999, 9_999))),
        ("policy.pth", pickle.dumps({})),
    ],
)
def test_a_zip_that_asks_for_more_than_it_holds_is_refused(key, value):
    with pytest.raises(ConfigError, match="foreign"):
        load_model(zip_with({key: value}))


EVENTS = []
sys.addaudithook(lambda event, _: EVENTS.append(event))


def test_damaged_pickles_call_and_import_nothing():
    """Pieces of an agent's pickles, and opcodes that no agent has, in random order."""
    rng = random.Random(0)
    entries = saved_data(AGENT).values()
    encoded = [entry[":serialized:"] for entry in entries if ":serialized:" in str(entry)]
    pieces = [CALLS[2:-1], DOTTED[:-1], CHANGES, b"\x81", b"R", b"b", b"s", b"h\0", b")", b"}"]
    for content in map(base64.b64decode, encoded):
        read_pickle(content)
        places = [place for _, _, place in pickletools.genops(content)]
        for _ in range(60):
            first, after = sorted(rng.choices(places, k=2))
            damaged = content[:first] + rng.choice(pieces) + content[rng.choice((first, after)) :]
            EVENTS.clear()
            with suppress(Exception):
                read_pickle(damaged)
            assert not {"exec", "import", "open", "os.system"} & {*EVENTS}
    assert not MARK.exists()


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3, DDPG])
def test_agents_of_sb3_fly_whatever_their_schedules_are(algorithm):
    kwargs = {"n_steps": 16}
    if algorithm in (SAC, TD3, DDPG):
        noise = NormalActionNoise(np.zeros(1), np.ones(1))
        kwargs = {"buffer_size": 200, "action_noise": noise, "train_freq": (1, "episode")}
    layers = {"net_arch": [8], "activation_fn": torch.nn.ELU, "optimizer_class": torch.optim.SGD}
    model = algorithm(
        "MlpPolicy",
        "Pendulum-v1",
        learning_rate=lambda progress: 1e-3 * progress,
        policy_kwargs=layers,
        **kwargs,
    ).learn(32)
    model.save("agent.zip")
    again = load_model("agent.zip")
    assert isinstance(model, type(again))
    assert same_actions(again, model)
    with pytest.raises(ConfigError, match="its learning_rate"):
        load_zip(algorithm, "agent.zip")
    # All of it, as for going on.
    model.learning_rate = model.lr_schedule = LinearSchedule(1e-3, 0.0, 1.0)
    model.save("agent.zip")
    whole = load_zip(algorithm, "agent.zip", device="cpu")
    assert whole.lr_schedule(0.5) == 5e-4 and whole._last_obs is not None
    assert getattr(whole, "train_freq", 0) == getattr(model, "train_freq", 0)


def test_spaces_of_gym_are_read_as_gymnasium_s():
    """The zips in rl-trained-agents, of 2021."""
    model = load_model(AGENT)
    changes = {}
    for key in ("action_space", "observation_space"):
        space = copy.deepcopy(getattr(model, key))
        space._np_random = Calls(vars(np.random)["_pickle"].__randomstate_ctor, "MT19937")
        content = pickle.dumps(space, protocol=3)
        changes[key] = content.replace(b"gymnasium.spaces", b"gym.spaces")
    ours = load_model(zip_with(changes))
    assert ours.observation_space == model.observation_space
    assert same_actions(ours, model)
    ours.action_space.sample()


def test_a_zip_imports_nothing(monkeypatch):
    """SB3 makes the environment that a zip names, and Gymnasium imports a module that stands before
    its colon.
    """
    Path("foreign_module.py").write_text(f"open({str(MARK)!r}, 'w')")
    monkeypatch.syspath_prepend(".")
    foreign = zip_with({"env": "foreign_module:Foreign-v0", "expert": "foreign_module:factory"})
    assert load_zip(DAgger, foreign, device="cpu").expert is None
    assert load_model(foreign).env is None
    assert not MARK.exists()


@pytest.mark.parametrize(
    "change",
    [
        {"rotor_layout": "fifo.yaml"},
        {"vehicles": "fifo.yaml"},
        {"vehicles": {"distribution": "/dev/zero"}},
        {"vehicle": "fifo.yaml"},
        {"vehicle": {"name": "../outside"}},
        {"vehicle": {"name": "*/ int x; /*"}},
        {"vehicle": {"name": "two\nlines"}},
        {"vehicle": {"name": "two\u2028lines"}},
    ],
)
def test_a_zip_names_no_file_of_this_machine(change):
    # Who opens it waits for ever.
    os.mkfifo("fifo.yaml")
    settings = saved_data(AGENT)["flight_settings"]
    if "name" in change.get("vehicle", ()):
        change = {"vehicle": settings["vehicle"] | change["vehicle"]}
    with pytest.raises(ConfigError, match=r"foreign\.zip: flight_settings: "):
        agent_settings(zip_with({"flight_settings": settings | change}))
    # Such a reference is left out.
    settings["reference"] = {"curve": "file", "file": "fifo.yaml"}
    assert agent_settings(zip_with({"flight_settings": settings}))[0] == agent_settings(AGENT)[0]


@pytest.mark.parametrize(
    ("key", "entry"),
    [
        ("callback", {"os.makedirs": {"name": str(MARK)}}),
        ("env_wrapper", "os.mkdir"),
    ],
)
def test_settings_call_only_classes_of_the_right_kind(key, entry, capsys):
    folder = Path("run/QuadTargetTracking-v0")
    folder.mkdir(parents=True)
    settings = {"n_timesteps": 400, "n_envs": 2, "vec_env": "dummy", key: entry}
    # JSON is YAML, too.
    (folder / "config.yml").write_text(json.dumps(settings))
    (folder / "args.yml").write_text("{algo: dagger, env: QuadTargetTracking-v0}")
    assert main(["train", "--resume", "run"]) == 2
    assert f"config.yml: {key}: " in the_line(capsys)
    assert not MARK.exists()
