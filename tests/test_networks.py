"""Compiled perceptrons: what PyTorch's own layers give, however many threads take part."""

import itertools
import os
from unittest.mock import patch

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import PPO
from torch import nn

from sb3_quad import PPOBC, DAgger, GeometricExpert
from sb3_quad.algorithms import common
from sb3_quad.algorithms.networks import Perceptron, losses, mlp, shared_out
from sb3_quad.envs import QuadcopterVecEnv

ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU}


def perceptron(widths, activation="tanh", seed=0):
    th.manual_seed(seed)
    layers = [(nn.Linear(*pair), ACTIVATIONS[activation]()) for pair in itertools.pairwise(widths)]
    return nn.Sequential(*[each for layer in layers for each in layer][:-1])


def cloning(net, x, labels, index):
    """The loss "mse" over some rows, and its gradient by each parameter, from compiled code."""
    log_std = nn.Parameter(th.zeros(labels.shape[1]))
    terms = Perceptron([*net]).gradient(x.numpy(), index, labels.numpy(), common.actor_terms("mse", 1.0), log_std)
    return [th.tensor(terms[losses.CLONING] / len(index)), *(parameter.grad.clone() for parameter in net.parameters())]


@settings(max_examples=30)
@given(
    widths=st.lists(st.integers(1, 70), min_size=2, max_size=5),
    activation=st.sampled_from([*ACTIVATIONS]),
    rows=st.integers(1, 3000),
    seed=st.integers(0, 2**31),
)
def test_outputs_and_gradients_are_those_of_the_layers(widths, activation, rows, seed):
    net, rng = perceptron(widths, activation, seed), np.random.default_rng(seed)
    x, labels, index = (
        3.0 * th.randn(rows, widths[0]),
        th.randn(rows, widths[-1]),
        rng.integers(0, rows, rng.integers(1, 3000)),
    )
    np.testing.assert_allclose(Perceptron([*net])(x.numpy()), net(x).detach(), rtol=1e-4, atol=2e-6)
    ours = cloning(net, x, labels, index)
    net.zero_grad()
    loss = (net(x[index]) - labels[index]).square().mean()
    loss.backward()
    for one, other in zip(ours, [loss.detach(), *(parameter.grad for parameter in net.parameters())], strict=True):
        th.testing.assert_close(one.float(), other, rtol=1e-4, atol=1e-5 * float(other.abs().max()) + 1e-7)


@pytest.fixture
def threads():
    before = th.get_num_threads()
    yield th.set_num_threads
    th.set_num_threads(before)


def test_the_number_of_threads_changes_no_bit(threads):
    net, x, labels, index = perceptron([18, 64, 64, 4]), th.randn(4096, 18), th.randn(4096, 4), np.arange(4096)
    alone = cloning(net, x, labels, index)
    for count in (2, 3, 8):
        threads(count)
        with shared_out(compiled=True):
            assert th.get_num_threads() == 1
            for _ in range(20):
                assert all(th.equal(*pair) for pair in zip(alone, cloning(net, x, labels, index), strict=True))
        assert th.get_num_threads() == count


