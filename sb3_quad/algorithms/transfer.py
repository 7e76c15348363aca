"""Starting from a trained agent: its policy and critic, in a new algorithm with a fresh optimiser."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_quad.base.errors import ConfigError, ExpertError
from sb3_quad.base.files import one_line
from sb3_quad.controllers.controller import Controller
from sb3_quad.controllers.zips import load_model


def transfer_policy(path: str | Path, model: BaseAlgorithm) -> None:
    """Give ``model`` the policy and critic of an SB3 zip, of any algorithm with the same spaces and
    networks.

    An off-policy ``model`` also takes an agent with other networks, such as DAgger's: its actor is
    made to imitate that, by :func:`clone_policy`, and its critic stays new. ``model`` then needs
    its environment.

    ``log_std`` comes from the zip, unless the model's settings give a ``log_std_init``: then that
    holds. The optimiser stays as it is, so a new model starts with a fresh one.

    :raises ConfigError: a zip that is missing, not complete or not finite, or whose layers differ;
        the message names them.
    """
    try:
        _, parameters, _ = load_from_zip_file(
            path, load_data=False, device="cpu"
        )  # unpickles nothing
        theirs, ours = dict(parameters["policy"]), model.policy.state_dict()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except Exception as error:  # what a damaged archive raises depends on where the damage is
        raise ConfigError(f"{path}: not a complete SB3 zip ({one_line(error)})") from None
    if isinstance(model, OffPolicyAlgorithm) and theirs.keys() != ours.keys():
        try:
            clone_policy(load_model(path), model, seed=model.seed or 0)
        except ExpertError as error:  # other spaces
            raise ConfigError(f"{path}: {error}") from None
        return
    if not all(th.isfinite(tensor).all() for tensor in theirs.values()):
        raise ConfigError(f"{path}: holds parameters that are not finite")
    if "log_std_init" in model.policy_kwargs and "log_std" in ours:
        theirs["log_std"] = ours["log_std"]
    try:
        model.policy.load_state_dict(theirs)
    except RuntimeError as error:
        what = one_line(error).partition(": ")[2]
        way_out = "train takes them from it unless --conf-file is given"
        raise ConfigError(
            f"{path}: environment spaces and policy_kwargs must be the same ({what}); {way_out}"
        ) from None


CLONE_ROWS = 20_000  # states that are flown for a clone, at least
CLONE_FLIGHT = 500  # steps of each environment, at least
CLONE_STEPS = 2_500  # of Adam
CLONE_ROUNDS = 10  # of flying, then fitting
CLONE_BATCH = 1024
CLONE_RATE = 2e-3  # falls to a hundredth
CLONE_LOG_STD = -2.0  # of a SAC actor without log_std_init; its sampled actions still fly


def clone_policy(teacher: Any, model: OffPolicyAlgorithm, seed: int = 0) -> float:
    """Let the actor of ``model``, SAC's or TD3's, imitate ``teacher`` on states that the two of
    them fly in its environments.

    A squashed Gaussian gives tanh of its mean, a DAgger or PPO agent a mean that is clipped: no
    weights can be copied, so they are fitted, by the squared error of the deterministic actions (an
    error of their arctanh would be all about the limits). One half of the environments is flown by
    the teacher, the other by the present clone, as in DAgger: the states that the clone itself gets
    into are among those it learns from. The deviation of a SAC actor becomes e to the
    ``log_std_init`` of its ``policy_kwargs`` everywhere, e^-2 without one. The environments are
    reset afterwards by whoever learns.

    :param teacher: what :class:`~sb3_quad.controllers.controller.Controller` takes.
    :return: root mean squared error of the last 100 steps' actions, of a range of 2.
    """
    env, policy, actor = model.get_env(), model.policy, cast(Any, model.actor)
    assert env is not None
    n, expert, rng = env.num_envs, Controller.for_env(teacher, env), np.random.default_rng(seed)
    flown_by_teacher = (np.arange(n) % 2 == 0)[:, None]
    steps = max(CLONE_ROWS // n, CLONE_FLIGHT)
    optimiser = th.optim.Adam(actor.parameters(), lr=CLONE_RATE)
    states: list[Any] = []  # (n, ...) of each step
    targets: list[
        Any
    ] = []  # the teacher's actions in them as the actor gives its own, (n, actions)
    errors: list[float] = []
    observation: Any = env.reset()
    begins = np.ones(n, dtype=np.bool_)
    for step in range(steps):
        labels = expert.labels(observation, begins)
        states.append(observation)
        targets.append(
            policy.scale_action(labels.reshape(n, *env.action_space.shape)).reshape(n, -1)
        )  # type: ignore[misc]
        own, _ = model.predict(observation, deterministic=True)
        actions = np.where(flown_by_teacher, labels, own.reshape(n, -1)).reshape(own.shape)
        observation, _, begins, _ = env.step(actions)
        if (step + 1) * CLONE_ROUNDS // steps == step * CLONE_ROUNDS // steps:
            continue
        inputs, outputs = (
            th.as_tensor(np.concatenate(part), device=model.device) for part in (states, targets)
        )
        for _ in range(CLONE_STEPS // CLONE_ROUNDS):
            for group in optimiser.param_groups:
                group["lr"] = CLONE_RATE * max(1.0 - len(errors) / CLONE_STEPS, 0.01)
            rows = th.as_tensor(rng.integers(len(inputs), size=CLONE_BATCH), device=model.device)
            loss = (
                (policy._predict(inputs[rows], deterministic=True) - outputs[rows]).square().mean()
            )
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            errors.append(loss.item())
    if hasattr(policy, "actor_target"):  # TD3's
        cast(Any, policy).actor_target.load_state_dict(actor.state_dict())
    if isinstance(getattr(actor, "log_std", None), th.nn.Linear):
        with th.no_grad():
            actor.log_std.weight.zero_()
            actor.log_std.bias.fill_(model.policy_kwargs.get("log_std_init", CLONE_LOG_STD))
    return float(np.mean(errors[-100:]) ** 0.5)
