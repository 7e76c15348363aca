"""The PyBullet environment: Gymnasium's and SB3's contracts, its physics against written-out
equations, bad input.
"""

import copy
import pickle
import re
import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_quad.base.errors import ConfigError
from sb3_quad.envs.batch_env import FlightKeywords
from sb3_quad.envs.quadcopter_env import QuadcopterEnv
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle

IDS = ["QuadTargetTracking-v0", "QuadStateRecovery-v0"]
HIGH = {"start_position": (0.0, 0.0, 5000.0), "max_distance": 1e6}  # nothing ends a flight up there
FloatArray = npt.NDArray[np.float64]


@pytest.fixture
def env() -> Any:
    made = QuadcopterEnv(noise=0.0)
    yield made
    made.close()


def _rotation(q: FloatArray) -> FloatArray:
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def _product(p: FloatArray, q: FloatArray) -> FloatArray:
    return np.array(
        [p[0] * q[0] - p[1:] @ q[1:], *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))]
    )


class Reference:
    """Specification section 1, a line for a line, for one vehicle."""

    def __init__(self, state: FloatArray, delay: int = 1, **wrench: FloatArray) -> None:
        self.vehicle = load_vehicle("itm")
        self.r, self.q, self.v, self.w, self.rotor = (
            state[part].copy() for part in np.split(np.arange(17), [3, 7, 10, 13])
        )
        self.queue = [np.full(4, self.vehicle.hover_rotor_speed)] * delay
        zero = np.zeros(3)
        self.force_world, self.force_body = (
            wrench.get("force_world", zero),
            wrench.get("force_body", zero),
        )
        self.torque_world, self.torque_body = (
            wrench.get("torque_world", zero),
            wrench.get("torque_body", zero),
        )

    def step(self, action: FloatArray) -> None:
        vehicle, dt = self.vehicle, self.vehicle.physics_step
        inertia = np.array(vehicle.inertia)
        thrust = (0.5 * np.clip(action, -1, 1) + 1) * vehicle.mass * vehicle.gravity / 4
        self.queue.append(np.sqrt(thrust / vehicle.thrust_coefficient))
        wanted = self.queue.pop(0)
        for _ in range(4):
            self.rotor = self.rotor + vehicle.motor_gain_up * (wanted - self.rotor) * dt
            total, *moment = vehicle.mixer @ (vehicle.thrust_coefficient * self.rotor**2)
            rotation = _rotation(self.q)
            force = rotation @ (np.array([0, 0, total]) + self.force_body) + self.force_world
            torque = np.array(moment) + self.torque_body + rotation.T @ self.torque_world
            self.v = self.v + dt * (force / vehicle.mass - np.array([0, 0, vehicle.gravity]))
            self.w = self.w + dt * (torque - np.cross(self.w, inertia * self.w)) / inertia
            self.r = self.r + dt * self.v
            angle = np.linalg.norm(self.w) * dt
            self.q = _product(
                self.q,
                np.array(
                    [np.cos(angle / 2), *(self.w / np.linalg.norm(self.w) * np.sin(angle / 2))]
                ),
            )


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize(
    "wrench",
    [
        {},
        {"force_frame": "world", "torque_frame": "body"},
        {"force_frame": "body", "torque_frame": "world"},
    ],
    ids=["free", "world_force", "body_force"],
)
def test_flight_is_the_specified_integrator(wrench: dict[str, str], delay: int) -> None:
    """400 control steps of violent tumbling agree to 1e-9 with the specification's equations, with
    external wrenches in any frame.
    """
    rng = np.random.default_rng(1)
    env = QuadcopterEnv(
        task_kwargs=HIGH, noise=0.0, vehicle=load_vehicle("itm").model_copy(update={"delay": delay})
    )
    start = {
        "quaternion": rng.normal(size=4),
        "velocity": rng.normal(size=3) * 3,
        "body_rates": [12.0, -14.0, 10.0],
    }
    env.reset(seed=3, options={"state": start})
    parts: dict[str, FloatArray] = {}
    if wrench:
        force, torque = np.array([3.0, -2.0, 5.0]), np.array([0.05, 0.04, -0.05])
        env.set_wrench(force, torque, **wrench)
        parts = {
            f"force_{wrench['force_frame']}": force,
            f"torque_{wrench['torque_frame']}": torque,
        }
    state = env.true_state().array[:, 0]
    reference = Reference(state, delay, **parts)
    fastest = 0.0
    for _ in range(400):
        action = rng.choice([-1.5, 1.5], size=4)
        env.step(action)
        reference.step(action)
        fastest = max(fastest, float(np.linalg.norm(reference.w)))
    assert fastest > 20.0
    expected = [
        reference.r,
        np.sign(state[3] * reference.q[0]) * reference.q,
        reference.v,
        reference.w,
        reference.rotor,
    ]
    for part, value in zip(np.split(state[:17], [3, 7, 10, 13]), expected, strict=True):
        np.testing.assert_allclose(part, value, rtol=0, atol=1e-9)
    env.close()


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_both_checkers_pass(
    env_id: str, render_mode: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Gymnasium's checker warns that the observation is unbounded, by design (thesis 3.3.1).
        warnings.filterwarnings(
            "ignore", message=".*A Box observation space m[a-z]+imum value is -?infinity.*"
        )
        env = gymnasium.make(env_id, render_mode=render_mode)
        check_env(
            env.unwrapped
        )  # makes one in human mode, too: without a display that flies without a window
        env = gymnasium.make(env_id, render_mode=render_mode)
        sb3_check_env(env.unwrapped, skip_render_check=render_mode is None)
        env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_same_seed_same_episode(env_id: str) -> None:
    """Bit for bit, on another instance and on a used one; the next episode differs and is as
    repeatable.
    """
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 4)).astype(np.float32)

    def fly(env: gymnasium.Env[Any, Any]) -> list[Any]:
        seen: list[Any] = []
        for seed in (7, None):
            observation, _ = env.reset(seed=seed)
            seen.append(observation)
            for action in actions:
                observation, reward, *_ = env.step(action)
                seen += [observation, reward]
        return seen

    first, second = gymnasium.make(env_id), gymnasium.make(env_id)
    one, two, again = fly(first), fly(second), fly(first)
    assert all(
        np.array_equal(a, b) and np.array_equal(a, c)
        for a, b, c in zip(one, two, again, strict=True)
    )
    assert not np.array_equal(one[0], one[len(one) // 2])
    first.close(), second.close()


def test_hovers_on_zero_action(env: QuadcopterEnv) -> None:
    env.reset(seed=0, options={"target": (1.0, 2.0, 15.0)})
    for _ in range(100):
        _, reward, terminated, truncated, info = env.step(np.zeros(4, dtype=np.float32))
    np.testing.assert_allclose(env.true_state().position[0], [0, 0, 15], atol=1e-9)
    np.testing.assert_allclose(info["distance"], np.sqrt(5.0))
    np.testing.assert_allclose(reward, -0.003 * np.sqrt(5.0))
    assert info["survival"] and not info["is_success"] and not terminated and not truncated


def test_ends_on_touching_the_ground(env: QuadcopterEnv) -> None:
    env.reset(
        seed=0,
        options={"state": {"position": (0, 0, 0.3), "velocity": (0, 0, -2)}, "target": (0, 0, 5)},
    )
    for _ in range(100):
        _, reward, terminated, _, info = env.step(-np.ones(4, dtype=np.float32))
        height = env.true_state().position[0, 2]
        assert (
            terminated
            == (height <= env.vehicle.collision_radius)
            == info["collision"]
            == (not info["survival"])
        )
        if terminated:
            break
    assert terminated and reward < -15 and not info["out_of_range"]
    assert height > 0.1  # stopped on the step of the contact, before it bounces


def test_setters_act_while_flying(env: QuadcopterEnv) -> None:
    env.reset(seed=0)
    env.set_target((1.0, 2.0, 20.0))
    np.testing.assert_array_equal(env.target, [1.0, 2.0, 20.0])
    plain, *_ = env.step(np.zeros(4, dtype=np.float32))
    features = plain * env.observation_std + env.observation_mean
    np.testing.assert_allclose(features[:3], env.true_state().position[0] - env.target, atol=1e-5)
    env.set_noise(0.5)
    noisy, *_ = env.step(np.zeros(4, dtype=np.float32))
    assert env.noise == 0.5 and not np.allclose(noisy, plain, atol=1e-3)


def test_a_wrench_acts_until_another_is_set(env: QuadcopterEnv) -> None:
    env.reset(seed=0)
    env.set_wrench(force=(1.727, 0, 0))
    for _ in range(10):
        env.step(np.zeros(4, dtype=np.float32))
    np.testing.assert_allclose(env.true_state().velocity[0], [0.1, 0, 0], atol=1e-12)
    env.set_wrench()
    env.step(np.zeros(4, dtype=np.float32))
    np.testing.assert_allclose(env.true_state().velocity[0], [0.1, 0, 0], atol=1e-12)


def test_fixed_start(env: QuadcopterEnv) -> None:
    start = {
        "position": (1, 2, 3),
        "quaternion": (0, -2, 0, 0),
        "velocity": (2, 2, 0),
        "body_rates": (4, 4, 4),
    }
    observation, info = env.reset(seed=0, options={"state": start, "target": (1, 2, 4)})
    state = env.true_state()
    np.testing.assert_array_equal(state.position[0], [1, 2, 3])
    np.testing.assert_array_equal(state.quaternion[0], [0, -1, 0, 0])
    np.testing.assert_array_equal(state.body_rates[0], [4, 4, 4])
    np.testing.assert_allclose(
        observation * env.observation_std,
        [0, 0, -1, 1, 0, 0, 0, -1, 0, 0, 0, -1, 2, -2, 0, 4, 4, 4],
        atol=1e-6,
    )
    assert info["distance"] == 1.0


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.full(4, np.nan), "finite"),
        (np.zeros(3), r"\(3,\).*\(4,\)"),
        (np.zeros((1, 4)), r"\(1, 4\).*\(4,\)"),
    ],
)
def test_bad_actions_raise(env: QuadcopterEnv, action: Any, message: str) -> None:
    env.reset(seed=0)
    before = env.true_state().copy().array
    with pytest.raises(ValueError, match=message):
        env.step(action)
    np.testing.assert_array_equal(env.true_state().array, before)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env: env.reset(options={"targets": (0, 0, 1)}), "'targets': did you mean 'target'"),
        (
            lambda env: env.reset(options={"state": {"velocty": (0, 0, 1)}}),
            "did you mean 'velocity'",
        ),
        (
            lambda env: env.reset(options={"state": {"quaternion": (0, 0, 0, 0)}}),
            "quaternion: must not be zero",
        ),
        (lambda env: env.reset(options={"state": {"position": (0, 0, 0.1)}}), "ground"),
        (lambda env: env.reset(options={"state": 3}), "state"),
        (lambda env: QuadcopterEnv(task_kwargs={"start_position": (0, 0, 0.1)}), "at once"),
        (lambda env: QuadcopterVecEnv(2, seed=-1), "seed -1 is not a whole number"),
        (
            lambda env: QuadcopterVecEnv(1, reference={"curve": "circle", "heading": True}),
            "reference.heading",
        ),
        (lambda env: env.reset(options={"target": (0, 0)}), "options: target"),
        (lambda env: env.set_target((0, 0, np.nan)), "position .*finite"),
        (lambda env: env.set_wrench(force=(1, 2)), r"force of shape \(2,\): must be \(3,\)"),
        (lambda env: env.set_wrench(force=(1, 2, 3), force_frame="wrld"), "force_frame 'wrld'"),
        (lambda env: env.set_noise(-1), "noise"),
        (lambda env: QuadcopterEnv(observation_std=np.zeros(18)), "observation_std"),
        (
            lambda env: QuadcopterEnv(max_episode_steps=5),
            "max_episode_steps 5: give it to gymnasium.make",
        ),
        (lambda env: QuadcopterEnv(task="target_trackin"), "did you mean 'target_tracking'"),
        (
            lambda env: QuadcopterEnv(noize=0),  # type: ignore[call-arg]
            "QuadcopterEnv: unknown keyword 'noize': did you mean 'noise'",
        ),
        (
            lambda env: QuadcopterEnv(rendermode="human"),  # type: ignore[call-arg]
            "QuadcopterEnv: .* 'rendermode': did you mean 'render_mode'",
        ),
        (
            lambda env: QuadcopterVecEnv(1, nthreads=1),  # type: ignore[call-arg]
            "QuadcopterVecEnv: .* 'nthreads': did you mean 'n_threads'",
        ),
        (lambda env: QuadcopterEnv(vehicle="itn"), "did you mean 'itm'"),
        (lambda env: QuadcopterEnv(render_mode="rgb_aray"), "did you mean 'rgb_array'"),
    ],
)
def test_bad_input_raises_and_names_the_thing(env: QuadcopterEnv, call: Any, message: str) -> None:
    env.reset(seed=0)
    with pytest.raises(ConfigError, match=message) as caught:
        call(env)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_flies_on_by_itself(copied: Any) -> None:
    env = QuadcopterEnv("state_recovery", vehicles={"distribution": "raptor"})
    env.reset(seed=1)
    action = np.full(4, 0.1, dtype=np.float32)
    for _ in range(20):
        env.step(action)
    other = copied(env)
    ahead = [other.step(action)[0] for _ in range(20)]
    np.testing.assert_allclose([env.step(action)[0] for _ in range(20)], ahead, atol=1e-6)
    env.close()
    other.step(action)
    other.close()


