"""RaptorPolicy learns and flies as RAPTOR's network does, and its policy.tar loads where PX4's mc_raptor loads one."""

import importlib.util
import io
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("sb3_contrib", reason="needs the extra [recurrent]")

from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO

from sb3_quad.base.errors import ConfigError, ExportError
from sb3_quad.cli import main
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.models import load_model, saved_algorithm
from sb3_quad.experts.resolve import resolve_expert
from sb3_quad.export import px4_raptor
from sb3_quad.export.px4_raptor import EXAMPLE_STEPS, TarPolicy, export_px4_raptor
from sb3_quad.recurrent.raptor_policy import Motors, RaptorPolicy, motor_kwargs
from sb3_quad.settings.flight import FlightSettings
from sb3_quad.vehicles.vehicle import load_vehicle

ITM = load_vehicle("itm")
FREE = ITM.model_copy(update={"name": "free", "thrust_limits": (0.0, 2.2)})  # its rotors can stand still
PROGRAM = Path(__file__).parent / "data" / "read_policy_tar.cpp"
COMPILER = shutil.which("c++") or shutil.which("g++")
HEADERS = importlib.util.find_spec("rltools")
needs_published = pytest.mark.skipif(importlib.util.find_spec("foundation_policy") is None, reason="needs the extra [raptor]")


def untrained(vehicle=FREE, algorithm=RecurrentPPO, policy=RaptorPolicy, **kwargs):
    own = motor_kwargs(vehicle) if policy is RaptorPolicy else {}
    env = QuadcopterVecEnv(4, vehicle=vehicle, seed=0, last_action=True)
    model = algorithm(policy, env, n_steps=16, batch_size=32, policy_kwargs={**own, **kwargs}, seed=1, device="cpu")
    if policy is RaptorPolicy:
        with torch.no_grad():  # SB3 starts near zero, where neither order of motors nor clipping would show
            model.policy.layers()[2].weight *= 150.0
    return model


def saved(model, path, vehicle=FREE, **settings):
    FlightSettings(**{"vehicle": vehicle, "last_action": True, **settings}).write_into(model)
    model.save(path)
    return path


@pytest.fixture(scope="module")
def agent(tmp_path_factory):
    return saved(untrained(), tmp_path_factory.mktemp("px4") / "my agent.zip")


@pytest.fixture(scope="module")
def exported(agent):
    return export_px4_raptor(agent, n_observations=2000)


def published(vehicle):
    """RAPTOR's weights in a policy of this package."""
    import foundation_policy

    model = untrained(vehicle)
    dense, gru, last = foundation_policy.Raptor().layers
    wanted = [dense.weights, dense.biases, gru.weights_input, gru.weights_hidden, gru.biases_input, gru.biases_hidden]
    ours = [parameter for layer in model.policy.layers() for parameter in layer.parameters()]
    with torch.no_grad():
        for parameter, values in zip(ours, [*wanted, last.weights, last.biases], strict=True):
            parameter.copy_(torch.as_tensor(values).reshape(parameter.shape))
    return model


@needs_published
@pytest.mark.parametrize("vehicle", [FREE.model_copy(update={"thrust_limits": (0.0, 1.7)}), ITM, load_vehicle("crazyflie")])
def test_with_the_published_weights_it_acts_as_raptor_does(vehicle):
    policy, raptor = published(vehicle), resolve_expert("raptor", vehicle)
    task = {"target_distance": 0.1, "nearest_target": 0.0}
    env = QuadcopterVecEnv(4, "target_tracking", task, vehicle=vehicle, noise=0.0, seed=0, last_action=True)
    seen, begins, ours, theirs = env.reset(), np.ones(4, dtype=bool), None, None
    for _ in range(500):
        actions, ours = policy.predict(seen, ours, begins, deterministic=True)
        wanted, theirs = raptor.predict(seen, theirs, begins)
        assert np.abs(theirs[1]).max() < 1.0  # the environment clips the last action, the expert raptor does not
        np.testing.assert_allclose(actions, wanted, atol=1e-5)
        seen, _, begins, _ = env.step(wanted)
    assert np.linalg.norm(env.true_state().position - env.target, axis=1).max() < 0.1


