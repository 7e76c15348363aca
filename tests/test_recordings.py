"""Recorded worlds: logs whose force, torque or wind acts again."""

import numpy as np
import pytest

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs import QuadcopterEnv, QuadcopterVecEnv
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.evaluation.scenarios.load import load_suite

# 20 ms a row, 0.2 s in all
TIMES = np.arange(11) * 0.02
FORCE = np.random.default_rng(0).normal(size=(11, 3))
TORQUE = 0.01 * FORCE[:, ::-1]


@pytest.fixture
def log(tmp_path):
    """Return a function that writes a CSV file and returns its path."""

    def write(names="fx,fy,fz", columns=FORCE, times=TIMES):
        path = tmp_path / f"{names[:2]}.csv"
        table = np.column_stack([times + 5.0, columns])
        np.savetxt(path, table, delimiter=",", header=f"t,{names}", comments="", fmt="%.17g")
        return str(path)

    return write


def new_batch(n, **keywords):
    return QuadcopterBatch(n, FlightSettings(noise=0.0, **keywords), seed=2)


def test_a_recorded_wrench_flies_as_one_that_is_set_in_each_step(log):
    file = log("fx,fy,fz,tx,ty,tz", np.hstack([FORCE, TORQUE]))
    replayed = new_batch(3, wrench={"file": file, "start": 0.04})
    by_hand = new_batch(3)
    replayed.reset(), by_hand.reset()
    for step in range(30):
        # After the last row, the first follows.
        time = (0.04 + 0.01 * step) % 0.21
        for axis in range(3):
            by_hand.wrench[axis] = np.interp(time, TIMES, FORCE[:, axis])
            by_hand.wrench[9 + axis] = np.interp(time, TIMES, TORQUE[:, axis])
        np.testing.assert_allclose(replayed.total_wrench(), by_hand.wrench, atol=1e-12)
        for batch in (replayed, by_hand):
            batch.step(np.zeros((3, 4)))
        np.testing.assert_allclose(replayed.state, by_hand.state, atol=1e-9)
    assert not replayed.wrench.any()


def test_episodes_begin_at_random_times_and_both_logs_at_the_same(log):
    wind = {"file": log("vx,vy,vz")}
    keywords = {"vehicle": "cf21B_500", "wrench": log(), "wind": wind}
    batch = new_batch(2000, **keywords)
    batch.reset()
    np.testing.assert_array_equal(batch.total_wrench()[:3], batch.total_wind())
    rows = np.searchsorted(np.sort(batch.wind_record[:, 0]), batch.total_wind()[0])
    assert np.bincount(rows, minlength=21).min() > 60
    first = batch.total_wind()
    batch.reset()
    assert (batch.total_wind() != first).any(axis=0).mean() > 0.8
    wind["start"] = [0.0, 0.1]
    batch = new_batch(2000, **keywords)
    batch.reset()
    begun = np.isclose(batch.total_wind()[0], FORCE[0, 0])
    assert begun.mean() == pytest.approx(0.5, abs=0.05)
    np.testing.assert_allclose(batch.total_wind()[0, ~begun], FORCE[5, 0])


def test_both_simulators_replay_the_same(log):
    keywords = {
        "vehicle": "cf21B_500",
        "wrench": log("fx,fy,fz,tx,ty,tz", 1e-3 * np.hstack([FORCE, TORQUE])),
        "wind": log("vx,vy,vz"),
    }
    batch, bullet = QuadcopterVecEnv(1, **keywords), QuadcopterEnv(**keywords)
    calm = QuadcopterVecEnv(1, **{**keywords, "wrench": None, "wind": None})
    batch.seed(3)
    calm.seed(3)
    batch.reset()
    calm.reset()
    bullet.reset(seed=row_seeds(3, 1)[0])
    for _ in range(40):
        bullet.step(np.zeros(4))
        batch.step(np.zeros((1, 4)))
        calm.step(np.zeros((1, 4)))
    ours = batch.true_state().position
    np.testing.assert_allclose(bullet.true_state().position, ours, atol=1e-9)
    assert np.abs(calm.true_state().position - ours).max() > 1e-3


def test_a_suite_names_logs_beside_it_and_zips_name_none(log, tmp_path):
    log()
    suite = tmp_path / "wind_tunnel.yaml"
    suite.write_text(
        "name: wind_tunnel\nscenarios: [{name: tunnel, wrench: fx.csv, n_episodes: 2}]"
    )
    settings = load_suite(suite).scenarios[0].settings
    assert QuadcopterBatch(1, settings).wrench_record.any()
    model = type("Model", (), {})()
    settings.write_into(model)
    assert model.flight_settings["wrench"] is None


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"names": "fx,fy", "columns": FORCE[:, :2]}, "columns must be"),
        ({"columns": np.where(FORCE > 1.0, np.nan, FORCE)}, "is missing"),
        ({"times": TIMES[::-1]}, "must rise"),
        ({"columns": 1e9 * FORCE}, "change its units"),
        ({"times": 100.0 * np.arange(11)}, "shorten it"),
    ],
)
def test_bad_logs_are_refused_in_one_line(log, changes, names):
    file = log(**changes)
    with pytest.raises(ConfigError, match=names) as error:
        QuadcopterEnv(wrench=file)
    assert "\n" not in str(error.value) and file in str(error.value)
