"""Gradients of recorded flights: what autograd of the same equations gives."""

from copy import deepcopy

import gymnasium
import numpy as np
import pytest
import torch as th
from flight_in_torch import State, fly
from hypothesis import example, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from sb3_quad.algorithms.apg import APG
from sb3_quad.algorithms.networks import network_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.flight_cost import FlownStates, flight_cost
from sb3_quad.envs.simulation.adjoint import MOVING
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.observation import FEATURE_SIZES
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import POSITION, ROTOR_SPEEDS, STATE_SIZE, VELOCITY, X
from sb3_quad.envs.simulation.tape import FlightTape
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.fast.policy import Perceptrons

# What each quantity of the state varies by, so that the parts of a cost weigh about the same.
SCALE = np.concatenate([np.ones(13), np.full(4, 100.0)])


def new_batch(n, seed, n_threads=1, **keywords):
    keywords = {"task": "state_recovery", **keywords}
    return QuadcopterBatch(n, FlightSettings(**keywords), seed, n_threads)


def random_actions(steps, n, seed):
    """Some beyond their limits, float32 (steps, n, 4)."""
    return np.random.default_rng(seed).uniform(-1.3, 1.3, (steps, n, 4)).astype(np.float32)


def begin(tape, seed=0):
    """Begin a recording with rotor speeds that no command is equal to.

    There a rotor's rate jumps, and nothing has a derivative.
    """
    tape.reset()
    batch = tape.batch
    batch.state[ROTOR_SPEEDS] *= np.random.default_rng(seed).uniform(0.9, 1.1, (4, batch.n))
    batch.observe()


class LinearCost:
    """A random linear cost of the states, actions and observations that count.

    :param observed: whether observations cost.
    """

    def __init__(self, tape, seed, observed=True):
        generator = np.random.default_rng(seed)
        steps, n = tape.n_steps, tape.batch.n
        self.states = np.zeros((steps, STATE_SIZE, n))
        weights = generator.standard_normal((steps, MOVING, n)) / SCALE[:, None]
        self.states[:, :MOVING] = np.where(tape.counts[:, None], weights, 0.0)
        weights = generator.standard_normal((steps, n, 4))
        self.actions = np.where(tape.counts[:, :, None], weights, 0.0)
        size = tape.batch.observation.size
        # One more, of the last observation, which leads to no action
        self.observations = np.zeros((steps + 1, n, size), np.float32)
        if observed:
            weights = generator.standard_normal((steps, n, size))
            acts = np.arange(tape.n_steps)[:, None] < tape.ends
            self.observations[:-1] = np.where(acts[:, :, None], weights, 0.0)

    def __call__(self, states, actions, counts):
        """As the tape takes it."""
        value = (self.states * states).sum() + (self.actions * actions).sum()
        return value, self.states.copy(), self.actions.copy()

    def of(self, flight):
        """The cost of a flight in PyTorch."""
        states = th.tensor(self.states[:, :MOVING]).transpose(1, 2)
        observations = th.tensor(self.observations[:-1]).double()
        return (
            (states * flight.states).sum()
            + (th.tensor(self.actions) * flight.actions).sum()
            + (observations * flight.observations).sum()
        )


def gradients(tape, cost):
    """Return the gradients with respect to actions (steps, n, 4) and to the start state (17, n)."""
    tape.begin(cost)
    grad_actions = [
        tape.backward(step, cost.observations[step + 1]) for step in reversed(range(tape.n_steps))
    ]
    return np.array(grad_actions[::-1]), tape.grad_start.copy()


def assert_close(ours, theirs, relative, axis):
    """Assert that numbers agree, relative to the largest along the axes: of a row's gradient."""
    error = np.abs(ours - theirs).max(axis)
    assert np.isfinite(ours).all() and (error <= relative * np.abs(theirs).max(axis)).all()


