"""What ``campaign.py`` and ``inputs.py`` try, a part at a time: ``make campaign`` runs it, not
``make test-all``. SB3_QUAD_KILLS and SB3_QUAD_INPUTS ask for more.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
KILLS = os.environ.get("SB3_QUAD_KILLS", "12")
INPUTS = os.environ.get("SB3_QUAD_INPUTS", "300")


@pytest.mark.slow
@pytest.mark.campaign
@pytest.mark.timeout(0)
@pytest.mark.parametrize(("program", "count"), [("campaign.py", KILLS), ("inputs.py", INPUTS)])
def test_no_kill_costs_anything_and_no_value_is_taken_badly(program, count, tmp_path):
    root = FOLDER.parents[1]
    variables = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(FOLDER / program), str(tmp_path), count]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=variables, cwd=root
    )
    assert done.returncode == 0, done.stdout + done.stderr