def test_closing_twice_leaves_other_environments_open() -> None:
    first, second = QuadcopterEnv(), QuadcopterEnv()
    with pytest.raises(gymnasium.error.ResetNeeded):
        first.step(np.zeros(4, dtype=np.float32))
    first.reset(seed=0), second.reset(seed=0)
    first.close()
    first.close()
    with pytest.raises(gymnasium.error.ResetNeeded):
        first.step(np.zeros(4, dtype=np.float32))
    third = QuadcopterEnv()  # takes the client number that is free again
    third.reset(seed=1)
    first.close()
    for env in (second, third):
        assert np.isfinite(env.step(np.zeros(4, dtype=np.float32))[0]).all()
        env.close()
    first.reset(seed=0)  # opens a new simulation
    first.step(np.zeros(4, dtype=np.float32))
    first.close()


@pytest.mark.slow
def test_import_is_light() -> None:
    """`import sb3_quad` imports no simulator, compiler or torch, and gymnasium.make needs no more.

    PyBullet is imported without its line about its build, and standard error works afterwards.
    """
    code = (
        "import sys, sb3_quad, sb3_quad.envs, gymnasium;"
        "print([m for m in ('pybullet', 'numba', 'torch') if m in sys.modules]);"
        "gymnasium.make('QuadTargetTracking-v0').reset(seed=0); print('torch' in sys.modules);"
        "print('stderr works', file=sys.stderr)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.splitlines() == ["[]", "False"]
    assert result.stderr.splitlines() == ["stderr works"]


def test_the_manual_lists_every_argument() -> None:
    table = (QuadcopterEnv.__doc__ or "").split("## Arguments")[1].split("## While")[0]
    cells = [line.split("|")[1] for line in table.splitlines() if line.strip().startswith("| `")]
    listed = {name for cell in cells for name in re.findall(r"`(\w+)`", cell)}
    drawn = {"render_mode", "render_width", "render_height"}
    # max_episode_steps is an argument of gymnasium.make.
    assert listed == {*FlightSettings.model_fields, *drawn} - {"max_episode_steps"}


def test_the_typed_keywords_are_the_flight_settings() -> None:
    typed = {"task", *FlightKeywords.__annotations__}
    assert typed == FlightSettings.model_fields.keys()