def record_and_compare(tape, actions, seed):
    """Record a flight from the present start, and compare it and its gradients with PyTorch's."""
    batch = tape.batch
    before = batch.snapshot()
    observations = [batch.observe(), *(tape.step(action) for action in actions)]
    after = batch.snapshot()
    cost = LinearCost(tape, seed)
    grad_actions, grad_start = gradients(tape, cost)

    batch.restore(before)
    free = th.tensor(actions).double().requires_grad_()
    start = th.tensor(batch.state[:MOVING].T.copy()).requires_grad_()
    flight = fly(batch, lambda step, _: free[step], tape.n_steps, tape.substeps, start)
    batch.restore(after)
    states = flight.states.detach().numpy().transpose(0, 2, 1) / SCALE[:, None]
    np.testing.assert_allclose(tape.states[1:, :MOVING] / SCALE[:, None], states, atol=1e-9)
    # Observations are float32.
    np.testing.assert_allclose(
        observations[:-1], flight.observations.detach(), rtol=2e-6, atol=2e-6
    )
    expected = th.autograd.grad(cost.of(flight), (free, start))
    # Noise is float32, and all else of the backward pass float64.
    tolerance = 1e-6 if batch.scaling[-2:].any() else 1e-11
    assert_close(grad_actions, expected[0].numpy(), tolerance, (0, 2))
    assert_close(grad_start * SCALE[:, None], expected[1].numpy().T * SCALE[:, None], tolerance, 0)
    return grad_actions


SHARED = load_vehicle("cf21B_500").model_copy(update={"saturation": "shared"})
VEHICLES = {
    "vehicle": st.sampled_from(["itm", "l2f_crazyflie", "cf21B_500", "rotorpy_hummingbird", SHARED])
}
RANDOM = {
    "mass": st.just([0.8, 1.2]),
    "inertia": st.just([0.7, 1.4]),
    "motor_gain": st.just([0.5, 1.0]),
    "motor_gain_down": st.just([0.4, 0.9]),
    "thrust": st.just([0.9, 1.1]),
    "battery": st.just([0.95, 1.0]),
    "center_of_mass": st.just([-0.01, 0.01]),
    "delay": st.sampled_from([[0, 4], [0, 1], [3, 3]]),
    "drag": st.just([0.1, 1.0]),
    "force": st.sampled_from(
        [
            {"magnitude": [0, 0.5], "unit": "weight"},
            {"magnitude": 0.2, "unit": "weight", "frame": "body"},
        ]
    ),
    "torque": st.sampled_from(
        [
            {"magnitude": [0, 0.05], "unit": "weight"},
            {"magnitude": 0.03, "unit": "weight", "frame": "world"},
        ]
    ),
    "gusts": st.just({"std": [0, 0.2], "unit": "weight", "time_constant": 0.1}),
    "wind": st.just([0, 5]),
    "wind_gusts": st.just({"std": [0, 2]}),
    "rotors": st.just([0.95, 1.15]),
    "rotor_drag": st.just([0.1, 1.0]),
    "translational_lift": st.just([0, 0.1]),
    "airspeed_moment": st.just([-5, 15]),
    "rate_damping": st.just([0, 8]),
    "rotor_inertia": st.just([0, 0.05]),
    "ground_effect_radius": st.just([20, 200]),
    "rate_gains": st.just([0.5, 2.0]),
    "rate_lag": st.just([0.0, 0.02]),
}
ESTIMATOR = {"position": 0.3, "velocity": [0, 0.5], "attitude": 20, "body_rates": 0.5}
SEEN = {
    "action": st.just("rates"),
    "noise": st.sampled_from(
        [
            0.0,
            0.2,
            {"relative": 0.1, "additive": 0.05},
            {"additive": 0.02},
            {"estimator": ESTIMATOR},
        ]
    ),
    "last_action": st.just(True),
    "history": st.sampled_from([[0, 1], [0, 2, 5], [0, 1, 2, 3, 10]]),
    "position_integral": st.sampled_from(
        [{}, {"gain": 3, "distance": 1, "speed": 4, "limit": 0.05}]
    ),
    "observation_mean": st.just(np.linspace(-0.5, 0.5, 18).tolist()),
    "observation_std": st.just(np.linspace(0.5, 6.0, 18).tolist()),
    "preview": st.just([0, 3, 20]),
    "reference": st.sampled_from(
        [
            "figure_eight",
            {"curve": "circle", "heading": "path"},
            {"curve": "random_smooth", "heading": "random", "heading_rate": 2.0},
        ]
    ),
}
DISTRIBUTION = {"vehicles": st.just({"distribution": "raptor"})}


