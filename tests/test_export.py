"""Exported policies compute what the trained ones do, in physical units, and fly without this
package.
"""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hovering import teach_to_hover
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import A2C, PPO, SAC, TD3

from sb3_quad import DAgger
from sb3_quad.base.errors import ConfigError, ExportError
from sb3_quad.cli import main
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import X
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.export import c_header
from sb3_quad.export.check import TrainedPolicy, features_of
from sb3_quad.export.load import FLAGS, load_header, load_onnx
from sb3_quad.export.network import Network, build_network
from sb3_quad.export.policy import export_policy

ITM = load_vehicle("itm")
DOCS = (Path(__file__).resolve().parent.parent / "docs" / "export.md").read_text(encoding="utf-8")
MODELS = {
    "tanh": (PPO, {"net_arch": [16, 12]}),
    "relu": (A2C, {"net_arch": {"pi": [24], "vf": [8]}, "activation_fn": torch.nn.ReLU}),
    "squashed": (A2C, {"net_arch": [], "squash_output": True}),
    "sac": (SAC, {"net_arch": {"pi": [16, 12], "qf": [8]}, "activation_fn": torch.nn.Tanh}),
    "td3": (TD3, {"net_arch": [16]}),
}
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler here")


def untrained(kind, env):
    algorithm, kwargs = MODELS[kind]
    further = (
        {"use_sde": True}
        if kind == "squashed"
        else {"buffer_size": 10}
        if algorithm in (SAC, TD3)
        else {}
    )
    model = algorithm("MlpPolicy", env, policy_kwargs=kwargs, seed=1, device="cpu", **further)
    last = {"sac": lambda: model.actor.mu, "td3": lambda: model.actor.mu[-2]}.get(
        kind, lambda: model.policy.action_net
    )()
    with (
        torch.no_grad()
    ):  # SB3 starts near zero, where neither order of rotors nor clipping would show
        last.weight *= 8.0 if algorithm in (SAC, TD3) else 80.0
        last.bias.copy_(torch.tensor([0.3, -0.2, 0.1, 0.0]))
    return model


@pytest.fixture(scope="module")
def zips(tmp_path_factory):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("models")
    for kind in MODELS:
        model = untrained(kind, QuadcopterVecEnv(2, seed=0))
        FlightSettings().write_into(model)
        model.save(folder / f"{kind}.zip")
    return folder


def physical_features(state):
    """The 18 features of the true state, (n, 18), float32, as docs/export.md lists them."""
    to_body = state.rotation.transpose(0, 2, 1)
    velocity = np.einsum("nij,nj->ni", to_body, state.velocity)
    parts = (state.position - state.target, to_body.reshape(-1, 9), velocity, state.body_rates)
    return np.concatenate(parts, axis=1).astype(np.float32)


@pytest.fixture(scope="module")
def flight():
    """What an environment shows of random states, and the same in physical units, worked out from
    the true state.
    """
    env = QuadcopterVecEnv(300, "recovery_and_tracking", noise=0.0, seed=7)
    return env.reset(), physical_features(env.true_state())


SEES = {"history": [0, 1, 2, 5], "last_action": True, "position_integral": {"gain": 2.0}}


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """The zip of a policy that hovers, by the weights of one that came with the package, and reacts
    to all that it sees.
    """
    path = tmp_path_factory.mktemp("extended") / "all.zip"
    torch.manual_seed(0)
    env = QuadcopterVecEnv(1, seed=0, **SEES)
    model = PPO("MlpPolicy", env, policy_kwargs={"net_arch": [64, 64]}, device="cpu")
    teach_to_hover(model, std=0.02)
    FlightSettings(**SEES).write_into(model)
    model.save(path)
    return path


compiled = [needs_compiler, pytest.mark.slow]


def load(file_format, exported, name):
    """The file as a function of observations and states, by what its users run it with."""
    size = int(exported.metadata.get("state_size", 0))
    if file_format == "c":
        return load_header(exported.content, size, name)[0]
    pytest.importorskip("onnxruntime")
    return load_onnx(exported.content, size)[0]


