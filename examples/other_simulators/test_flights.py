"""``make test-transfer``: each simulator turns as its rotors say, and the shipped agents, exported,
fly in it.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from flights import ExportedAgent, check_rotors, fly, follow
from in_crazyflow import CELLS as CRAZYFLOW
from in_crazyflow import Crazyflow, Mellinger
from in_l2f import CELLS as L2F
from in_rotorpy import CELLS as ROTORPY
from in_rotorpy import SE3, RotorPy
from rotorpy.wind.default_winds import BatchedNoWind

FILES = Path(os.environ["TRANSFER_FILES"])
MAKERS = {f"crazyflow {name}": cell.make for name, cell in CRAZYFLOW.items()}
MAKERS["l2f"] = L2F["l2f_crazyflie"].make
for name in ("crazyflie", "crazyflie_gusts", "hummingbird"):
    MAKERS[f"rotorpy {name}"] = ROTORPY[name].make


@pytest.mark.parametrize("name", MAKERS)
def test_one_rotor_at_a_time_turns_the_body_to_its_side(name):
    check_rotors(MAKERS[name])


@pytest.mark.parametrize("order", [[1, 0, 2, 3], [3, 2, 1, 0], [1, 2, 3, 0]])
@pytest.mark.parametrize("name", MAKERS)
def test_rotors_in_a_wrong_order_are_noticed(name, order):
    def mistaken(n):
        simulator = MAKERS[name](n)
        simulator.rotors = simulator.rotors[order]
        return simulator

    with pytest.raises(SystemExit, match="turn the body"):
        check_rotors(mistaken)


def test_a_file_for_other_rotors_is_refused():
    with pytest.raises(SystemExit, match="export for that --vehicle"):
        ExportedAgent(
            str(FILES / "any-quadcopter@rotorpy_crazyflie.onnx"), CRAZYFLOW["cf21B_500"].make(4)
        )


@pytest.mark.parametrize(
    ("make", "file", "targets", "recoveries"),
    [
        (MAKERS["crazyflow cf21B_500"], "any-quadcopter@cf21B_500", 0.97, 0.97),
        (MAKERS["crazyflow cf2x_L250"], "any-quadcopter@cf2x_L250", 0.7, 0.7),
        (MAKERS["rotorpy crazyflie"], "any-quadcopter@rotorpy_crazyflie", 0.97, 0.97),
        (MAKERS["rotorpy hummingbird"], "any-quadcopter@rotorpy_hummingbird", 0.96, 0.97),
        (MAKERS["l2f"], "any-quadcopter@l2f_crazyflie", 0.9, 0.85),
    ],
)
@pytest.mark.parametrize("task", ["targets", "recoveries"])
def test_exported_agents_fly(task, make, file, targets, recoveries):
    simulator = make(32)
    flights = fly(
        simulator,
        ExportedAgent(str(FILES / f"{file}.onnx"), simulator),
        task,
        seed=3,
        noise=0.05,
        delay=0,
    )
    assert flights.succeeded.mean() >= {"targets": targets, "recoveries": recoveries}[task]
    assert np.median(flights.error[flights.survived]) < 0.03


def test_others_controllers_follow_a_curve_in_their_simulators():
    quadrotors = RotorPy("crazyflie", BatchedNoWind, 2)
    followed = follow(quadrotors, SE3(quadrotors.parameters), "figure_eight_1", 1, 0.0, 0)
    assert (followed[0] < 0.03).all()
    mellinger = Mellinger(Crazyflow("cf2x_L250", 2))
    followed = follow(mellinger.simulator, mellinger, "figure_eight_1", 1, 0.0, 0, moving=True)
    assert (followed[0] < 0.05).all()