@settings(max_examples=settings().max_examples // 5)
@given(
    vehicle=st.fixed_dictionaries(VEHICLES, optional=DISTRIBUTION),
    randomize=st.fixed_dictionaries({}, optional=RANDOM),
    seen=st.fixed_dictionaries({}, optional=SEEN),
    steps=st.integers(1, 50),
    substeps=st.sampled_from([2, 4]),
    seed=st.integers(0, 2**31),
)
@example(
    # Every term of the air, near and far from where the ground effect ends
    vehicle={"vehicle": "cf21B_500"},
    randomize={
        "rotors": [0.85, 1.15],
        "rotor_drag": [0.1, 1.0],
        "translational_lift": [0, 0.1],
        "airspeed_moment": [-5, 15],
        "rate_damping": [0, 8],
        "rotor_inertia": [0, 0.05],
        "ground_effect_radius": [200, 1000],
        "wind": [0, 5],
    },
    seen={},
    steps=50,
    substeps=4,
    seed=3,
)
@example(
    # Where the integral stops and goes on depends on the noise.
    vehicle={},
    randomize={},
    seen={
        "noise": {"relative": 0.1, "additive": 0.05},
        "position_integral": {"gain": 3, "distance": 0.3, "speed": 3, "limit": 0.05},
    },
    steps=30,
    substeps=2,
    seed=0,
)
@example(
    vehicle={},
    randomize={},
    seen={
        "noise": {"relative": 0.1, "additive": 0.05},
        "reference": {"curve": "random_smooth", "heading": "random", "heading_rate": 2.0},
        "position_integral": {"gain": 3, "distance": 1, "speed": 4, "limit": 0.05},
        "history": [0, 2],
    },
    steps=30,
    substeps=2,
    seed=2,
)
@example(
    vehicle={},
    randomize={"delay": [0, 3]},
    seen={
        "noise": {"estimator": {**ESTIMATOR, "share": 0.5}},
        "reference": {"curve": "random_smooth", "heading": "random", "heading_rate": 2.0},
        "position_integral": {},
        "preview": [0, 5],
        "history": [0, 2],
        "last_action": True,
    },
    steps=40,
    substeps=2,
    seed=1,
)
def test_flights_and_gradients_are_those_of_autograd(
    vehicle, randomize, seen, steps, substeps, seed
):
    batch = new_batch(20, seed, **vehicle, randomize=randomize, **seen)
    tape = FlightTape(batch, steps, substeps)
    begin(tape, seed)
    record_and_compare(tape, random_actions(steps, batch.n, seed), seed)


@pytest.mark.parametrize("saturation", ["each", "shared"])
def test_gradients_go_through_a_battery_that_limits_every_rotor_and_stops_some(saturation):
    changes = {"saturation": saturation, "rotor_thrust_limits": [0.001, 0.3]}
    vehicle = load_vehicle("cf2x_L250").model_copy(update=changes)
    batch = new_batch(64, 0, vehicle=vehicle, randomize={"battery": [0.3, 0.5], "delay": [0, 2]})
    tape = FlightTape(batch, 12, 2)
    begin(tape)
    actions = random_actions(12, batch.n, 0)
    record_and_compare(tape, actions, 0)
    assert (batch.queue == 0.0).any() == (saturation == "shared")


def test_a_feature_without_a_gradient_is_refused(monkeypatch):
    monkeypatch.setitem(FEATURE_SIZES, "rotor_speeds", 4)
    with pytest.raises(ConfigError, match="rotor_speeds"):
        FlightTape(new_batch(2, 0), 4)


def test_rows_of_different_noise_have_the_gradients_of_their_own():
    batch = new_batch(12, 2, noise=0.2, position_integral={"distance": 0.5, "speed": 3.0})
    batch.set_noise({"relative": 0.1, "additive": 0.05}, [3, 4])
    batch.set_noise({"additive": 0.1}, [7])
    batch.set_noise(0.0, [8])
    tape = FlightTape(batch, 20, 2)
    begin(tape)
    record_and_compare(tape, random_actions(20, batch.n, 0), 0)


def test_the_number_of_threads_changes_no_bit():
    keywords = {
        "randomize": {"mass": [0.8, 1.2], "delay": [0, 2], "gusts": {"std": 1.0}},
        "last_action": True,
        "history": [0, 1],
        "position_integral": {"distance": 10.0, "speed": 10.0},
    }
    n, steps = 600, 6
    found = []
    for threads in (1, 2, 2, 2):
        tape = FlightTape(new_batch(n, 5, threads, **keywords), steps, 2)
        assert tape.batch.helpers == threads - 1
        begin(tape)
        for action in random_actions(steps, n, 0):
            tape.step(action)
        found.append((tape, *gradients(tape, LinearCost(tape, 1))))
    for tape, grad_actions, grad_start in found[1:]:
        np.testing.assert_array_equal(tape.states, found[0][0].states)
        np.testing.assert_array_equal(grad_actions, found[0][1])
        np.testing.assert_array_equal(grad_start, found[0][2])
    assert grad_actions.any(axis=(0, 2)).all() and grad_start.any(axis=0).all()


CARRIED = {
    "randomize": {"delay": [0, 3], "drag": 0.3, "wind_gusts": {"std": 1.0}},
    "last_action": True,
    "history": [0, 3, 7],
    "position_integral": {"distance": 10.0, "speed": 10.0},
}
LOST = [1, 4]


def doomed(batch):
    """Let one row of :data:`LOST` hit the ground, and the other leave the range."""
    batch.state[POSITION, 1] = [0.0, 0.0, 0.4]
    batch.state[VELOCITY, 1] = [0.0, 0.0, -3.0]
    batch.state[POSITION, 4] += [29.9, 0.0, 0.0]
    batch.state[VELOCITY, 4] = [2.0, 0.0, 0.0]
    batch.observe()


def test_a_lost_row_has_no_gradient_from_there_on_and_disturbs_no_other():
    steps = 25
    actions = random_actions(steps, 6, 0)
    found = []
    for is_doomed in (True, False):
        tape = FlightTape(new_batch(6, 7, **CARRIED), steps, 2)
        begin(tape)
        if is_doomed:
            doomed(tape.batch)
            lost = record_and_compare(tape, actions, 1)
            assert np.flatnonzero(tape.lost).tolist() == LOST
            lengths = tape.lengths.copy()
            assert (lengths[LOST] < steps).all() and (np.delete(lengths, LOST) == steps).all()
        else:
            for action in actions:
                tape.step(action)
            assert not tape.lost.any()
        cost = LinearCost(tape, 1)
        # Whatever a policy answers there
        cost.observations[np.arange(steps + 1)[:, None] >= tape.lengths] = np.nan
        found.append(gradients(tape, cost))
        kept = np.delete(np.arange(6), LOST)
    np.testing.assert_array_equal(found[0][0][:, kept], found[1][0][:, kept])
    np.testing.assert_array_equal(found[0][1][:, kept], found[1][1][:, kept])
    np.testing.assert_array_equal(found[0][0], lost)
    for row in LOST:
        # The last action leads to the crash, which does not count.
        assert not lost[lengths[row] - 1 :, row].any() and lost[: lengths[row] - 1, row].any()


def test_below_the_ground_a_crashed_row_has_the_gradient_of_the_whole_recording():
    steps = 25
    tape = FlightTape(new_batch(6, 7, **CARRIED), steps, 2, end_at_ground=False)
    begin(tape)
    doomed(tape.batch)
    # The last row crashes, then leaves the range.
    state = tape.batch.state
    height = state[X.target + 2, 5]
    state[POSITION, 5] = state[X.target : X.target + 3, 5]
    state[POSITION, 5] += [np.sqrt(29.8**2 - height**2), 0.0, 0.3 - height]
    state[VELOCITY, 5] = [2.0, 0.0, -3.0]
    tape.batch.observe()
    gradient = record_and_compare(tape, random_actions(steps, 6, 0), 1)
    assert np.flatnonzero(tape.lost).tolist() == [*LOST, 5]
    crashed, left = LOST
    assert tape.states[-1, X.position + 2, crashed] < 0.0 and tape.lengths[crashed] < steps
    assert gradient[:, crashed].any(axis=1).all()
    assert not gradient[tape.lengths[left] - 1 :, left].any()
    assert tape.lengths[5] < tape.ends[5] < steps


def test_flights_that_carry_on_have_the_gradient_of_what_follows():
    steps, n = 25, 6
    tape = FlightTape(new_batch(n, 7, **CARRIED), steps, 2)
    begin(tape)
    doomed(tape.batch)
    for action in random_actions(steps, n, 0):
        tape.step(action)
    assert np.flatnonzero(tape.lost).tolist() == LOST
    for recording in (1, 2):
        before, lost = tape.batch.state.copy(), tape.lost.copy()
        tape.reset(continue_flights=True)
        goes_on = (tape.batch.state == before).all(axis=0)
        np.testing.assert_array_equal(goes_on, ~lost)
        assert not tape.lost.any()
        record_and_compare(tape, random_actions(steps, n, recording), recording)
        assert not tape.lost.any()


def new_policy(inputs, outputs, widths, activation):
    return ActorCriticPolicy(
        gymnasium.spaces.Box(-10.0, 10.0, (inputs,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (outputs,), np.float32),
        lambda _: 1e-3,
        net_arch=widths,
        activation_fn=activation,
        ortho_init=False,
    )


@settings(max_examples=settings().max_examples // 5)
@given(
    widths=st.lists(st.integers(1, 70), max_size=3),
    activation=st.sampled_from([nn.Tanh, nn.ReLU, nn.ELU]),
    inputs=st.integers(1, 40),
    outputs=st.integers(1, 5),
    rows=st.integers(1, 600),
    calls=st.integers(1, 3),
    seed=st.integers(0, 2**31),
)
def test_a_gradient_goes_through_a_policy_as_by_autograd(
    widths, activation, inputs, outputs, rows, calls, seed
):
    th.manual_seed(seed)
    policy = new_policy(inputs, outputs, widths, activation)
    network = network_of(policy)
    is_compiled = isinstance(network, Perceptrons)
    assert is_compiled == (activation is not nn.ELU or not widths)
    twin = deepcopy(policy)
    recorded = network.recorded(calls, rows)
    observed, given = th.randn(calls, rows, inputs), th.randn(calls, rows, outputs).double()
    for step in range(calls):
        actions = recorded.forward(step, observed[step].numpy())
        means = twin.get_distribution(observed[step]).mode()
        np.testing.assert_allclose(actions, means.detach(), rtol=1e-4, atol=2e-6)
    for step in reversed(range(calls)):
        ours = recorded.backward(step, given[step].numpy())
        free = observed[step].clone().requires_grad_()
        twin.get_distribution(free).mode().backward(given[step].float())
        assert ours.dtype == np.float32
        assert_close(ours, free.grad.numpy(), 1e-5, None)
    for (name, one), other in zip(policy.named_parameters(), twin.parameters(), strict=True):
        assert (one.grad is None) == (other.grad is None), name
        if one.grad is not None:
            assert_close(one.grad.numpy(), other.grad.numpy(), 1e-5, None)


class Snapshots(BaseCallback):
    """Keeps what each rollout of a batch begins with."""

    def __init__(self, batch):
        super().__init__()
        self.batch = batch

    def _on_rollout_start(self):
        self.kept = self.batch.snapshot()
        policy = self.model.policy
        self.actor = deepcopy(nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net))

    def _on_step(self):
        return True


@pytest.mark.parametrize("activation", [nn.Tanh, nn.ELU])
def test_apg_follows_the_gradient_of_the_flight_and_the_policy_together(activation):
    n, steps = 8, 15
    env = QuadcopterVecEnv(
        n,
        "state_recovery",
        randomize={"mass": [0.9, 1.1], "delay": [0, 2], "drag": 0.3, "gusts": {"std": 1.0}},
        last_action=True,
        history=[0, 2],
        position_integral={"distance": 10.0, "speed": 10.0},
        seed=0,
    )
    model = APG(
        "MlpPolicy",
        env,
        n_steps=steps,
        max_grad_norm=1e9,
        max_row_ratio=1e9,
        policy_kwargs={"net_arch": [17, 16], "activation_fn": activation},
        seed=0,
        device="cpu",
    )
    with th.no_grad():  # so that what is observed matters, and some actions are clipped
        model.policy.action_net.weight *= 100.0
    start = Snapshots(env.batch)
    # The second update must forget the gradient of the first.
    model.learn(2 * n * steps, callback=start)

    actor = start.actor.double()
    actor.zero_grad()
    batch = env.batch
    batch.restore(start.kept)
    batch.reset()
    reference = th.tensor(batch.state[MOVING:].T).expand(steps, n, -1)
    flight = fly(batch, lambda _, seen: actor(seen), steps, model.substeps)
    parts = State.of(flight.states.movedim(2, 0).flatten(1))
    parts = [part.unflatten(0, (steps, n)) for part in parts]
    flight_cost(
        FlownStates._make([*parts, *reference.split([3, 3, 3, 2, 1, 3], 2), flight.actions])
    ).mean().backward()
    beyond = (flight.actions.abs() > 1.0).double().mean()
    assert 0.02 < beyond < 0.7

    trained = [*model.policy.mlp_extractor.policy_net.parameters()]
    trained += model.policy.action_net.parameters()
    for one, other in zip(trained, actor.parameters(), strict=True):
        assert_close(one.grad.numpy(), other.grad.numpy(), 1e-4, None)