@pytest.mark.parametrize(
    ("file_format", "output"), [("onnx", "speeds"), pytest.param("c", "thrusts", marks=compiled)]
)
def test_it_sees_the_frames_of_the_environment_in_whole_flights(extended, file_format, output):
    exported = export_policy(extended, file_format, output, n_observations=3000)
    file = load(file_format, exported, "all")
    policy = PPO.load(extended, device="cpu")
    near = {"target_distance": 1.5, "nearest_target": 0.3}
    env = QuadcopterVecEnv(4, task_kwargs=near, noise=0.0, seed=5, max_episode_steps=500, **SEES)
    seen, state, integrated = env.reset(), None, 0
    for step in range(499):  # the file flies
        result, state = file(physical_features(env.true_state()), state)
        actions = policy.predict(seen, deterministic=True)[0]
        thrusts = result if output == "thrusts" else ITM.thrust_coefficient * result**2
        expected = ITM.action_to_thrust(actions)
        np.testing.assert_allclose(thrusts, expected, atol=1e-4, err_msg=f"step {step}")
        seen, _, ends, _ = env.step(ITM.thrust_to_action(thrusts.astype(float)))
        integrated = max(integrated, np.abs(env.batch.integral).max())
        assert not ends.any()
    assert integrated > 0.05


WRONG_STATES = {
    "no action": lambda state: torch.cat([state[:, :4] * 0, state[:, 4:]], 1),
    "no integral": lambda state: torch.cat([state[:, :4], state[:, 4:7] * 0, state[:, 7:]], 1),
    "older frames": lambda state: torch.cat([state[:, :8], state[:, 8:].roll(22, 1)], 1),
}


@pytest.mark.parametrize("wrong", WRONG_STATES)
def test_a_file_with_another_state_is_refused(extended, monkeypatch, wrong):
    forward = Network.forward

    def with_wrong_state(self, observation, state):
        return forward(self, observation, WRONG_STATES[wrong](state))

    monkeypatch.setattr(Network, "forward", with_wrong_state)
    with pytest.raises(ExportError, match="differs"):
        export_policy(extended, "onnx", n_observations=3000)


FOLLOWS = {
    "task": "target_tracking",
    "noise": 0.0,
    "preview": [0, 5],
    "reference": {"curve": "figure_eight", "heading": 0.4, "heading_rate": 1.5},
    "history": [0, 2],
    "last_action": True,
    "position_integral": {},
}


def test_features_are_those_of_the_true_state_with_and_without_the_reference():
    """Against the formulas of docs/export.md, row by row."""
    env = QuadcopterVecEnv(20, **FOLLOWS, seed=3)
    model = untrained("tanh", env)
    trained = TrainedPolicy(model, FlightSettings().with_changes(**FOLLOWS), ITM)
    observation = env.reset()
    for _ in range(30):
        observation, *_ = env.step(np.zeros((20, 4), np.float32))
    truth = env.true_state()
    table = env.batch.tracks
    # The reference of every row is where it is after 30 steps, and in 5 more.
    ahead = np.tile(np.concatenate([table[30, 6:9], table[35, 6:9]]), (20, 1))
    world = np.hstack([physical_features(truth), ahead])
    np.testing.assert_allclose(features_of(trained, observation, truth, True), world, atol=1e-4)
    related = features_of(trained, observation, truth, False)
    rates = truth.array[X.target_heading_rate]
    for row, (c, s) in enumerate(truth.target_heading):
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        to_body = world[row, 3:12].reshape(3, 3)
        expected = [
            turn @ world[row, :3],
            (to_body @ turn.T).ravel(),
            world[row, 12:15] - to_body @ truth.target_velocity[row],
            world[row, 15:18] - rates[row] * to_body[:, 2],
            turn @ ahead[row, :3],
            turn @ ahead[row, 3:],
        ]
        np.testing.assert_allclose(related[row], np.concatenate(expected), atol=1e-4)
    assert np.abs(truth.target_velocity).max() > 0.5


@pytest.mark.parametrize("file_format", ["onnx", pytest.param("c", marks=compiled)])
def test_it_follows_a_reference_that_it_previews(tmp_path, file_format):
    model = untrained("tanh", QuadcopterVecEnv(2, **FOLLOWS, seed=3))
    FlightSettings().with_changes(**FOLLOWS).write_into(model)
    model.save(tmp_path / "agent.zip")
    exported = export_policy(tmp_path / "agent.zip", file_format, n_observations=2000)
    assert exported.max_error < 1e-3
    assert "21-23 acceleration of the reference" in exported.metadata["observation"]


@pytest.mark.parametrize(
    ("file_format", "kind"),
    [
        *(("onnx", kind) for kind in MODELS),
        pytest.param("c", "tanh", marks=needs_compiler),
        *(pytest.param("c", kind, marks=compiled) for kind in MODELS if kind != "tanh"),
    ],
)
def test_it_gives_the_thrusts_of_the_policy(zips, flight, file_format, kind):
    path = zips / f"{kind}.zip"
    scaled, physical = flight
    exported = export_policy(path, file_format, n_observations=200)
    actions = MODELS[kind][0].load(path, device="cpu").predict(scaled, deterministic=True)[0]
    expected = ITM.hover_thrust * (1.0 + 0.5 * actions)  # Eq. 3.18
    assert expected.std(axis=0).min() > 0.3  # all rotors at work
    np.testing.assert_allclose(
        load(file_format, exported, kind)(physical, None)[0], expected, atol=1e-4
    )
    assert 0 <= exported.max_error < 1e-4
    assert f"{exported.max_error:.2g} N in " in exported.metadata["check"]


