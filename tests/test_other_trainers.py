"""What the trainers of others have learned is flown as it was trained, and refused if it cannot."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation.flights import fly

TRAINERS = Path(__file__).resolve().parent.parent / "examples" / "other_trainers"


@pytest.fixture(autouse=True)
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(TRAINERS))
    yield
    for name in ("rltools", "rotorpy_ppo", "table"):
        sys.modules.pop(name, None)


def write_checkpoint(path, arrays):
    """As the trainer writes it, without what is not read."""
    blocks = []
    for values in arrays:
        numbers = ", ".join(f"{float(value).hex()}f" for value in values.ravel())
        shape = ", ".join(map(str, values.shape))
        blocks.append(
            f"constexpr float memory[] = {{{numbers}}};\n"
            f"    using SHAPE = a::tensor::Shape<unsigned long, {shape}>;"
        )
    path.write_text("\n".join(blocks))
    return path


def hovering(folder, speed, output=None):
    """The checkpoint of a policy that asks for one speed of all rotors."""
    layers = [np.zeros((16, 29)), np.zeros(16), np.zeros((8, 16)), np.full(8, np.arctanh(speed))]
    output = np.full((1, 2, 4), speed if output is None else output)
    return write_checkpoint(folder / "checkpoint.h", [*layers, np.ones((1, 2, 29)), output])


def test_a_speed_in_the_checkpoint_becomes_the_thrust_that_the_trainer_means(tmp_path):
    from rltools import GENTLE, VEHICLE, Policy, relu

    # Its thrust is 0.1302 s^2 N, s from 0 to 1.
    speed = 2.0 * np.sqrt(VEHICLE.mass * VEHICLE.gravity / 4.0 / 0.1302) - 1.0
    policy = Policy(hovering(tmp_path, speed), relu)
    flights = fly(policy, "state_recovery", 4, vehicle=VEHICLE, task_kwargs=GENTLE)
    assert (flights.final_error < 0.01).all()


def test_the_policy_sees_the_state_and_its_last_speeds_every_other_step(tmp_path):
    """By a network of one layer that passes on its inputs, four at a time."""
    from rltools import VEHICLE, Policy, relu

    env = QuadcopterVecEnv(3, task="state_recovery", vehicle=VEHICLE, noise=0.0, seed=0)
    first = np.asarray(env.reset())
    state = env.true_state()
    body_to_world = state.rotation.reshape(3, 9)
    relative = state.position - state.target
    seen = np.hstack([relative, state.velocity, body_to_world, state.velocity, state.body_rates])
    hover = 2.0 * np.sqrt(VEHICLE.mass * VEHICLE.gravity / 4.0 / 0.1302) - 1.0
    expected = np.hstack([seen, np.full((3, 8), hover)])
    for begin in (0, 4, 8, 12, 16, 20, 24):
        weights = 0.1 * np.eye(29)[begin : begin + 4]
        example = [np.ones((1, 29)), np.tanh(0.1 * np.ones((1, 4)))]
        path = write_checkpoint(tmp_path / "checkpoint.h", [weights, np.zeros(4), *example])
        policy = Policy(path, relu)
        actions, memory = policy.predict(first)
        speeds = np.tanh(0.1 * expected[:, begin : begin + 4])
        np.testing.assert_allclose(actions, 2.0 * ((speeds + 1.0) / 2.0) ** 2 - 1.0, atol=1e-5)
        held, memory = policy.predict(first + 1.0, memory)
        assert (held == actions).all()
        later, memory = policy.predict(first + 1.0, memory)
        assert (later != actions).any()
        # The newest of the last speeds is first.
        np.testing.assert_allclose(memory[0][:, 1], speeds, atol=1e-5)


def test_a_checkpoint_that_is_written_in_another_way_is_refused(tmp_path):
    from rltools import Policy, relu

    with pytest.raises(SystemExit, match="read in another way"):
        Policy(hovering(tmp_path, 0.2, output=0.3), relu)


def test_a_missing_clone_or_compiler_is_refused(tmp_path, monkeypatch):
    from rltools import compile_trainer

    with pytest.raises(SystemExit, match="git clone"):
        compile_trainer(tmp_path, "sac", None, tmp_path)
    zoo = tmp_path / "src" / "rl" / "zoo"
    (zoo / "l2f").mkdir(parents=True)
    (zoo / "zoo.cpp").touch()
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(SystemExit, match=r"g\+\+ not found"):
        compile_trainer(tmp_path, "sac", None, tmp_path)
    monkeypatch.setattr("shutil.which", lambda name: name)
    (zoo / "l2f" / "sac_tiny.h").write_text("TI EPISODE_STEP_LIMIT = 500;")
    with pytest.raises(SystemExit, match="has no STEP_LIMIT"):
        compile_trainer(tmp_path, "sac", 1000, tmp_path)


@pytest.mark.skipif(importlib.util.find_spec("rotorpy") is not None, reason="has RotorPy")
def test_without_rotorpy_it_says_what_to_install():
    with pytest.raises(SystemExit, match=r"pip install -r examples/other_trainers/requirements"):
        import rotorpy_ppo  # noqa: F401
