"""Lets rl_zoo3's own scripts train and show our algorithms: it imports a module of this name, if
there is one.

    pip install -c constraints.txt '.[zoo]'                                  # from a clone
    PYTHONPATH=examples/zoo_bridge rl_zoo3 train --algo ppo_bc --env QuadStateRecovery-v0

In a program, ``import custom_envs`` comes before anything imported from rl_zoo3. What becomes of
our settings is said in ``quad_manager.py``. rl_zoo3 replaces Gymnasium's ``TimeLimit`` when it is
imported.
"""

import importlib
import sys

from rl_zoo3 import ALGOS

from sb3_quad.training.algorithms import ALGORITHMS, get_algorithm

for algo in ALGORITHMS:
    ALGOS.setdefault(algo, get_algorithm(algo))
# rl_zoo3's record_video imports exp_manager, which imports this: too early for a subclass of what
# exp_manager is about to define, and none is needed there.
if hasattr(importlib.import_module("rl_zoo3.exp_manager"), "ExperimentManager"):
    from quad_manager import QuadExperimentManager

    for name, module in list(sys.modules.items()):
        if name.startswith("rl_zoo3.") and hasattr(module, "ExperimentManager"):
            module.ExperimentManager = QuadExperimentManager
