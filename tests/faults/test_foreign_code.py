"""What comes from strangers, zips, run folders and settings, runs nothing of theirs: each would
leave a file named MARK.
"""

import base64
import copy
import io
import json
import os
import pickle
import zipfile
from pathlib import Path

import cloudpickle
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.buffers import BaseBuffer, RolloutBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.agents.unpickle import unpickle
from sb3_quad.agents.zips import load_model, load_zip
from sb3_quad.algorithms.dagger import DAgger
from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.envs.vehicles.vehicle import load_vehicle

MARK = Path("foreign_code_ran")
AGENT = pretrained_path("itm-imitation")
COMMAND = f"echo > {MARK}"


class Calls:
    """Calls a function when it is unpickled."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


FOREIGN = Calls(os.system, COMMAND)
PICKLES = {
    "os.system": pickle.dumps(FOREIGN),
    "a dotted name": b"\x80\x04"
    + text("torch")
    + text("serialization.os.system")
    + b"\x93"
    + text(COMMAND)
    + b"\x85R.",
    "names from the memo": b"\x80\x04"
    + text("os")
    + b"\x940"
    + text("system")
    + b"\x940h\x00h\x01\x93"
    + text(COMMAND)
    + b"\x85R.",
    "a function by value": cloudpickle.dumps(
        Calls(eval("lambda name: open(name, 'w')"), str(MARK))
    ),
}


def changed(name: str, hook: tuple[str, str]) -> bytes:
    """Sets an attribute of a class, by which each is taken for a subclass of it; then SB3's own
    wrapper of pickles.
    """
    state = b"N}" + text("__subclasshook__") + text(hook[0]) + text(hook[1]) + b"\x93s\x86"
    wrapper = pickle.dumps(CloudpickleWrapper(FOREIGN), 4)[11:]  # without its own PROTO and FRAME
    return (
        b"\x80\x04"
        + text("stable_baselines3.common.buffers")
        + text(name)
        + b"\x93"
        + state
        + b"b0"
        + wrapper
    )


CHANGED = {  # not to be read by pickle here: the change would stay
    "no class of a zip": changed("BaseBuffer", ("builtins", "bool")),
    "a class of zips": changed("RolloutBuffer", ("numpy", "float64")),
}


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SB3_QUAD_TRUST", raising=False)
    return tmp_path


def foreign_zip(
    key: str, source: Path = AGENT, path: str = "foreign.zip", content: bytes = PICKLES["os.system"]
) -> str:
    """A copy of an agent's zip, in which a pickle is put; as an attribute of the model, or as a
    file of weights.
    """
    with zipfile.ZipFile(source) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    if key.endswith(".pth"):
        parts[key] = content
    else:
        data = json.loads(parts["data"])
        data[key] = {":type:": "harmless", ":serialized:": base64.b64encode(content).decode()}
        parts["data"] = json.dumps(data).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return path


def same_actions(*models) -> bool:
    observation = models[0].observation_space.sample()
    first, second = (model.predict(observation, deterministic=True)[0] for model in models)
    return np.array_equal(first, second)


@pytest.mark.parametrize("name", PICKLES)
def test_a_pickle_that_calls_what_no_agent_needs_is_refused(name):
    with pytest.raises(
        ConfigError, match=r"^here names \S+\.\S+, which may run anything; .* --trust"
    ):
        unpickle(base64.b64encode(PICKLES[name]).decode(), "here")
    assert not MARK.exists()
    pickle.loads(PICKLES[name])
    assert MARK.exists()  # so it does what it is here for


@pytest.mark.parametrize("content", CHANGED.values(), ids=CHANGED)
def test_no_class_is_changed(content, capsys, dagger_run):
    with pytest.raises(
        ConfigError,
        match=r"here (names \S+BaseBuffer|is not what Stable-Baselines3 pickles).* --trust",
    ):
        unpickle(base64.b64encode(content).decode(), "here")
    assert (
        main(["enjoy", foreign_zip("policy_kwargs", content=content), "--no-render", "-n", "1"])
        == 2
    )
    foreign_zip("lr_schedule", dagger_run / "QuadStateRecovery-v0.zip", content=content)
    model = np.fromfile("foreign.zip", dtype=np.uint8)
    np.savez(dagger_run / "resume.npz", timesteps=np.array(5), model=model)
    assert main(["train", "--resume", str(dagger_run)]) == 2
    assert len([line for line in capsys.readouterr().err.splitlines() if "--trust" in line]) == 2
    assert not any("__subclasshook__" in vars(kind) for kind in (BaseBuffer, RolloutBuffer))
    assert not MARK.exists()


@pytest.mark.parametrize(
    ("command", "key"),
    [
        ("evaluate foreign.zip --suite quick -n 1 --no-report", "policy_kwargs"),
        pytest.param(
            *(
                "evaluate foreign.zip pid --suite quick -n 1 --no-report --workers 2",
                "policy_kwargs",
            ),
            marks=pytest.mark.slow,
        ),
        ("enjoy foreign.zip --no-render -n 1", "action_space"),
        ("export foreign.zip --format torchscript", "observation_space"),
        ("train --algo dagger --expert foreign.zip -n 100 --eval-episodes 0", "action_space"),
        ("train --algo dagger --expert foreign.zip -n 100 --eval-episodes 0", "policy.pth"),
        ("train --algo ppo -i foreign.zip -n 100 --eval-episodes 0", "policy.pth"),
    ],
)
def test_no_command_runs_what_a_zip_holds(command, key, capsys):
    foreign_zip(key)
    assert main(command.split()) != 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "foreign.zip: " in line]
    assert lines
    for line in lines:
        assert key == "policy.pth" or (
            f"its {key} names posix.system" in line and "--trust" in line
        )
    assert not MARK.exists()


@pytest.mark.parametrize("key", ["learning_rate", "policy_class", "clip_range", "anything"])
def test_a_run_folder_that_is_resumed_runs_nothing(key, capsys, dagger_run):
    content = Path(foreign_zip(key, dagger_run / "QuadStateRecovery-v0.zip")).read_bytes()
    np.savez(
        dagger_run / "resume.npz",
        timesteps=np.array(5),
        model=np.frombuffer(content, dtype=np.uint8),
    )
    assert main(["train", "--resume", str(dagger_run)]) == 2
    assert f"its {key} names posix.system, which may run anything" in capsys.readouterr().err
    assert not MARK.exists()


def test_trust_goes_on_and_ends_with_the_command(capsys):
    export = ["export", foreign_zip("observation_space"), "--format", "torchscript"]
    main([*export, "--trust"])
    assert MARK.exists()
    MARK.unlink()
    assert main(export) == 2
    assert not MARK.exists()


@pytest.mark.parametrize(
    "key", ["learning_rate", "lr_schedule", "clip_range", "ep_info_buffer", "expert"]
)
def test_what_flying_does_not_need_is_not_even_read(key):
    agent, whole = load_model(foreign_zip(key)), load_model(AGENT)
    assert not MARK.exists()
    assert same_actions(agent, whole)


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3, DDPG])
def test_agents_of_sb3_fly_whatever_their_schedules_are(algorithm):
    off_policy = algorithm in (SAC, TD3, DDPG)
    kwargs = {"buffer_size": 200} if off_policy else {"n_steps": 16}
    kwargs |= (
        {"action_noise": NormalActionNoise(np.zeros(1), np.ones(1))}
        if algorithm in (SAC, TD3, DDPG)
        else {}
    )
    kwargs |= {
        "policy_kwargs": {
            "net_arch": [8],
            "activation_fn": torch.nn.ELU,
            "optimizer_class": torch.optim.SGD,
        }
    }
    model = algorithm(
        "MlpPolicy", "Pendulum-v1", learning_rate=lambda progress: 1e-3 * progress, **kwargs
    ).learn(32)
    model.save("agent.zip")
    again = load_model("agent.zip")
    assert type(again) is algorithm
    assert same_actions(again, model)
    with pytest.raises(ConfigError, match=r"its learning_rate names cloudpickle\.cloudpickle\._"):
        load_zip(algorithm, "agent.zip")
    model.learning_rate = model.lr_schedule = LinearSchedule(1e-3, 0.0, 1.0)
    model.save("agent.zip")
    assert (
        load_zip(algorithm, "agent.zip", device="cpu").lr_schedule(0.5) == 5e-4
    )  # all of it, as for going on


@pytest.mark.parametrize(
    ("key", "entry"),
    [
        ("callback", {"os.makedirs": {"name": str(MARK)}}),
        ("callback", {"gymnasium.Wrapper": {"env": 1}}),
        (
            "callback",
            [{"stable_baselines3.common.callbacks.EventCallback": None}, {"pathlib.Path": {}}],
        ),
        ("vec_env_wrapper", {"os.makedirs": {"exist_ok": True}}),
        ("vec_env_wrapper", "builtins.print"),
        ("env_wrapper", "os.mkdir"),
    ],
)
@pytest.mark.parametrize("way", ["a settings file", "a run folder"])
def test_settings_call_only_classes_of_the_right_kind(key, entry, way, capsys):
    environment = "QuadTargetTracking-v0"
    content = {"n_timesteps": 400, "n_envs": 2, "n_steps": 100, "vec_env": "dummy", key: entry}
    file, how = Path("foreign.yml"), ["--conf-file", "foreign.yml", "--algo", "dagger"]
    if way == "a run folder":
        file, how = Path(f"run/{environment}/config.yml"), ["--resume", "run"]
        file.parent.mkdir(parents=True)
        (file.parent / "args.yml").write_text(f"{{algo: dagger, env: {environment}}}")
    else:
        content = {environment: content}
    file.write_text(json.dumps(content))  # which is YAML, too
    assert main(["train", *how]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {file}: {key}: ")
    assert "name a subclass of" in line
    assert not MARK.exists()
    assert not Path("logs").exists()


@pytest.mark.parametrize(
    "name",
    [
        "../outside",
        "a/b",
        "a\\b",
        "*/ int x; /*",
        "<script>",
        "two\nlines",
        "\x1b[2J",
        "",
        "a" * 101,
    ],
)
def test_a_vehicle_s_name_is_a_name(name, capsys, here, monkeypatch):
    own = here / "own"
    own.mkdir()
    monkeypatch.chdir(own)
    parameters = load_vehicle("itm").model_dump(mode="json") | {"name": name}
    Path("foreign.yaml").write_text(json.dumps(parameters))
    assert main(["check-vehicle", "foreign.yaml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: foreign.yaml: name: ")
    with zipfile.ZipFile(AGENT) as archive, zipfile.ZipFile("foreign.zip", "w") as copy:
        data = json.loads(archive.read("data"))
        data["flight_settings"]["vehicle"]["name"] = name
        copy.writestr("data", json.dumps(data))
    with pytest.raises(ConfigError, match=r"foreign\.zip: flight_settings: name: "):
        agent_settings("foreign.zip")
    assert sorted(path.name for path in here.rglob("*")) == ["foreign.yaml", "foreign.zip", "own"]


def zip_with(changes: dict) -> str:
    """A copy of an agent's zip, some attributes of whose JSON are others."""
    with zipfile.ZipFile(AGENT) as archive, zipfile.ZipFile("foreign.zip", "w") as copy:
        for name in archive.namelist():
            content = archive.read(name)
            copy.writestr(
                name, json.dumps(json.loads(content) | changes) if name == "data" else content
            )
    return "foreign.zip"


