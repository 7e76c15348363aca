"""The aggregated dataset: a ring that forgets the oldest."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_quad.algorithms.buffers import AggregatedDataset, sample_rows
from sb3_quad.base.errors import ConfigError


def pairs(first, n):
    numbers = np.arange(first, first + n, dtype=np.float32)
    return np.stack([numbers, -numbers], axis=1), numbers[:, None] * 10


def filled(capacity=8, *sizes):
    dataset, first = AggregatedDataset(capacity, (2,), 1), 0
    for n in sizes:
        dataset.add(*pairs(first, n))
        first += n
    return dataset


def contents(dataset):
    return dataset.pairs["observations"], dataset.pairs["actions"]


@given(st.integers(1, 12), st.lists(st.integers(0, 30), max_size=8))
def test_it_holds_the_last_pairs_in_order(capacity, sizes):
    total = sum(sizes)
    observations, actions = contents(filled(capacity, *sizes))
    kept = min(total, capacity)
    expected = pairs(total - kept, kept)
    np.testing.assert_array_equal(observations, expected[0])
    np.testing.assert_array_equal(actions, expected[1])


@pytest.mark.parametrize("count", [3, 10, 25])
def test_rows_are_sampled_in_whole_passes(count):
    rows = sample_rows(10, count, np.random.default_rng(0))
    assert len(rows) == count
    for start in range(0, count - count % 10, 10):
        assert sorted(rows[start : start + 10]) == list(range(10))


def test_in_order_they_follow_each_other():
    assert sample_rows(4, 10, np.random.default_rng(0), shuffle=False).tolist() == [
        0,
        1,
        2,
        3,
        0,
        1,
        2,
        3,
        0,
        1,
    ]


def test_pairs_do_not_depend_on_where_the_ring_begins(tmp_path):
    dataset, other = filled(8, 5, 6), AggregatedDataset(8, (2,), 1)
    other.add(*pairs(50, 2))  # which the file replaces
    dataset.save(tmp_path / "d.npz")
    other.load(tmp_path / "d.npz")
    for either in (dataset, other):
        either.add(*pairs(11, 3))
    for mine, theirs in zip(contents(dataset), contents(other), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_file_that_does_not_fit_leaves_the_pairs_as_they_are(tmp_path):
    dataset = filled(8, 5)
    before = contents(dataset)
    AggregatedDataset(8, (3,), 1).save(tmp_path / "wider.npz")
    np.savez(tmp_path / "uneven.npz", observations=np.zeros((2, 2)), actions=np.zeros((3, 1)))
    np.savez(tmp_path / "other.npz", states=np.zeros((2, 2)))
    (tmp_path / "text.npz").write_text("no archive")
    for name in ("wider", "uneven", "other", "text", "missing"):
        with pytest.raises(ConfigError, match=f"{name}.npz: ") as raised:
            dataset.load(tmp_path / f"{name}.npz")
        assert "\n" not in str(raised.value)
    for array, old in zip(contents(dataset), before, strict=True):
        np.testing.assert_array_equal(array, old)


def flight(n, short=False, shape=(2,)):
    """A flight of n actions with one observation more, as imitation (short) or Minari has it."""
    observations = np.arange(2.0 * (n + 1)).reshape(n + 1, *shape)
    actions = np.linspace(-1.0, 1.0, n)[:, None]
    names = ("obs", "acts") if short else ("observations", "actions")
    return SimpleNamespace(**dict(zip(names, (observations, actions), strict=True)))


@pytest.mark.parametrize("short", [False, True])
def test_flights_of_others_are_taken_without_their_last_observations(short):
    dataset = filled(8, 5)
    dataset.load([flight(3, short), flight(2, short)])
    observations, actions = contents(dataset)
    np.testing.assert_array_equal(observations, [[0, 1], [2, 3], [4, 5], [0, 1], [2, 3]])
    np.testing.assert_array_equal(actions.ravel(), [-1, 0, 1, -1, 1])


@pytest.mark.parametrize(
    "names", [("obs", "actions"), ("obs", "acts"), ("observations", "actions")]
)
def test_files_of_others_are_taken(tmp_path, names):
    """Of Stable-Baselines 2, of imitation with its pickled infos, and of flights in a row."""
    dataset = filled(8, 5)
    dataset.action_range = (-1.0, 1.0)
    arrays = [np.arange(12.0).reshape(2, 3, 2), np.linspace(-1.0000001, 1.0, 4).reshape(2, 2, 1)]
    infos = np.array([{}, {}], dtype=object)
    np.savez(tmp_path / "many.npz", infos=infos, **dict(zip(names, arrays, strict=True)))
    dataset.load(tmp_path / "many.npz")
    observations, actions = contents(dataset)
    np.testing.assert_array_equal(observations, [[0, 1], [2, 3], [6, 7], [8, 9]])
    assert actions.min() == -1.0
    flat = [arrays[0].reshape(6, 2)[:4], arrays[1].reshape(4, 1)]
    np.savez(tmp_path / "one.npz", infos=infos, **dict(zip(names, flat, strict=True)))
    dataset.load(tmp_path / "one.npz")
    np.testing.assert_array_equal(contents(dataset)[1], actions)


def test_trajectories_of_imitation_are_taken():
    types = pytest.importorskip("imitation.data.types")
    rng = np.random.default_rng(0)
    paths = [
        types.Trajectory(rng.random((6, 2)), rng.random((5, 1)), infos=None, terminal=True)
        for _ in range(3)
    ]
    dataset = AggregatedDataset(20, (2,), 1)
    dataset.load(paths)
    assert len(dataset) == 15


def test_arrays_of_other_names_and_of_single_numbers_are_taken(tmp_path):
    np.savez(tmp_path / "others.npz", obs=np.zeros((4, 2)), acts=np.ones(3), rews=np.ones(3))
    dataset = filled(8)
    dataset.load(tmp_path / "others.npz")
    assert [array.shape for array in contents(dataset)] == [(3, 2), (3, 1)]


def with_number(n, name, number):
    changed = flight(n)
    getattr(changed, name)[1] = number
    return [changed]


@pytest.mark.parametrize(
    ("flights", "message"),
    [
        (with_number(3, "actions", 1500.0), "actions from -1 to 1500"),
        (with_number(3, "actions", np.nan), "actions from nan"),
        (with_number(3, "observations", np.inf), "not finite"),
        ([flight(9)], "9 observations, 9 actions, room for 8"),
        ([], "0 actions"),
        ([flight(2), SimpleNamespace(obs=np.zeros((5, 2)), acts=np.zeros((3, 1)))], "7 obs"),
        ([SimpleNamespace(observations={"camera": 1}, actions=np.zeros((3, 1)))], "unsized"),
        ([flight(3, shape=(1, 2))], "zip"),
        ([{"observations": 1}], "lacks observations or obs"),
        (3, "int: holds no flights that fit the environment"),
    ],
)
def test_flights_that_do_not_fit_are_refused_in_one_line(flights, message):
    dataset = filled(8, 5)
    dataset.action_range = (-1.0, 1.0)
    before = contents(dataset)
    with pytest.raises(ConfigError, match=message) as raised:
        dataset.load(flights)
    assert "\n" not in str(raised.value)
    for array, old in zip(contents(dataset), before, strict=True):
        np.testing.assert_array_equal(array, old)


def test_floats_are_no_pixels():
    dataset = AggregatedDataset(8, (2,), 1, np.uint8)
    with pytest.raises(ConfigError, match="Cannot cast"):
        dataset.load([flight(3)])
