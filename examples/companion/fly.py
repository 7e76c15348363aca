r"""Let an exported agent fly a vehicle behind its flight controller's rate loop, for some seconds.

    pip install '.[companion]'
    sb3-quad export any-quadcopter-rates --format onnx --vehicle mine.yaml -o agent.onnx
    python fly.py px4 agent.onnx --address udpin:0.0.0.0:14540 --hover 0.45 --target 0 0 2
    python fly.py crazyflie agent.onnx --address radio://0/80/2M --hover 0.58 --target 0 0 1
    python fly.py betaflight agent.onnx --address /dev/ttyAMA0 --pose mocap:latest --hover 0.5 \\
        --target 0 0 1.5

Read docs/hardware.md first.
"""

import argparse
import importlib

import numpy as np
from core import HoverThrust, Limits, Policy, fly


def connect_px4(address, pose):
    """--address is a URL of MAVLink."""
    from pymavlink import mavutil
    from via_px4 import Px4

    connection = mavutil.mavlink_connection(address)
    connection.wait_heartbeat()
    return Px4(connection)


def connect_crazyflie(address, pose):
    """--address is a URI of the radio."""
    import cflib.crtp
    from cflib.crazyflie import Crazyflie
    from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
    from via_crazyflie import Crazyflie as Link

    cflib.crtp.init_drivers()
    connected = SyncCrazyflie(address, cf=Crazyflie(rw_cache="./cache"))
    connected.open_link()
    return Link(connected.cf)


def connect_betaflight(address, pose):
    """--address is a serial port; --pose MODULE:FUNCTION returns the latest core.State."""
    import serial
    from via_betaflight import Betaflight

    module, _, function = (pose or "").partition(":")
    if not function:
        raise SystemExit("betaflight has no position: give --pose MODULE:FUNCTION")
    port = serial.Serial(address, 500_000, timeout=0.005)
    return Betaflight(port, getattr(importlib.import_module(module), function))


# With the power of the throttle that thrust rises with
CONNECT = {
    "px4": (connect_px4, 1.0),
    "crazyflie": (connect_crazyflie, 1.0),
    "betaflight": (connect_betaflight, 2.0),
}


def main() -> None:
    """Connect, fly, and say why it ended."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("controller", choices=CONNECT)
    parser.add_argument("agent", help="an ONNX file that commands thrust and body rates")
    parser.add_argument("--address", required=True)
    parser.add_argument("--pose", help="betaflight: MODULE:FUNCTION")
    parser.add_argument("--hover", type=float, required=True, help="throttle in hover, 0 to 1")
    parser.add_argument("--target", type=float, nargs=3, required=True, help="m, z up")
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    connect, power = CONNECT[options.controller]
    policy = Policy(options.agent)
    link = connect(options.address, options.pose)
    hover = HoverThrust(options.hover, power)
    print("The first state …")
    while link.state() is None:
        pass
    fault = fly(link, policy, hover, np.array(options.target), Limits(), options.seconds)
    print(f"handed over: {fault or 'time is over'}; throttle in hover {hover.throttle:.3f}")


if __name__ == "__main__":
    main()