@pytest.mark.parametrize("source", ["/dev/zero", "fifo.yaml", "./fifo"])
@pytest.mark.parametrize("key", ["rotor_layout", "vehicles", "vehicles.distribution", "vehicle"])
def test_a_zip_opens_no_file_of_this_machine(key, source, capsys):
    os.mkfifo("fifo.yaml")  # who opens it waits for ever
    settings = agent_settings(AGENT)[0].model_dump(mode="json")
    name, _, inner = key.partition(".")
    foreign = zip_with({"flight_settings": settings | {name: {inner: source} if inner else source}})
    assert main(["enjoy", foreign, "--no-render", "-n", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        "error: foreign.zip: flight_settings: " + (f"{name}: " if name != "vehicle" else "")
    )


@pytest.mark.parametrize("source", ["fifo.csv", {"curve": "file", "file": "/dev/zero"}])
def test_a_zip_flies_without_the_file_of_its_reference(source):
    """Older versions wrote its path."""
    os.mkfifo("fifo.csv")
    settings = agent_settings(AGENT)[0].model_dump(mode="json")
    foreign = zip_with({"flight_settings": settings | {"reference": source}})
    assert agent_settings(foreign)[0] == agent_settings(AGENT)[0]
    named = zip_with({"flight_settings": settings | {"reference": "circle"}})
    assert agent_settings(named)[0].reference.curve == "circle"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ([], "flight_settings: must be a mapping"),
        (None, "flight_settings: must be a mapping"),
        ({"observation_std": [1e-320] * 18}, "observation_std: every value must be from 1e-6"),
        ({"observation_mean": [1e30] * 18}, "observation_mean: every value must be from -1e6"),
    ],
)
def test_settings_that_no_flight_can_have_are_refused(changes, says, capsys):
    settings = agent_settings(AGENT)[0].model_dump(mode="json")
    foreign = zip_with({"flight_settings": changes and settings | changes})
    assert main(["enjoy", foreign, "--no-render", "-n", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line


def test_spaces_of_gym_are_read_as_gymnasium_s():
    """The zips in rl-trained-agents, of 2021."""
    model, foreign = load_model(AGENT), AGENT
    for key in ("action_space", "observation_space"):
        space = copy.deepcopy(getattr(model, key))
        space._np_random = Calls(vars(np.random)["_pickle"].__randomstate_ctor, "MT19937")
        content = pickle.dumps(space, protocol=3).replace(b"gymnasium.spaces", b"gym.spaces")
        foreign = foreign_zip(key, foreign, f"{key}.zip", content)
    ours = load_model(foreign)
    assert ours.observation_space == model.observation_space
    assert same_actions(ours, model)
    ours.action_space.sample()


def test_a_zip_names_what_comes_with_the_package():
    settings = agent_settings(AGENT)[0].model_dump(mode="json")
    named = {"rotor_layout": "itm", "vehicles": {"distribution": "raptor"}}
    assert agent_settings(zip_with({"flight_settings": settings | named}))[0].rotor_layout == "itm"


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


def weights(content: bytes = b"", compression: int = 0, tensor: object = None) -> bytes:
    """A file of torch.save, whose pickle may be another."""
    plain, changed = io.BytesIO(), io.BytesIO()
    torch.save({"a": tensor}, plain)
    with zipfile.ZipFile(plain) as archive, zipfile.ZipFile(changed, "w", compression) as copied:
        for name in archive.namelist():
            is_pickle = content and name.endswith("/data.pkl")
            copied.writestr(name, content if is_pickle else archive.read(name))
    return changed.getvalue()


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("policy_kwargs", {"net_arch": [20_000] * 3}, r"asks for 1,\d+,\d+,\d+ parameters"),
        ("policy_kwargs", {"net_arch": [1] * 10**6}, "too many values"),
        ("policy_kwargs", {"n_critics": 10**9}, "more than 100 critics"),
        ("policy.pth", weights(b"}" + b")" + b"\x85" * 300_000 + b"Ns."), r"policy.pth .* .a key"),
        ("policy.pth", weights(compression=8), "its policy.pth: is compressed"),
        ("policy.optimizer.pth", weights(tensor=torch.zeros(1).expand(9_999, 9_999)), "a tensor"),
        ("policy.pth", b"\x80\x02K\x01.", "not what PyTorch saves since 1.6"),
    ],
)
def test_a_small_zip_that_would_take_much_memory_or_time_is_refused(key, value, says):
    is_part = isinstance(value, bytes)
    with pytest.raises(ConfigError, match=says):
        load_model(foreign_zip(key, content=value) if is_part else zip_with({key: value}))


def test_a_zip_that_unpacks_to_more_than_itself_is_refused(capsys):
    with zipfile.ZipFile("foreign.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", b" " * 10**8)
    assert main(["enjoy", "foreign.zip", "--no-render"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "model foreign.zip: is compressed, as no zip of SB3 is; pack it with zip -0" in line


def test_weights_are_put_only_where_algorithms_have_some():
    """SB3 writes what is beside the weights wherever its name leads, as to a class of its own."""
    buffer = io.BytesIO()
    torch.save({"policy_class": torch.zeros(1)}, buffer)
    with pytest.raises(ConfigError, match="holds variables that no algorithm has"):
        load_model(foreign_zip("pytorch_variables.pth", content=buffer.getvalue()))
    assert not hasattr(ActorCriticPolicy, "data")
