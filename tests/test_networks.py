"""Compiled perceptrons: what PyTorch's own layers give, however many threads take part."""

import itertools
import os
from typing import get_args

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn
from torch.nn.utils import parameters_to_vector

from sb3_quad import APG, PPOBC, DAgger, GeometricExpert
from sb3_quad.algorithms import dagger, ppo_bc
from sb3_quad.algorithms.buffers import Batch
from sb3_quad.algorithms.losses import CloningLoss, Loss, agree
from sb3_quad.algorithms.networks import Network
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.fast import accelerate
from sb3_quad.fast.losses import CLONING, numbers
from sb3_quad.fast.perceptron import Perceptron, one_torch_thread

ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU}


def perceptron(widths, activation="tanh", seed=0):
    th.manual_seed(seed)
    layers = [(nn.Linear(*pair), ACTIVATIONS[activation]()) for pair in itertools.pairwise(widths)]
    return nn.Sequential(*[each for layer in layers for each in layer][:-1])


def cloning(net, x, labels, index):
    """The loss "mse" over some rows, and its gradient with respect to each parameter, from
    compiled code.
    """
    log_std = nn.Parameter(th.zeros(labels.shape[1]))
    batch = Batch(index, x.numpy(), labels.numpy())
    terms = Perceptron([*net]).gradient(batch, numbers(Loss(bc_coef=1.0)), log_std)
    return [
        th.tensor(terms[CLONING]),
        *(parameter.grad.clone() for parameter in net.parameters()),
    ]


