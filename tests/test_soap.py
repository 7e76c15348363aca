"""SOAP against Adam, and what its state says to other optimizers."""

import copy

import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_quad import APG, QuadcopterVecEnv
from sb3_quad.algorithms.soap import REFRESH, SOAP


def problem(seed):
    """Return a loss whose curvature is large in a few directions, none of them an axis."""
    generator = th.Generator().manual_seed(seed)

    def skewed(n):
        turn = th.linalg.qr(th.randn(n, n, generator=generator))[0]
        return turn * th.logspace(0.0, -2.0, n)

    left, right = skewed(12), skewed(8)
    return lambda weight, bias: (left.T @ weight @ right).square().sum() + bias.square().sum()


def start():
    return [th.ones(12, 8, requires_grad=True), th.ones(8, requires_grad=True)]


def descend(optimizer, parameters, loss, steps):
    for _ in range(steps):
        optimizer.zero_grad()
        loss(*parameters).backward()
        optimizer.step()
    return loss(*parameters).item()


def least(kind, seed):
    """Return the lowest loss that 100 updates reach by one of three learning rates."""
    losses = []
    for rate in (0.1, 0.2, 0.4):
        parameters = start()
        losses.append(descend(kind(parameters, lr=rate), parameters, problem(seed), 100))
    return min(losses)


def test_it_descends_further_than_adam_where_weights_are_correlated():
    """Over five problems, by the geometric mean, which is about 0.43; single ones vary a lot."""
    ratios = [least(SOAP, seed) / least(th.optim.Adam, seed) for seed in range(5)]
    assert th.tensor(ratios).log().mean().exp() < 0.9


def growth(seed):
    """Return how much longer the update with the first changed bases is than the one before."""
    th.manual_seed(seed)
    weights = th.zeros(16, 32, requires_grad=True)
    optimizer = SOAP([weights])
    lengths = []
    for _ in range(REFRESH):
        before = weights.detach().clone()
        # Large in a few directions, and each gradient spans some others
        weights.grad = th.logspace(0.0, -3.0, 16)[:, None] * th.randn(16, 4) @ th.randn(4, 32)
        optimizer.step()
        lengths.append(th.dist(weights, before).item())
    return lengths[-1] / lengths[-2]


def test_the_first_change_of_bases_does_not_lengthen_the_update():
    """By the geometric mean, which is about 2; with bases in another order it is 18."""
    assert th.tensor([growth(seed) for seed in range(20)]).log().mean().exp() < 4.0


def test_its_state_resumes_exactly():
    whole, parts = start(), start()
    loss = problem(0)
    descend(SOAP(whole, lr=0.02), whole, loss, 23)
    first = SOAP(parts, lr=0.02)
    descend(first, parts, loss, 11)
    second = SOAP(parts, lr=0.5)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    descend(second, parts, loss, 12)
    for a, b in zip(whole, parts, strict=True):
        th.testing.assert_close(a, b, rtol=0.0, atol=0.0)


def test_adam_and_soap_take_the_state_of_the_other():
    for before, after in ((SOAP, th.optim.Adam), (th.optim.Adam, SOAP)):
        parameters = start()
        first = before(parameters, lr=0.02)
        middle = descend(first, parameters, problem(1), 20)
        second = after(parameters, lr=0.02)
        second.load_state_dict(first.state_dict())
        assert descend(second, parameters, problem(1), 40) < middle


def test_a_zip_names_adam_and_loads_in_plain_sb3(tmp_path):
    env = QuadcopterVecEnv(2, seed=0)
    model = APG("MlpPolicy", env, n_steps=10, seed=0).learn(40)
    assert isinstance(model.policy.optimizer, SOAP)
    model.save(tmp_path / "agent")

    stock = PPO.load(tmp_path / "agent")
    assert type(stock.policy.optimizer) is th.optim.Adam
    again = APG.load(tmp_path / "agent", env=env)
    assert isinstance(again.policy.optimizer, SOAP)
    assert str(again.policy.optimizer.state_dict()) == str(model.policy.optimizer.state_dict())


@pytest.mark.parametrize("kind", [th.optim.Adam, th.optim.SGD])
def test_an_optimizer_class_of_the_user_holds(kind):
    kwargs = {"optimizer_class": kind}
    model = APG("MlpPolicy", QuadcopterVecEnv(2, seed=0), n_steps=10, policy_kwargs=kwargs)
    assert type(model.policy.optimizer) is kind
