"""SIGKILL at random moments costs nothing but the seconds since the last snapshot."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).with_name("campaign.py")
KILLS = int(os.environ.get("SB3_QUAD_KILLS", "4"))


@pytest.mark.slow
@pytest.mark.timeout(300 + 60 * KILLS)
def test_killed_trainings_go_on_to_the_agents_of_undisturbed_ones(tmp_path):
    """SB3_QUAD_KILLS=100 asks for as many."""
    root = CAMPAIGN.parents[2]
    variables = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(CAMPAIGN), str(tmp_path), str(KILLS)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=variables, cwd=root)
    assert result.returncode == 0, result.stdout + result.stderr