@needs_compiler
@pytest.mark.parametrize("wrong", ["x - s * y", "observation[12 + i] += ", "15 + i] += "])
def test_a_header_that_relates_otherwise_is_refused(zips, monkeypatch, wrong):
    write = c_header.render

    def render(*arguments, **words):
        text = write(*arguments, **words)
        return text.replace(wrong.replace("-", "+").replace("+=", "-="), wrong)

    monkeypatch.setattr(c_header, "render", render)
    with pytest.raises(ExportError, match="differs from the trained one"):
        export_policy(zips / "tanh.zip", "c", n_observations=200)


def test_a_file_that_computes_something_else_is_not_written(zips, tmp_path, capsys, monkeypatch):
    forward = Network.forward
    monkeypatch.setattr(Network, "forward", lambda self, *given: 1.001 * forward(self, *given))
    out = str(tmp_path / "agent.onnx")
    assert main(["export", str(zips / "tanh.zip"), "--format", "onnx", "-o", out]) == 2
    error = capsys.readouterr().err
    assert "differs" in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_run_folder_gives_vehicle_and_scaling(tmp_path):
    folder = tmp_path / "run" / "Env-v0"
    folder.mkdir(parents=True)
    path = folder.parent / "agent.zip"
    untrained("tanh", QuadcopterVecEnv(2, seed=0)).save(path)
    given = {"vehicle": "crazyflie", "observation_mean": [0.5] * 18, "observation_std": [2.0] * 18}
    (folder / "config.yml").write_text(json.dumps({"env_kwargs": given}))
    exported = export_policy(path, "onnx", n_observations=100)
    assert exported.settings.name == "config.yml"
    assert exported.metadata["vehicle"].startswith("crazyflie")
    assert "mean 0.5, 0.5, " in exported.metadata["scaling"]
    assert "std 2, 2, " in exported.metadata["scaling"]
    assert str(tmp_path) not in json.dumps(exported.metadata)


def test_speeds_give_the_thrusts_and_a_rotor_may_stand_still(zips, flight):
    vehicle = ITM.model_copy(update={"thrust_limits": (0.0, 1.9)})
    results = {}
    for output in ("thrusts", "speeds"):
        exported = export_policy(zips / "tanh.zip", "onnx", output, vehicle, n_observations=200)
        results[output], _ = load("onnx", exported, "tanh")(flight[1], None)
    assert exported.unit == "rad/s" and results["thrusts"].min() == 0.0
    squares = vehicle.thrust_coefficient * results["speeds"] ** 2
    np.testing.assert_allclose(squares, results["thrusts"], atol=1e-5)


@needs_compiler
def test_a_header_that_does_not_compile_is_refused(zips, monkeypatch):
    monkeypatch.setattr(c_header, "_comment", lambda metadata: ["*/ float unused;; /*"])
    with pytest.raises(ExportError, match="cannot be checked"):
        export_policy(zips / "tanh.zip", "c", n_observations=100)


def test_an_onnx_model_takes_a_state_and_gives_the_next(extended):
    onnx = pytest.importorskip("onnx")
    exported = export_policy(extended, "onnx", n_observations=1000)
    graph = onnx.load_from_string(exported.content).graph
    ports = [
        (each.name, *each.type.tensor_type.shape.dim) for each in (*graph.input, *graph.output)
    ]
    size = 4 + 4 + 5 * 22  # the last action, the integral, five frames
    assert [(name, first.dim_param, second.dim_value) for name, first, second in ports] == [
        ("observation", "batch", 18),
        ("state", "batch", size),
        ("thrust", "batch", 4),
        ("next_state", "batch", size),
    ]
    assert (
        exported.metadata["state_size"] == str(size)
        and "history [0, 1, 2, 5]" in exported.metadata["state"]
    )
    assert exported.metadata["observation"].startswith("18 numbers") and exported.metadata[
        "network"
    ].startswith("88-64")


def test_an_agent_behind_a_wrapper_is_not_exported_without_it(tmp_path):
    path = tmp_path / "agent.zip"
    env = gymnasium.make("QuadTargetTracking-v0", vehicle="crazyflie")
    wrapped = gymnasium.wrappers.NormalizeObservation(env)
    model = DAgger("MlpPolicy", wrapped, expert="pid", n_steps=8, gradient_steps=1, device="cpu")
    model.learn(8).save(path)
    for vehicle in (None, "crazyflie"):
        with pytest.raises(ConfigError, match="NormalizeObservation"):
            export_policy(path, "onnx", vehicle=vehicle, n_observations=100)


