"""Files of an evaluation and a published policy: full disks, interrupts and two processes
at once cost nothing.
"""

import errno

import numpy as np
import publish
import pytest

from sb3_quad.cli import main
from sb3_quad.evaluation.results import load_results

SUITE = """
name: one
source: paper
scenarios: [{name: near, task_kwargs: {target_distance: 1}, duration: 2, n_episodes: 2}]
"""
codes = []


def hover(vehicle):
    return lambda observation: np.zeros((len(observation), 4))


def evaluation(controller):
    return f"evaluate {controller} --suite suite.yaml -o out --no-report".split()


def meanwhile(vehicle):
    """Another evaluation into the same folder, while this one is under way."""
    if not codes:
        codes.append(main(evaluation("other=test_folders:hover")))
    return hover(vehicle)


def test_of_two_evaluations_into_a_folder_at_once_neither_loses_its_results(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "suite.yaml").write_text(SUITE)
    codes.clear()
    codes.append(main(evaluation("first=test_folders:meanwhile")))
    there = {entry.controller for entry in load_results("out").entries}
    assert there == {
        name for name, code in zip(("other", "first"), codes, strict=True) if code == 0
    }
    refused = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(refused) == codes.count(2) and all("another process" in line for line in refused)


def interrupted(*arguments, **settings):
    raise KeyboardInterrupt


def disk_full(*arguments, **settings):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(("fault", "code"), [(interrupted, 130), (disk_full, 2)])
def test_publish_replaces_both_the_zip_and_its_card_or_neither(
    tmp_path, monkeypatch, short_cards, fault, code
):
    command = ["--name", "mine", "-o", str(tmp_path), "--episodes", "1"]
    assert publish.main(["itm-imitation", *command]) == 0
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert len(before) == 2
    monkeypatch.setattr(publish, "measure" if code == 130 else "write_card", fault)
    assert publish.main(["itm-recovery", *command, "--overwrite"]) == code
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
