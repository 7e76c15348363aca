"""Compiled perceptrons: what PyTorch's own layers give, however many threads take part."""

import itertools
import os

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import PPO
from torch import nn

from sb3_quad import common, networks
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.networks import mlp

ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU}


def perceptron(widths, activation="tanh", seed=0):
    th.manual_seed(seed)
    layers = [(nn.Linear(*pair), ACTIVATIONS[activation]()) for pair in itertools.pairwise(widths)]
    return nn.Sequential(*[each for layer in layers for each in layer][:-1])


def outcome(net, x, weights, compiled=True):
    """The output, and the gradient of its weighted sum by each parameter."""
    net.zero_grad()
    y = networks.apply([*net], x) if compiled else net(x)
    (y * weights).sum().backward()
    return [y.detach(), *(parameter.grad.clone() for parameter in net.parameters())]


@settings(max_examples=30)
@given(
    widths=st.lists(st.integers(1, 70), min_size=2, max_size=5),
    activation=st.sampled_from([*ACTIVATIONS]),
    rows=st.integers(1, 3000),
    seed=st.integers(0, 2**31),
)
def test_output_and_gradients_are_those_of_the_layers(widths, activation, rows, seed):
    net = perceptron(widths, activation, seed)
    assert networks.fits([*net])
    x, weights = 3.0 * th.randn(rows, widths[0]), th.randn(rows, widths[-1])
    for ours, theirs in zip(outcome(net, x, weights), outcome(net, x, weights, compiled=False), strict=True):
        assert ours.shape == theirs.shape and ours.dtype == theirs.dtype
        th.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5 * float(theirs.abs().max()) + 1e-6)


def test_the_number_of_threads_changes_no_bit():
    net, x, weights = perceptron([18, 64, 64, 4]), th.randn(4096, 18), th.randn(4096, 4)
    alone = outcome(net, x, weights)
    before = th.get_num_threads()
    try:
        for threads in (2, 3, 8):
            th.set_num_threads(threads)
            for _ in range(20):
                with networks.shared_out(compiled=True):
                    assert th.get_num_threads() == 1
                    shared = outcome(net, x, weights)
                assert all(th.equal(one, other) for one, other in zip(alone, shared, strict=True))
            assert th.get_num_threads() == threads
    finally:
        th.set_num_threads(before)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_what_is_not_finite_stays_so(value, activation):
    net, x = perceptron([3, 8, 2], activation), th.randn(300, 3)
    x[7, 1] = value
    (y, *gradients) = outcome(net, x, th.ones(300, 2))
    assert not th.isfinite(y[7]).all() and th.isfinite(y[:7]).all() and th.isfinite(y[8:]).all()
    assert not all(th.isfinite(gradient).all() for gradient in gradients)


def test_a_forked_child_computes_with_threads_of_its_own():
    net, x = perceptron([18, 64, 4]), th.randn(4096, 18)
    before = th.get_num_threads()
    try:
        th.set_num_threads(2)
        with networks.shared_out(compiled=True):
            expected = networks.apply([*net], x).detach()
            child = os.fork()
            if child == 0:
                mlp._helpers.threads = 2
                os._exit(0 if th.equal(networks.apply([*net], x), expected) else 1)
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    finally:
        th.set_num_threads(before)


@pytest.mark.parametrize(
    "keywords",
    [
        {"activation_fn": nn.Tanh},
        {"activation_fn": nn.ReLU, "net_arch": [20]},
        {"activation_fn": nn.ELU},
        {"share_features_extractor": False},
    ],
)
def test_policies_give_what_their_own_methods_give(keywords):
    env = QuadcopterVecEnv(4, seed=0)
    policy = PPO("MlpPolicy", env, policy_kwargs=keywords, device="cpu").policy
    assert common.is_compiled(policy) == (keywords.get("activation_fn") is not nn.ELU)
    x, actions = th.randn(500, 18), th.rand(500, 4)
    values, log_prob, entropy = policy.evaluate_actions(x, actions)
    ours = common.evaluate_actions(policy, x, actions)
    for one, other in zip(ours, (values.flatten(), log_prob, entropy[0]), strict=False):
        th.testing.assert_close(one, other)
    th.testing.assert_close(common.actor_mean(policy, x), policy.get_distribution(x).mode())


def test_layers_that_somebody_listens_to_are_left_to_pytorch():
    net = perceptron([3, 8, 2])
    net[1].register_forward_hook(lambda *_: None)
    assert not networks.fits([*net])
    assert not networks.fits([*perceptron([3, 8, 2]).double()])