def test_a_forked_child_computes_with_threads_of_its_own(threads):
    net, x = Perceptron([*perceptron([18, 64, 4])]), np.ones((4096, 18), np.float32)
    threads(2)
    with shared_out(compiled=True):
        expected = net(x)
        child = os.fork()
        if child == 0:
            mlp._helpers.threads = 2
            os._exit(0 if (net(x) == expected).all() else 1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_what_is_not_finite_stays_so(value, activation):
    net, x = perceptron([3, 8, 2], activation), th.randn(300, 3)
    x[7, 1] = value
    rows = np.isfinite(Perceptron([*net])(x.numpy())).all(axis=1)
    assert not rows[7] and rows.sum() == 299
    assert not all(th.isfinite(each).all() for each in cloning(net, x, th.zeros(300, 2), np.arange(300))[1:])


PPO_BC = [
    {"bc_loss": "mse", "bc_coef": 1.0},
    {"bc_loss": "huber", "bc_coef": 2.0, "clip_range_vf": 0.1},
    {"bc_loss": "huber_mse", "bc_coef": 1.0, "bc_filter": "agreement", "l2_coef": 1e-3, "ent_coef": 1e-3},
    {"bc_loss": "nll", "bc_coef": 0.1, "bc_filter": "negative_advantage", "clip_range_vf": 0.2, "max_clipped_value": False},
    {"bc_coef": 0.0, "l2_coef": 1e-4, "normalize_advantage": False},
    {"critic_warmup": 1},
]
DAGGER = [
    {"bc_loss": "mse"},
    {"bc_loss": "huber", "dataset_capacity": 2000, "gradient_steps": 30},
    {"bc_loss": "huber_mse", "l2_coef": 1e-3, "ent_coef": 1e-3},
    {"bc_loss": "nll", "clip_range_vf": 0.2, "max_grad_norm": None},
]


@pytest.mark.parametrize(
    ("algorithm", "keywords"), [*((PPOBC, each) for each in PPO_BC), *((DAgger, each) for each in DAGGER)]
)
def test_a_training_is_the_one_by_autograd(algorithm, keywords):
    def train():
        sizes = {
            "n_steps": 100,
            "batch_size": 400,
            "n_epochs": 3,
            "learning_rate": 1e-3,
            "policy_kwargs": {"log_std_init": -1.0},
        }
        env = QuadcopterVecEnv(16, seed=0)
        model = algorithm("MlpPolicy", env, expert=GeometricExpert(), seed=0, device="cpu", **sizes, **keywords)
        model.learn(1600 if algorithm is PPOBC else 3200)
        logged = {name: value for name, value in model.logger.name_to_value.items() if name.startswith("train/")}
        return logged, [parameter.detach() for parameter in model.policy.parameters()]

    ours, compiled = train()
    with patch.object(common, "perceptrons", lambda policy: None):
        theirs, plain = train()
    assert "train/loss" in ours and ours == pytest.approx(theirs, rel=1e-3, abs=1e-6)
    assert max(float((one - other).abs().max()) for one, other in zip(compiled, plain, strict=True)) < 1e-5


@pytest.mark.parametrize(
    ("keywords", "computed"),
    [
        ({"activation_fn": nn.ReLU, "net_arch": [20]}, True),
        ({"net_arch": []}, True),
        ({"activation_fn": nn.ELU}, False),
        ({"share_features_extractor": False}, True),
    ],
)
def test_policies_give_what_their_own_methods_give(keywords, computed):
    policy = PPO("MlpPolicy", QuadcopterVecEnv(4, seed=0), policy_kwargs=keywords, device="cpu").policy
    networks = common.perceptrons(policy)
    assert (networks is not None) == computed
    x = th.randn(500, 18)
    np.testing.assert_allclose(
        common.outputs(networks, policy, "actor", x.numpy()), policy.get_distribution(x).mode().detach(), atol=1e-6
    )
    np.testing.assert_allclose(
        common.outputs(networks, policy, "critic", x.numpy()), policy.predict_values(x).detach()[:, 0], atol=1e-6
    )
    if networks is not None:
        th.manual_seed(1)
        ours = common.act(networks, policy, x)
        th.manual_seed(1)
        for one, other in zip(ours, policy(x), strict=True):
            th.testing.assert_close(one, other.detach(), rtol=1e-4, atol=1e-5)


def test_layers_that_somebody_listens_to_are_left_to_pytorch():
    net = perceptron([3, 8, 2])
    assert Perceptron.fits([*net])
    net[1].register_forward_hook(lambda *_: None)
    assert not Perceptron.fits([*net])
    assert not Perceptron.fits([*perceptron([3, 8, 2]).double()])
