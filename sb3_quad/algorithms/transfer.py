"""Starting from a trained agent: its policy and critic in a new algorithm with a new optimiser."""

from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.utils import update_learning_rate

from sb3_quad.agents.agent_settings import warn_of_observation
from sb3_quad.agents.controller import Controller
from sb3_quad.agents.pretrained import agent_path
from sb3_quad.agents.statistics import share_statistics, statistics_of
from sb3_quad.agents.zips import load_model
from sb3_quad.algorithms.buffers import AggregatedDataset
from sb3_quad.base.errors import ConfigError, ExpertError
from sb3_quad.base.files import one_line
from sb3_quad.base.types import StrPath
from sb3_quad.envs.simulation.settings import KEY


def model_of(source: BaseAlgorithm | StrPath | None) -> BaseAlgorithm | None:
    """Return the model that ``source`` is or names; None for None.

    :param source: a model, the path of a zip, a run folder, or the name of a shipped agent.
    :raises ConfigError: a missing or damaged file, or something else.
    """
    if isinstance(source, (str, Path)):
        return load_model(agent_path(str(source)))
    if source is not None and not isinstance(source, BaseAlgorithm):
        raise ConfigError(
            f"initial_policy {source!r}: must be a model, the path of a zip, or a name"
        )
    return source


def transfer_policy(source: BaseAlgorithm | StrPath, model: BaseAlgorithm) -> None:
    """Give ``model`` the policy and critic of another agent with the same spaces and networks.

    An off-policy ``model`` also takes an agent with other networks, such as DAgger's. Its actor
    then imitates that agent by :func:`clone_policy`, for which ``model`` needs its environment, and
    its critic starts from scratch.

    ``log_std`` comes from ``source``, unless the model's settings give a ``log_std_init``. The
    optimiser is left as it is, so a new model starts with a new one.

    A warning names the settings of the observation that differ from those of the agent's training,
    if its zip records them.

    Statistics of VecNormalize go into the model's environment.

    :param source: a model of any algorithm, or what names one: the path of a zip or of a run
        folder, or a shipped agent's name.
    :raises ConfigError: a zip that is missing, incomplete or not finite, or whose layers differ,
        which the message names; or an agent that computes something else with the same layers.
    """
    name = str(source)
    if isinstance(source, BaseAlgorithm):
        name = f"the policy of {type(source).__name__}"
    teacher: Any = model_of(source)
    warn_of_observation(name, teacher, getattr(model, KEY, None))
    theirs = dict(teacher.policy.state_dict())
    ours = model.policy.state_dict()
    if isinstance(model, OffPolicyAlgorithm) and theirs.keys() != ours.keys():
        try:
            clone_policy(teacher, model, seed=model.seed or 0)
        except ExpertError as error:  # other spaces
            raise ConfigError(f"{name}: {error}") from None
        return
    if teacher.action_space != model.action_space:
        raise ConfigError(
            f"{name}: its actions are of {teacher.action_space}, here they are of"
            f" {model.action_space}"
        )
    share_statistics(statistics_of(teacher), model.get_env(), training=True)
    if not all(th.isfinite(tensor).all() for tensor in theirs.values()):
        raise ConfigError(f"{name}: holds parameters that are not finite")
    # The weights of a preview that the agent did not have are zero.
    added = 3 * len(getattr(model, KEY, {}).get("preview") or ())
    for key, weights in theirs.items():
        if key in ours and weights.ndim == 2 and ours[key].shape[1] == weights.shape[1] + added:
            theirs[key] = th.nn.functional.pad(weights, (0, added))
    if "log_std_init" in model.policy_kwargs and "log_std" in ours:
        theirs["log_std"] = ours["log_std"]
    try:
        model.policy.load_state_dict(theirs)
    except RuntimeError as error:
        difference = one_line(error).partition(": ")[2]
        raise ConfigError(
            f"{name}: environment spaces and policy_kwargs must be the same ({difference});"
            " train takes them from it unless --conf-file is given"
        ) from None
    # Networks that compute something else may have parameters of the same names and shapes.
    if teacher.observation_space != model.observation_space:
        return
    for _ in range(8):
        observation = model.observation_space.sample()
        wanted, _ = teacher.policy.predict(observation, deterministic=True)
        actions, _ = model.policy.predict(observation, deterministic=True)
        if not np.allclose(actions, wanted, 0.01, 0.01 * np.abs(wanted).max(), equal_nan=True):
            raise ConfigError(
                f"{name}: its weights give other actions here; give the policy and policy_kwargs"
                " that it has, such as activation_fn or features_extractor_class"
            )