def test_it_learns_in_ordinary_environments_and_its_zip_needs_no_trust(tmp_path):
    model = untrained()
    before = [parameter.clone() for parameter in model.policy.parameters()]
    model.learn(128)
    after = list(model.policy.parameters())
    assert all((old != new).any() for old, new in zip(before, after, strict=True))
    path = saved(model, tmp_path / "agent.zip")
    again = load_model(path)
    assert saved_algorithm(path) == "RecurrentPPO" and type(again.policy) is RaptorPolicy
    seen = np.random.default_rng(0).normal(size=(3, 22)).astype(np.float32)
    (actions, state), (others, _) = (each.predict(seen, deterministic=True) for each in (model, again))
    assert (actions == others).all() and (again.predict(seen, state, deterministic=True)[0] != actions).any()
    assert not state[1].any()
    flights = fly(again, "target_tracking", 2, max_steps=20, vehicle=FREE, last_action=True)
    assert len(flights.success) == 2
    model.policy.save(tmp_path / "policy.pt")
    kept = RaptorPolicy.load(tmp_path / "policy.pt", device="cpu")
    assert (kept.predict(seen, deterministic=True)[0] == actions).all()


@pytest.mark.parametrize("vehicle", [FREE, ITM, load_vehicle("crazyflie")])
def test_commands_are_linear_in_the_speeds_of_the_vehicles_rotors(vehicle):
    motors = Motors(**motor_kwargs(vehicle))
    commands = torch.rand(50, 4, generator=torch.Generator().manual_seed(0)) * 2 - 1
    actions = motors(commands)
    speeds = np.sqrt(vehicle.action_to_thrust(actions.numpy().astype(np.float64)) / vehicle.thrust_coefficient)
    low, high = vehicle.rotor_speed_range
    for rotor, (x, y) in enumerate(vehicle.rotor_positions):
        motor = [(1, -1), (-1, -1), (-1, 1), (1, 1)].index((np.sign(x), np.sign(y)))
        np.testing.assert_allclose((speeds[:, rotor] - low) / (high - low), (commands[:, motor] + 1) / 2, atol=1e-4)
    np.testing.assert_allclose(motors.commands(actions), commands, atol=1e-3)
    assert (motors.commands(torch.zeros(2, 4)) == 0.0).all()  # as mc_raptor begins
    assert (motors(torch.full((1, 4), 7.0)) == 1.0).all() and (motors(torch.full((1, 4), -7.0)) == -1.0).all()


@pytest.mark.parametrize(("start", "wanted"), [(-3.0, 0.5), (-1.0, 0.5), (3.0, -0.5), (0.0, -0.9), (0.0, 0.9)])
def test_the_gradient_leads_back_from_wherever_a_command_is(start, wanted):
    motors, commands = Motors((0, 1, 2, 3), 0.0), torch.full((1, 4), start, requires_grad=True)
    optimizer = torch.optim.SGD([commands], lr=0.2)
    for _ in range(300):
        optimizer.zero_grad()
        (motors(commands) - wanted).square().sum().backward()
        optimizer.step()
    assert torch.allclose(motors(commands), torch.tensor(wanted), atol=1e-3)
    beyond = torch.full((1, 4), 2.0, requires_grad=True)  # what is out of range is not pushed further out
    (-motors(beyond)).sum().backward()
    assert not beyond.grad.any()