def test_an_agent_that_does_not_say_its_vehicle_needs_one(tmp_path):
    path = tmp_path / "agent.zip"
    PPO("MlpPolicy", gymnasium.make("QuadTargetTracking-v0", vehicle="crazyflie")).save(path)
    with pytest.raises(ConfigError, match="does not say how its agent flies; if no wrapper"):
        export_policy(path, "onnx", n_observations=100)
    exported = export_policy(path, "onnx", vehicle="crazyflie", n_observations=100)
    assert exported.metadata["vehicle"].startswith("crazyflie")


@given(st.text(max_size=200))
def test_any_file_name_makes_a_c_name_and_a_comment(text):
    assert re.fullmatch("[A-Za-z][A-Za-z0-9_]*", c_header.c_name(text))
    comment = "\n".join(c_header._comment({"policy": text}))
    assert comment.isascii() and "*/" not in comment and "/*" not in comment


class Stub(gymnasium.Env):
    """Spaces without a flight."""

    def __init__(self, observations, actions):
        self.observation_space, self.action_space = observations, actions


SEEN, DONE = spaces.Box(-np.inf, np.inf, (18,), np.float32), spaces.Box(-1.0, 1.0, (4,), np.float32)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PPO("MlpPolicy", Stub(spaces.Box(-1, 1, (3,)), DONE), device="cpu"), "of shape"),
        (
            lambda: PPO("MlpPolicy", Stub(SEEN, spaces.Box(-2, 2, (4,))), device="cpu"),
            "actions are",
        ),
        (
            lambda: PPO(
                "MlpPolicy",
                Stub(SEEN, DONE),
                policy_kwargs={"activation_fn": torch.nn.ELU},
                device="cpu",
            ),
            "ELU",
        ),
        (
            lambda: PPO(
                "CnnPolicy", Stub(spaces.Box(0, 255, (36, 36, 3), np.uint8), DONE), device="cpu"
            ),
            "CnnPolicy",
        ),
        (
            lambda: SAC("MlpPolicy", Stub(SEEN, DONE), device="cpu", buffer_size=10, use_sde=True),
            "Hardtanh",
        ),
    ],
)
def test_a_policy_that_cannot_fly_so_is_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        build_network(TrainedPolicy(make(), FlightSettings(), ITM))


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("section", ["Python", "A policy with a state", "A reference that moves"])
def test_the_examples_of_the_docs_agree(zips, extended, tmp_path, monkeypatch, capsys, section):
    pytest.importorskip("onnxruntime")
    monkeypatch.chdir(tmp_path)
    stateful = section == "A policy with a state"
    path = extended if stateful else zips / "tanh.zip"
    for file_format, file in (("onnx", "agent.onnx"), ("c", "agent.h")):
        assert main(["export", str(path), "--format", file_format, "-o", file]) == 0
    printed = capsys.readouterr().out
    assert ("state: zeros begin" in printed) == stateful
    text, scope = DOCS.split(f"## {section}")[1], {}
    exec(text.split("```python")[1].split("```")[0], scope)
    (tmp_path / "main.c").write_text(text.split("```c\n")[1].split("```")[0])
    subprocess.run([COMPILER, *FLAGS, "main.c", "-lm", "-o", "main"], check=True)
    done = subprocess.run(["./main"], check=True, capture_output=True, text=True).stdout.split()
    np.testing.assert_allclose(
        [float(word) for word in done], np.ravel(scope["thrust"][:1]), atol=1e-5
    )


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (["--format", "c"], "--overwrite"),
        (["--format", "c", "--overwrite", "-o", "agent.zip"], "agent.zip"),
        (["--format", "c", "-o", "b.h", "--name", "1st"], "--name"),
        (["--format", "c", "-o", "b.onnx"], "--format c"),
        (["--format", "torchscript"], "torchscript"),
        (["--format", "onnx"], "onnx"),
    ],
)
def test_bad_input_is_one_line(zips, tmp_path, capsys, monkeypatch, arguments, key):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "onnx", None)
    (tmp_path / "agent.zip").write_bytes((zips / "tanh.zip").read_bytes())
    (tmp_path / "agent.h").write_text("kept")
    assert main(["export", "agent.zip", *arguments]) == 2
    error = capsys.readouterr().err
    assert key in error and error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agent.h", "agent.zip"]
    assert (tmp_path / "agent.h").read_text() == "kept"
