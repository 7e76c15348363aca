"""Samples of what ``campaign.py`` and ``inputs.py`` try; SB3_QUAD_KILLS and SB3_QUAD_INPUTS ask for
more.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
KILLS, INPUTS = os.environ.get("SB3_QUAD_KILLS", "4"), os.environ.get("SB3_QUAD_INPUTS", "60")


def ends_well(*arguments):
    root = FOLDER.parents[1]
    variables = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *map(str, arguments)]
    result = subprocess.run(
        command, capture_output=True, text=True, check=False, env=variables, cwd=root
    )
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.slow
@pytest.mark.timeout(300 + 60 * int(KILLS))
def test_killed_trainings_go_on_to_the_agents_of_undisturbed_ones(tmp_path):
    ends_well(FOLDER / "campaign.py", tmp_path, KILLS)


@pytest.mark.slow
@pytest.mark.timeout(7200 if INPUTS == "all" else 120 + 60 * int(INPUTS))
def test_no_option_and_no_key_takes_a_bad_value_badly(tmp_path):
    ends_well(FOLDER / "inputs.py", tmp_path, INPUTS)