# A clone flies at least this many states, and at least this many steps in each environment.
CLONE_ROWS = 20_000
CLONE_FLIGHT = 500
# Number of Adam steps, spread over this many rounds of flying and then fitting
CLONE_STEPS = 2_500
CLONE_ROUNDS = 10
CLONE_BATCH = 1024
# The learning rate falls to a hundredth of this.
CLONE_RATE = 2e-3
# log_std of a SAC actor without log_std_init, so small that its sampled actions still fly
CLONE_LOG_STD = -2.0


def clone_policy(teacher: Any, model: OffPolicyAlgorithm, seed: int = 0) -> float:
    """Let the actor of ``model``, SAC's or TD3's, imitate ``teacher`` in its environments.

    A squashed Gaussian outputs tanh of its mean, a DAgger or PPO agent a clipped mean, so weights
    cannot be copied. They are fitted to the squared error of the deterministic actions; the error
    of their arctanh would be dominated by actions near the limits. The teacher flies one half of
    the environments, the present clone the other, as in DAgger, so that the clone also learns from
    states that it gets into itself. A SAC actor's ``log_std`` becomes the ``log_std_init`` of its
    ``policy_kwargs`` in every state, or -2 without one. Reset the environments before learning.

    :param teacher: a source of :class:`~sb3_quad.agents.controller.Controller`.
    :raises ConfigError: Dict observations.
    :return: root mean squared error of the actions over the last 100 steps; actions span 2.
    """
    env = model.get_env()
    assert env is not None
    space: Any = env.observation_space
    if isinstance(space, spaces.Dict):
        raise ConfigError(
            "initial_policy: an agent of other networks cannot be imitated from Dict observations;"
            " wrap the environments in gymnasium.wrappers.FlattenObservation"
        )
    policy: Any = model.policy
    actor = policy.actor
    n = env.num_envs
    expert = Controller.for_env(teacher, env)
    rng = np.random.default_rng(seed)
    flown_by_teacher = (np.arange(n) % 2 == 0)[:, None]
    steps = max(CLONE_ROWS // n, CLONE_FLIGHT)
    optimiser = th.optim.Adam(actor.parameters(), lr=CLONE_RATE)
    # Rows are raw, since the statistics of VecNormalize keep changing.
    normalize = statistics_of(model)
    # The states flown, and the teacher's actions there, scaled as the actor outputs them
    dataset = AggregatedDataset(
        steps * n, space.shape, get_action_dim(env.action_space), space.dtype
    )
    errors: list[float] = []
    observation: Any = env.reset()
    begins = np.ones(n, dtype=np.bool_)
    for step in range(steps):
        labels = expert.labels(observation, begins)
        scaled = policy.scale_action(labels.reshape(n, *actor.action_space.shape))
        seen = normalize.get_original_obs() if normalize else observation
        dataset.add(seen, scaled.reshape(n, -1))
        own, _ = model.predict(observation, deterministic=True)
        actions = np.where(flown_by_teacher, labels, own.reshape(n, -1)).reshape(own.shape)
        observation, _, begins, _ = env.step(actions)
        # Spread the rounds evenly; this one is not over yet.
        if (step + 1) * CLONE_ROUNDS // steps == step * CLONE_ROUNDS // steps:
            continue
        # Fit to all states flown so far.
        for _ in range(CLONE_STEPS // CLONE_ROUNDS):
            rate = CLONE_RATE * max(1.0 - len(errors) / CLONE_STEPS, 0.01)
            update_learning_rate(optimiser, rate)
            batch = dataset.batch(rng.integers(len(dataset), size=CLONE_BATCH))
            inputs, outputs = batch.tensors(model.device)
            if normalize:
                normalized = normalize.normalize_obs(inputs.cpu().numpy())
                inputs = th.as_tensor(normalized, device=model.device)
            predicted = policy._predict(inputs, deterministic=True)
            loss = (predicted - outputs).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            errors.append(loss.item())
    if hasattr(policy, "actor_target"):  # TD3's
        policy.actor_target.load_state_dict(actor.state_dict())
    if isinstance(getattr(actor, "log_std", None), th.nn.Linear):
        with th.no_grad():
            actor.log_std.weight.zero_()
            actor.log_std.bias.fill_(model.policy_kwargs.get("log_std_init", CLONE_LOG_STD))
    return float(np.mean(errors[-100:]) ** 0.5)