def test_the_archive_is_laid_out_as_rl_tools_writes_one(exported):
    with tarfile.open(fileobj=io.BytesIO(exported.content)) as archive:
        files = {member.name: archive.extractfile(member).read() for member in archive}
        assert {(member.mtime, member.uid, member.uname) for member in archive.getmembers()} == {(0, 0, "")}
    assert files["actor/meta"] == b"checkpoint_name: my_agent\ntype: sequential\n"
    assert files["actor/layers/0/meta"] == b"activation_function: RELU\ntype: dense\n"
    assert files["actor/layers/1/meta"] == b"type: gru\n"
    assert files["actor/layers/2/meta"] == b"activation_function: IDENTITY\ntype: dense\n"
    shapes = {
        "actor/layers/0/weights/parameters": (16, 22),
        "actor/layers/0/biases/parameters": (16,),
        "actor/layers/1/weights_input/parameters": (48, 16),
        "actor/layers/1/biases_input/parameters": (48,),
        "actor/layers/1/weights_hidden/parameters": (48, 16),
        "actor/layers/1/biases_hidden/parameters": (48,),
        "actor/layers/1/initial_hidden_state/parameters": (16,),
        "actor/layers/2/weights/parameters": (4, 16),
        "actor/layers/2/biases/parameters": (4,),
        "example/input": (EXAMPLE_STEPS, 2, 22),
        "example/output": (EXAMPLE_STEPS, 2, 4),
    }
    for path, shape in shapes.items():
        dims = "".join(f"dim_{k}: {size}\n" for k, size in enumerate(shape))
        assert files[f"{path}/meta"].decode() == f"type: tensor\ndtype: float32\nnum_dims: {len(shape)}\n{dims}"
        assert len(files[f"{path}/data"]) == 4 * np.prod(shape)
    assert len(files) == 4 + 2 * len(shapes)
    assert max(len(content) for name, content in files.items() if name.endswith("meta")) < 100  # the loader's buffer


def test_the_same_agent_gives_the_same_bytes(agent, exported):
    assert export_px4_raptor(agent, n_observations=2000).content == exported.content


def test_the_file_computes_what_the_policy_does(agent, exported):
    policy, model = TarPolicy(exported.content), load_model(agent)
    first, gru, last = model.policy.layers()
    inputs, outputs = policy.array("example/input"), policy.array("example/output")
    assert (inputs[0, :, -4:] == 0.0).all() and inputs[:, :, -4:].std() > 0.1
    assert np.abs(inputs[:, :, :3]).max() <= 0.5 and np.abs(inputs[:, :, 12:15]).max() <= 1.0
    hidden = policy.start(2)
    for x, wanted in zip(inputs, outputs, strict=True):
        commands, hidden = policy.step(x, hidden)
        np.testing.assert_allclose(commands, wanted, atol=1e-5)
    with torch.no_grad():
        found, _ = gru(first(torch.from_numpy(inputs.copy())).relu(), (torch.zeros(1, 2, 16), torch.zeros(1, 2, 16)))
        np.testing.assert_allclose(last(found), outputs, atol=1e-6)
    assert exported.max_error < 1e-4 and "2 side by side" in exported.metadata["check"]


def test_a_file_that_computes_something_else_is_not_written(agent, tmp_path, capsys, monkeypatch):
    def wrong(*layers, found=px4_raptor._parameters):
        tensors = found(*layers)
        return {**tensors, "actor/layers/2/biases/parameters": tensors["actor/layers/2/biases/parameters"] + 0.05}

    monkeypatch.setattr(px4_raptor, "_parameters", wrong)
    assert main(["export", str(agent), "--format", "px4-raptor", "-o", str(tmp_path / "policy.tar")]) == 2
    error = capsys.readouterr().err
    assert "differs from the trained one" in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_damaged_archive_is_refused(exported):
    with pytest.raises(ExportError, match="cannot be read"):
        TarPolicy(exported.content.replace(b"dim_1: 22", b"dim_1: 23", 1))


def test_the_command_writes_policy_tar(agent, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(agent), "--format", "px4-raptor"]) == 0
    said = capsys.readouterr()
    assert "checkpoint_name: my_agent" in said.out and "22-16-GRU 16-4, 2084 float32 parameters" in said.out
    assert "closed-loop flights of 1000 control steps, 10 side by side" in said.out and "time:" not in said.out
    assert not said.err
    assert TarPolicy((tmp_path / "policy.tar").read_bytes()).name == "my_agent"


