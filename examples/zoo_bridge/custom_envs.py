"""Let rl_zoo3's scripts train and show our algorithms. They import a module of this name.

    pip install -c constraints.txt '.[zoo]'                                  # from a clone
    PYTHONPATH=examples/zoo_bridge rl_zoo3 train --algo ppo_bc --env QuadStateRecovery-v0

In a program of your own, write ``import custom_envs`` before you import anything from rl_zoo3.
``quad_manager.py`` says what happens to our settings. rl_zoo3 replaces Gymnasium's ``TimeLimit``
when it is imported.
"""

import importlib
import sys

from rl_zoo3 import ALGOS

from sb3_quad.training.algorithms import ALGORITHMS, get_algorithm

for algo in ALGORITHMS:
    ALGOS.setdefault(algo, get_algorithm(algo))
# rl_zoo3's record_video imports exp_manager, which imports this module before it defines
# ExperimentManager. That is too early for a subclass, and record_video needs none.
if hasattr(importlib.import_module("rl_zoo3.exp_manager"), "ExperimentManager"):
    from quad_manager import QuadExperimentManager

    for name, module in list(sys.modules.items()):
        if name.startswith("rl_zoo3.") and hasattr(module, "ExperimentManager"):
            setattr(module, "ExperimentManager", QuadExperimentManager)  # noqa: B010
