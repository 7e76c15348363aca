"""CoefficientSchedule: where the coefficient is, for any course of what it follows, and what it
leaves in the model.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback

from sb3_quad import PPOBC, DAgger, PIDExpert
from sb3_quad.base.errors import ConfigError
from sb3_quad.callbacks import BestModel, CoefficientSchedule
from sb3_quad.envs.vec_env import QuadcopterVecEnv

NUMBER = st.floats(-1e3, 1e3)


def make(algorithm, **kwargs):
    env = QuadcopterVecEnv(2, max_episode_steps=10, seed=0)
    size = (
        {"learning_starts": 5, "batch_size": 4}
        if algorithm is SAC
        else {"n_steps": 10, "batch_size": 20, "n_epochs": 1}
    )
    expert = {} if algorithm in (PPO, SAC) else {"expert": PIDExpert()}
    policy_kwargs = {"net_arch": [4]}
    return algorithm(
        "MlpPolicy",
        env,
        **{**size, **expert, **kwargs},
        policy_kwargs=policy_kwargs,
        seed=0,
        device="cpu",
    )


class Course(BaseCallback):
    """Logs a metric of a given course, one number a rollout, and notes the coefficient each rollout
    is flown with.
    """

    def __init__(self, course, read):
        super().__init__()
        self.course, self.read, self.seen = iter(course), read, []

    def _on_rollout_start(self):
        self.seen.append(self.read(self.model))

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        value = next(self.course)
        if value is not None:
            self.logger.record("my/metric", value)


@given(start=NUMBER, final=NUMBER, first=NUMBER, last=NUMBER, measured=NUMBER)
def test_the_coefficient_is_linear_between_its_ends_and_constant_beyond(
    start, final, first, last, measured
):
    if first == last:
        with pytest.raises(ConfigError, match="between"):
            CoefficientSchedule("beta", start, final, between=(first, last))
        return
    schedule = CoefficientSchedule("beta", start, final, between=(first, last))
    expected = np.interp(
        measured,
        *((first, last), (start, final)) if first < last else ((last, first), (final, start)),
    )
    assert schedule.value_at(measured) == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(("one_way", "last"), [(True, 0.25), (False, 0.75)])
def test_beta_follows_a_metric_from_the_next_rollout_on(one_way, last):
    model = make(DAgger, beta=0.5, beta_decay=0.1, beta_final=0.2)
    schedule = CoefficientSchedule(
        "beta", 1.0, 0.0, follow="my/metric", between=(10.0, 14.0), one_way=one_way
    )
    course = Course([None, 12.0, float("nan"), 13.0, 11.0, 11.0], lambda model: model.current_beta)
    model.learn(120, callback=[course, schedule])
    assert course.seen == [1.0, 1.0, 0.5, 0.5, 0.25, last]
    assert model.current_beta == last


def test_the_cloning_weight_can_rise_from_nothing_and_every_cloned_row_is_labelled():
    model = make(PPOBC, bc_coef=0.0, bc_loss="mse")
    schedule = CoefficientSchedule("bc_coef", 0.0, 1.0, follow="my/metric")
    course = Course([0.0, 0.5, 1.0, 1.0], lambda model: model.rollout_buffer.bc_coef)
    losses = []

    class Note(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            losses.append(
                (
                    model.rollout_buffer.bc_coef,
                    np.abs(model.rollout_buffer.expert_actions).sum(axis=2).min(),
                )
            )

    model.learn(80, callback=[course, schedule, Note()])
    assert course.seen == [0.0, 0.0, 0.5, 1.0]
    assert [(weight > 0.0) == (label > 0.0) for weight, label in losses] == [True] * 4


@pytest.mark.parametrize(
    ("algorithm", "name", "kwargs", "read"),
    [
        (PPO, "ent_coef", {"ent_coef": 0.1}, lambda model: model.ent_coef),
        (PPO, "learning_rate", {}, lambda model: model.policy.optimizer.param_groups[0]["lr"]),
        (SAC, "tau", {}, lambda model: model.tau),
    ],
)
def test_any_algorithms_coefficients_follow_the_progress(algorithm, name, kwargs, read):
    model = make(algorithm, **kwargs)
    model.learn(40, callback=CoefficientSchedule(name, 0.5, 0.25))
    assert read(model) == pytest.approx(0.25, abs=1e-9)


def test_a_resumed_training_starts_where_it_stopped(tmp_path):
    model = make(DAgger)
    model.learn(
        40,
        callback=[
            Course([0.5, 0.5], lambda model: 0),
            CoefficientSchedule("beta", 1.0, 0.0, "my/metric"),
        ],
    )
    assert model.current_beta == 0.5
    model.save(tmp_path / "model.zip")
    again = DAgger.load(tmp_path / "model.zip", env=model.env, expert=PIDExpert())
    course = Course([None, 0.75], lambda model: model.current_beta)
    again.learn(
        40,
        callback=[course, CoefficientSchedule("beta", 1.0, 0.0, "my/metric")],
        reset_num_timesteps=False,
    )
    assert course.seen == [0.5, 0.5] and again.current_beta == 0.25


def test_it_follows_what_best_model_logs(tmp_path):
    model = make(DAgger)
    env = QuadcopterVecEnv(2, max_episode_steps=10)
    best = BestModel(env, 20, 2, 5, tmp_path / "best.zip", tmp_path / "evaluations.npz")
    ends = (-1000.0, -999.0)
    schedule = CoefficientSchedule("beta", 1.0, 0.25, "eval/mean_reward", ends)
    model.learn(60, callback=[best, schedule])
    assert model.current_beta == 0.25


@pytest.mark.parametrize(
    ("algorithm", "arguments"),
    [
        (DAgger, ("bta", 1.0, 0.0)),
        (DAgger, ("beta", 1.0, -0.5)),
        (DAgger, ("n_steps", 1.0, 0.0)),
        (PPO, ("bc_coef", 1.0, 0.0)),
        (PPOBC, ("bc_coef", 1.0, -1.0)),
    ],
)
def test_what_cannot_be_set_is_refused_when_training_begins(algorithm, arguments):
    model = make(algorithm)
    with pytest.raises(ConfigError, match=arguments[0]):
        model.learn(20, callback=CoefficientSchedule(*arguments))
    assert model.num_timesteps == 0


def test_a_metric_that_is_never_logged_is_warned_about():
    schedule = CoefficientSchedule("beta", 1.0, 0.0, follow="rollout/succes_rate")
    with pytest.warns(UserWarning, match="rollout/success_rate"):
        make(DAgger).learn(40, callback=schedule)
