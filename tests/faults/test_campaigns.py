"""What ``campaign.py`` tries: ``make campaign`` runs it, not ``make test-all``. SB3_QUAD_KILLS asks
for more.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
KILLS = os.environ.get("SB3_QUAD_KILLS", "12")


@pytest.mark.slow
@pytest.mark.campaign
@pytest.mark.timeout(0)
def test_no_kill_costs_anything(tmp_path):
    root = FOLDER.parents[1]
    variables = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(FOLDER / "campaign.py"), str(tmp_path), KILLS]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=variables, cwd=root
    )
    assert done.returncode == 0, done.stdout + done.stderr