@pytest.mark.skipif(
    COMPILER is None or HEADERS is None, reason="needs a C++ compiler and the headers of rl_tools: pip install rltools==2.2.1"
)
@pytest.mark.parametrize("weights", ["random", pytest.param("published", marks=needs_published)])
def test_rl_tools_loads_the_file_and_its_example_check_passes(tmp_path, exported, weights):
    """The program compares as mc_raptor does: mean difference below 1e-5, over its five steps and over all of them."""
    content = exported.content
    if weights == "published":
        content = export_px4_raptor(saved(published(FREE), tmp_path / "raptor.zip"), n_observations=2000).content
    (tmp_path / "policy.tar").write_bytes(content)
    include = Path(HEADERS.submodule_search_locations[0]) / "external" / "rl_tools" / "include"
    built = [COMPILER, "-std=c++17", "-O1", "-I", str(include), str(PROGRAM), "-o", str(tmp_path / "read")]
    subprocess.run(built, check=True, capture_output=True, timeout=240)
    for steps in (5, EXAMPLE_STEPS):
        done = subprocess.run(["./read", "policy.tar", str(steps)], cwd=tmp_path, check=True, capture_output=True, text=True)
        *numbers, mean, name = done.stdout.splitlines()[-(8 * steps + 2) :]
        assert float(mean) < 1e-6 and name in ("my_agent", "raptor")
        found = np.array(numbers, dtype=np.float32).reshape(2, steps, 4).swapaxes(0, 1)
        np.testing.assert_allclose(found, TarPolicy(content).array("example/output")[:steps], atol=1e-5)


def test_an_environment_without_the_last_action_is_refused():
    with pytest.raises(ConfigError, match="set last_action: true in env_kwargs"):
        RecurrentPPO(RaptorPolicy, QuadcopterVecEnv(1, seed=0), device="cpu")


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"motors": [0, 1, 2, 2]}, "motors"),
        ({"idle": 1.0}, "idle"),
        ({"net_arch": [64]}, "net_arch"),
        ({"net_arch": {"pi": [8], "vf": [8]}}, "net_arch"),
    ],
)
def test_settings_that_do_not_fit_are_refused(kwargs, message):
    with pytest.raises(ConfigError, match=message):
        untrained(**kwargs)


def test_rotors_that_it_does_not_fly_are_refused():
    with pytest.raises(ConfigError, match="RaptorPolicy: flies an X"):
        motor_kwargs("hummingbird")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: (untrained(algorithm=PPO, policy="MlpPolicy"), {}),
            "its policy is ActorCriticPolicy of PPO; mc_raptor is compiled for",
        ),
        (lambda: (untrained(policy="MlpLstmPolicy"), {}), "its policy is RecurrentActorCriticPolicy"),
        (lambda: (untrained(lstm_hidden_size=32), {}), "its policy is 22-16-GRU 32-4; .* and loads nothing else"),
        (
            lambda: (untrained(motors=(0, 1, 2, 3)), {}),
            r"trained with motors \[0, 1, 2, 3\] .* free has motors \[3, 0, 1, 2\]",
        ),
        (lambda: (untrained(), {"vehicle": "itm"}), "idle 0, itm has motors .* idle 0.57735"),
        (lambda: (untrained(), {"vehicle": "hummingbird"}), "mc_raptor: flies an X"),
        (lambda: (untrained(), {"position_integral": {}}), "last_action alone"),
        (lambda: (untrained(), {"observation_std": [1.0] * 18}), "Table A.2"),
        (
            lambda: (untrained(), {"vehicle": FREE.model_copy(update={"control_step": 0.02})}),
            "control_step of free is 0.02 s, of mc_raptor 0.01 s",
        ),
    ],
)
def test_what_mc_raptor_cannot_fly_is_one_line(make, message, tmp_path, capsys):
    model, settings = make()
    path = saved(model, tmp_path / "agent.zip", **settings)
    assert main(["export", str(path), "--format", "px4-raptor", "-o", str(tmp_path / "policy.tar")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and not (tmp_path / "policy.tar").exists()
    with pytest.raises(ConfigError, match=message):
        export_px4_raptor(path)


def test_it_gives_motor_commands_alone(agent, tmp_path, capsys):
    given = ["export", str(agent), "--format", "px4-raptor", "--output", "speeds", "-o", str(tmp_path / "policy.tar")]
    assert main(given) == 2
    assert "--output speeds: px4-raptor gives motor commands" in capsys.readouterr().err


def test_without_sb3_contrib_the_line_says_what_to_install(agent, capsys, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    assert main(["export", str(agent), "--format", "px4-raptor", "-o", str(tmp_path / "policy.tar")]) == 2
    error = capsys.readouterr().err
    assert "pip install '.[recurrent]'" in error and error.count("\n") == 1
