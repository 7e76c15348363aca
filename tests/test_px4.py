"""Agents for PX4's module mc_nn_control: what they see, and the file that the module computes."""

import re

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.cli import main
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.export import px4
from sb3_quad.export.policy import export_policy

X500 = load_vehicle("x500")
HIDDEN = [5, 8, 11]


def seen(n=200, task="recovery_and_tracking", **settings):
    """Return an environment that shows what PX4 shows, and its features in units, (n, 18)."""
    env = QuadcopterVecEnv(n, task, seed=3, vehicle="x500", noise=0.0, features="px4", **settings)
    return env, env.reset()[:, :18] * env.batch.std[:, 0]


def save(path, settings=None, **policy):
    """Save a policy that has learnt nothing, and reacts to all that it sees."""
    settings = {"vehicle": "x500", "features": "px4", **(settings or {})}
    torch.manual_seed(1)
    keywords = {"net_arch": [24, 16], "activation_fn": torch.nn.ReLU, **policy}
    env = QuadcopterVecEnv(2, **settings)
    model = PPO("MlpPolicy", env, policy_kwargs=keywords, device="cpu")
    with torch.no_grad():
        # SB3 starts near zero, where neither the order of motors nor clipping would show.
        model.policy.action_net.weight *= 80.0
        model.policy.action_net.bias.copy_(torch.tensor([0.3, -0.2, 0.1, 0.0]))
    FlightSettings().with_changes(**settings).write_into(model)
    model.save(path)
    return str(path)


@pytest.fixture(scope="module")
def agent(tmp_path_factory):
    return save(tmp_path_factory.mktemp("agents") / "agent.zip")


def test_observations_are_the_true_state_in_the_axes_that_px4_shows():
    """Nothing but the position is relative to a reference that moves and turns."""
    reference = {"curve": "random_smooth", "speed": 2.0, "heading": "random", "heading_rate": 1.0}
    env, _ = seen(reference=reference, history=[0, 2])
    for _ in range(30):
        observation, *_ = env.step(np.zeros((env.num_envs, 4), np.float32))
    features = observation[:, :18] * env.batch.std[:, 0]
    state = env.true_state()
    assert np.abs(state.target_velocity).max() > 0.1
    to_body = state.rotation.transpose(0, 2, 1)
    to_body[:, :, 2] = 0.0
    parts = [state.position - state.target, to_body.reshape(-1, 9), state.velocity]
    expected = np.concatenate([*parts, state.body_rates], axis=1)
    np.testing.assert_allclose(features, expected, atol=2e-5)
    assert not observation.reshape(-1, 2, 18)[:, :, HIDDEN].any()


def test_pybullet_shows_the_same():
    pytest.importorskip("pybullet")
    settings = {"vehicle": "x500", "features": "px4", "noise": 0.05}
    env = QuadcopterVecEnv(1, "state_recovery", seed=7, **settings)
    twin = gymnasium.make("QuadStateRecovery-v0", disable_env_checker=True, **settings).unwrapped
    observation = env.reset()
    shown, _ = twin.reset(seed=row_seeds(7, 1)[0])
    np.testing.assert_array_equal(shown, observation[0])
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 4)).astype(np.float32)
    for action in actions:
        observation, *_ = env.step(action[None])
        shown, *_ = twin.step(action)
        for name in ("position", "velocity", "body_rates", "rotation", "rotor_speeds"):
            between = getattr(twin.true_state(), name) - getattr(env.true_state(), name)
            assert np.abs(between).max() < 1e-9, name
        np.testing.assert_allclose(shown, observation[0], atol=1e-6)
    twin.close()


def module_inputs(position, target, velocity, rotation, rates):
    """What mc_nn_control gives its network of PX4's state: north, east, down; forward, right, down.

    By PopulateInputTensor of PX4-Autopilot's src/modules/mc_nn_control/mc_nn_control.cpp.
    """
    flip = np.diag([1.0, -1.0, -1.0])
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    world = flip @ turn
    attitude = world @ rotation @ flip.T
    return np.concatenate(
        [
            world @ target - world @ position,
            attitude[0],
            attitude[1],
            world @ velocity,
            flip @ rates,
        ]
    )


def test_inputs_are_filled_as_the_module_does():
    env, features = seen()
    state = env.true_state()
    # Our world as east, north, up.
    to_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    to_frd = np.diag([1.0, -1.0, -1.0])
    expected = [
        module_inputs(
            to_ned @ state.position[row],
            to_ned @ state.target[row],
            to_ned @ state.velocity[row],
            to_ned @ state.rotation[row] @ to_frd.T,
            to_frd @ state.body_rates[row],
        )
        for row in range(state.n)
    ]
    np.testing.assert_allclose(features[:, px4.SHOWN] * px4.SIGNS, expected, atol=2e-5)


def commands(actions, parameters):
    """The motors' commands in [0, 1] of a network's results, by RescaleActions of the module."""
    actions = np.clip(actions, -1.0, 1.0)
    rpm = 60.0 * np.sqrt((actions + 1.0) / (parameters["MC_NN_THRST_COEF"] / 100_000.0))
    low, high = parameters["MC_NN_MIN_RPM"], parameters["MC_NN_MAX_RPM"]
    part = ((rpm * 2.0 - high - low) / (high - low) + 1.0) / 2.0
    a, b = 0.8, 0.2
    return a * ((part + b / (2.0 * a)) ** 2 - b * b / (4.0 * a * a))