@settings(max_examples=settings().max_examples // 2)
@given(
    widths=st.lists(st.integers(1, 70) | st.just(300), min_size=2, max_size=5),
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
    for one, other in zip(
        ours, [loss.detach(), *(parameter.grad for parameter in net.parameters())], strict=True
    ):
        th.testing.assert_close(
            one.float(), other, rtol=1e-4, atol=1e-5 * float(other.abs().max()) + 1e-7
        )


@pytest.fixture
def threads():
    before = th.get_num_threads()
    yield th.set_num_threads
    th.set_num_threads(before)


def test_the_number_of_threads_changes_no_bit(threads):
    net, x, labels, index = (
        perceptron([18, 64, 64, 4]),
        th.randn(4096, 18),
        th.randn(4096, 4),
        np.arange(4096),
    )
    alone = cloning(net, x, labels, index)
    for count in (2, 3, 8):
        threads(count)
        with one_torch_thread():
            assert th.get_num_threads() == 1
            for _ in range(20):
                assert all(
                    th.equal(*pair)
                    for pair in zip(alone, cloning(net, x, labels, index), strict=True)
                )
        assert th.get_num_threads() == count


@pytest.mark.parametrize("algorithm", [DAgger, PPOBC])
def test_from_the_seed_to_the_trained_weights_the_number_of_threads_changes_no_bit(
    algorithm, threads
):
    weights = []
    for count in (1, 2, 3):
        threads(count)
        env = QuadcopterVecEnv(48, "state_recovery", max_episode_steps=20, seed=0)
        rollout = {"n_steps": 25, "batch_size": 600, "n_epochs": 2}
        model = algorithm(
            "MlpPolicy", env, expert=GeometricExpert(), **rollout, seed=0, device="cpu"
        )
        begun = parameters_to_vector(model.policy.parameters())
        model.learn(2400)
        weights.append((begun, parameters_to_vector(model.policy.parameters())))
        assert th.get_num_threads() == count and not th.equal(*weights[-1])
    for stage, alone in enumerate(weights[0]):
        assert all(th.equal(alone, other[stage]) for other in weights[1:]), ("begun", "trained")[
            stage
        ]


def test_a_forked_child_computes_alone(threads):
    net, x = Perceptron([*perceptron([18, 64, 4])]), np.ones((4096, 18), np.float32)
    threads(2)
    with one_torch_thread():
        expected = net(x)
        child = os.fork()
        if child == 0:
            os._exit(0 if (net(x) == expected).all() else 1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_what_is_not_finite_stays_so(value, activation):
    net, x = perceptron([3, 8, 2], activation), th.randn(300, 3)
    x[7, 1] = value
    rows = np.isfinite(Perceptron([*net])(x.numpy())).all(axis=1)
    assert not rows[7] and rows.sum() == 299
    assert not all(
        th.isfinite(each).all() for each in cloning(net, x, th.zeros(300, 2), np.arange(300))[1:]
    )


ON_POLICY = [
    *({"bc_coef": 2.0, "bc_loss": kind, "bc_filter": "none"} for kind in get_args(CloningLoss)),
    *({"bc_coef": 0.5, "bc_loss": kind, "clip_range_vf": 0.1} for kind in ("mse", "nll")),
    {"bc_coef": 0.5, "normalize_advantage": False, "clip_range": 0.05, "target_kl": 1e9},
    {"bc_coef": 1.0, "bc_filter": "none", "ent_coef": 0.01, "l2_coef": 0.1},
    {"bc_coef": 1.0, "critic_warmup": 9, "clip_range_vf": 0.1, "l2_coef": 0.1},
]
IMITATION = [
    *({"bc_loss": kind, "vf_coef": 0.5} for kind in get_args(CloningLoss)),
    {"policy_kwargs": {"net_arch": [32, 32, 16]}, "clip_range_vf": 0.1},
    {"ent_coef": 0.01, "l2_coef": 0.1, "clip_range_vf": 0.1},
]


@pytest.mark.parametrize(
    ("algorithm", "module", "settings"),
    [
        *((PPOBC, ppo_bc, settings) for settings in ON_POLICY),
        *((DAgger, dagger, settings) for settings in IMITATION),
    ],
)
def test_compiled_gradients_are_those_of_the_loss_in_train(
    monkeypatch, algorithm, module, settings
):
    """One mini-batch, by the compiled loss and by autograd, from a policy that has moved on."""
    one_step = {"n_steps": 25, "batch_size": 500, "n_epochs": 1, "critic_warmup": 0}
    if algorithm is DAgger:
        one_step = {"n_steps": 25, "batch_size": 500, "n_epochs": 1, "gradient_steps": None}
    model = algorithm(
        "MlpPolicy",
        QuadcopterVecEnv(20, "state_recovery", seed=0, max_episode_steps=20),
        expert="geometric",
        max_grad_norm=float("inf"),
        seed=0,
        device="cpu",
        **{**one_step, **settings},
    )
    monkeypatch.setattr(model, "train", lambda: None)
    model.learn(500)
    monkeypatch.undo()
    th.manual_seed(0)
    with th.no_grad():  # so that ratios, values and clips are not those of the rollout
        for parameter in model.policy.parameters():
            parameter += 0.03 * th.randn_like(parameter)
    start = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    assert accelerate(model.policy) is not None
    found = []
    for network_of in (accelerate, Network):
        monkeypatch.setattr(module, "network_of", network_of)
        model.policy.load_state_dict(start)
        model._n_updates = 0
        np.random.seed(0)  # noqa: NPY002 - PPOBC's mini-batches come from it, as PPO's do
        model.train()
        logged = {
            name: value
            for name, value in model.logger.name_to_value.items()
            if name.startswith("train/") and name not in ("train/std", "train/n_updates")
        }
        gradients = {name: parameter.grad for name, parameter in model.policy.named_parameters()}
        found.append((logged, gradients))
    (ours, compiled), (theirs, plain) = found
    assert "train/loss" in ours and ours == pytest.approx(theirs, rel=1e-4, abs=1e-6)
    for name, parameter in model.policy.named_parameters():  # no gradient is one of zero
        one, other = (
            th.zeros_like(parameter) if grads[name] is None else grads[name]
            for grads in (compiled, plain)
        )
        th.testing.assert_close(one, other, rtol=1e-3, atol=1e-5 * float(other.abs().max()) + 1e-8)


@pytest.mark.parametrize(("bc_filter", "kept"), [("none", [0, 1, 2]), ("agreement", [0, 1])])
def test_rows_that_are_filtered_out_count_as_zero(bc_filter, kept):
    policy = PPO("MlpPolicy", "Pendulum-v1", device="cpu").policy
    for parameter in policy.parameters():
        parameter.data.zero_()  # so that every mean action is zero
    labels, advantages = np.array([[0.1], [-0.2], [0.4]]), np.array([[1.0], [-1.0], [0.0]])
    batch = Batch(
        np.arange(3),
        np.zeros((3, 3), np.float32),
        np.hstack([labels, 0 * labels, 0 * labels, advantages], dtype=np.float32),
    )
    loss = Loss(bc_coef=1.0, bc_filter=bc_filter)
    terms = accelerate(policy).gradients(loss, batch, None)
    assert terms["bc_loss"] == pytest.approx(np.square(labels[kept]).sum() / 3)
    agreeing = agree(th.zeros(3, 1), th.as_tensor(labels))
    assert agreeing.nonzero().flatten().tolist() == [0, 1]


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
    policy = PPO(
        "MlpPolicy", QuadcopterVecEnv(4, seed=0), policy_kwargs=keywords, device="cpu"
    ).policy
    x = th.randn(500, 18)
    assert (accelerate(policy) is not None) == computed
    network = accelerate(policy) or Network(policy)
    means, values = (
        policy.get_distribution(x).mode().detach(),
        policy.predict_values(x).detach()[:, 0],
    )
    np.testing.assert_allclose(network.means(x.numpy()), means, atol=1e-6)
    np.testing.assert_allclose(network.values(x.numpy()), values, atol=1e-6)
    if not computed:
        return
    th.manual_seed(1)
    with th.no_grad(), network.acting():
        ours = policy(x)
    th.manual_seed(1)
    for one, other in zip(ours, policy(x), strict=True):
        th.testing.assert_close(one, other.detach(), rtol=1e-4, atol=1e-5)


class HalfPolicy(ActorCriticPolicy):
    """Gives half of what its actor does."""

    def _get_action_dist_from_latent(self, latent_pi):
        mean = 0.5 * self.action_net(latent_pi)
        return self.action_dist.proba_distribution(mean, self.log_std)


def test_a_policy_with_methods_of_its_own_is_left_to_pytorch():
    model = DAgger(HalfPolicy, QuadcopterVecEnv(4, seed=0), device="cpu")
    assert accelerate(model.policy) is None


def test_layers_that_actor_and_critic_share_are_left_to_pytorch():
    policy = PPO("MlpPolicy", QuadcopterVecEnv(4, seed=0), device="cpu").policy
    policy.mlp_extractor.value_net = policy.mlp_extractor.policy_net
    assert accelerate(policy) is None


@pytest.mark.parametrize(
    ("algorithm", "keywords"),
    [
        (PPOBC, {"expert": "pid", "critic_warmup": 0, "bc_loss": "nll", "bc_filter": "none"}),
        (DAgger, {"expert": "pid", "bc_loss": "nll"}),
        (APG, {}),
    ],
)
@pytest.mark.parametrize("frozen", ["mlp_extractor.policy_net.0.weight", "log_std"])
def test_a_frozen_parameter_stays(algorithm, keywords, frozen):
    model = algorithm(
        "MlpPolicy", QuadcopterVecEnv(8, seed=0), n_steps=16, seed=0, device="cpu", **keywords
    )
    parameters = dict(model.policy.named_parameters())
    parameters[frozen].requires_grad = False
    before = {name: parameter.detach().clone() for name, parameter in parameters.items()}
    model.learn(128)
    assert th.equal(parameters[frozen], before[frozen])
    assert not th.equal(parameters["action_net.bias"], before["action_net.bias"])


def test_layers_with_hooks_or_of_other_types_are_left_to_pytorch():
    net = perceptron([3, 8, 2])
    assert Perceptron.fits([*net])
    net[1].register_forward_hook(lambda *_: None)
    assert not Perceptron.fits([*net])
    assert not Perceptron.fits([*perceptron([3, 8, 2]).double()])