def outputs(commands, factor):
    """What PX4 sends to motors, 0 to 1, by its model of thrust (FunctionMotors::updateValues)."""
    a, b = factor, 1.0 - factor
    return -b / (2.0 * a) + np.sqrt(b * b / (4.0 * a * a) + np.maximum(commands, 0.0) / a)


def parameters_of(exported):
    lines = exported.files["px4.params"].decode().splitlines()
    assert all(line.startswith("param set ") for line in lines)
    return {name: float(value) for _, _, name, value in map(str.split, lines)}


def test_the_printed_parameters_turn_actions_into_the_thrusts_of_the_vehicle(agent):
    pytest.importorskip("tflite_micro")
    parameters = parameters_of(export_policy(agent, "px4", n_observations=100))
    assert parameters["MC_NN_MANL_CTRL"] == parameters["MC_NN_EN"] == 1
    assert 0.01 <= parameters["MC_NN_THRST_COEF"] <= 5.0
    actions = np.linspace(-1.3, 1.3, 27)
    share = outputs(commands(actions, parameters), parameters["THR_MDL_FAC"])
    speed = share * parameters["MC_NN_MAX_RPM"] * 2.0 * np.pi / 60.0
    expected = X500.action_to_thrust(actions.clip(-1.0, 1.0))
    np.testing.assert_allclose(X500.thrust_coefficient * speed**2, expected, atol=5e-3)


def test_the_file_gives_what_the_policy_gives_in_px4s_order_of_motors(tmp_path):
    """Of a vehicle that numbers its rotors in another way."""
    micro = pytest.importorskip("tflite_micro")
    env, features = seen(200)
    changes = {"name": "renumbered"}
    for name in ("rotor_positions", "rotor_directions"):
        changes[name] = [getattr(X500, name)[k] for k in (2, 0, 3, 1)]
    vehicle = X500.model_copy(update=changes)
    path = save(tmp_path / "renumbered.zip", {"vehicle": vehicle})
    exported = export_policy(path, "px4", n_observations=100)
    run = micro.runtime.Interpreter.from_bytes(exported.content, arena_size=10 * 1024)
    results = []
    for row in (features[:, px4.SHOWN] * px4.SIGNS).astype(np.float32):
        run.set_input(row[None], 0)
        run.invoke()
        results.append(run.get_output(0)[0])
    observations = torch.tensor(features / env.batch.std[:, 0]).float()
    with torch.no_grad():
        policy = PPO.load(path, device="cpu").policy
        means = policy.get_distribution(observations).mode().numpy()
    # Front right, back left, front left, back right
    for motor, corner in enumerate([(1, -1), (-1, 1), (1, 1), (-1, -1)]):
        signs = np.sign(vehicle.rotor_positions)
        (rotor,) = np.flatnonzero((signs == corner).all(axis=1))
        np.testing.assert_allclose(np.array(results)[:, motor], means[:, rotor], atol=1e-4)
    assert "3 front left, rotor 0 of the vehicle, clockwise" in exported.metadata["motors"]


def test_the_command_writes_file_parameters_and_sources(agent, tmp_path, capsys):
    pytest.importorskip("tflite_micro")
    out = tmp_path / "out"
    assert main(["export", agent, "--format", "px4", "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "motors: 1 front right, rotor 0 of the vehicle, counter-clockwise from above;" in said
    content = (out / "control_net.tflite").read_bytes()
    source = (out / "control_net.cpp").read_text()
    assert bytes(map(int, re.findall(r"\d+", source.partition("= {")[2]))) == content
    assert f"_tflite_size = {len(content)};" in (out / "control_net.hpp").read_text()
    assert "param set MC_NN_MAX_RPM 13034\n" in (out / "px4.params").read_text()
    assert "parameters: param set MC_NN_EN 1; param set MC_NN_THRST_COEF 4.2382; " in said
    assert main(["export", agent, "--format", "px4", "-o", str(out)]) == 2


PLUS = [(0.2, 0.0), (-0.2, 0.0), (0.0, 0.2), (0.0, -0.2)]
REFUSED = {
    "activation_fn": ({}, {"activation_fn": torch.nn.Tanh}, {}),
    "last_action": ({"last_action": True}, {}, {}),
    "features": ({"features": "body"}, {}, {}),
    "rotor_thrust_limits": ({"vehicle": "itm"}, {}, {}),
    "corner": ({"vehicle": X500.model_copy(update={"rotor_positions": PLUS})}, {}, {}),
    "--output": ({}, {}, {"output": "speeds"}),
    "smaller layers": ({}, {"net_arch": [4000]}, {}),
}


@pytest.mark.parametrize("key", REFUSED)
def test_what_the_module_cannot_compute_is_refused(key, tmp_path):
    pytest.importorskip("tflite_micro")
    settings, policy, options = REFUSED[key]
    path = save(tmp_path / "agent.zip", settings, **policy)
    with pytest.raises(ConfigError, match=key) as error:
        export_policy(path, "px4", n_observations=100, **options)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_the_shipped_agent_exports():
    pytest.importorskip("tflite_micro")
    exported = export_policy(pretrained_path("x500-px4"), "px4")
    assert exported.max_error < 1e-3
    assert agent_settings(pretrained_path("x500-px4"))[0].features == "px4"
