"""Write a web page where several controllers fly side by side.

You can throw the quadcopters, apply forces and move the target. The page is one
file and needs only a browser, no network. It holds the agents' weights, the
vehicles and a small simulation of the package's physics. You can drop zips of
further agents onto it.

examples:
  # PID, geometric, and agents of the package
  sb3-quad demo
  sb3-quad demo -o docs/demo.html --overwrite
  # your own agent and both experts
  sb3-quad demo logs/dagger/QuadStateRecovery-v0_1 pid geometric
  sb3-quad demo new=agent.zip old=path/to/agent.zip -o compare.html
  sb3-quad demo pid geometric any-quadcopter --vehicle my_vehicle.yaml

A controller is pid, geometric, an agent of the package such as itm-recovery,
the path of an SB3 zip, or a run folder. NAME=CONTROLLER labels it. All fly the
same vehicle, at first that of the first agent. The page also offers the
vehicles of the package.
"""

from argparse import Namespace

from sb3_quad.base.files import refuse_existing, write_text
from sb3_quad.cli.parser import (
    OVERWRITE,
    TRUST,
    Flags,
)

FLAGS: Flags = {
    "agents CONTROLLER": (
        {"nargs": "*"},
        "controllers to show (pid, geometric, and agents of the package)",
    ),
    "-o --output FILE": (str, "demo.html", "page to write (demo.html)"),
    "--vehicle": "first vehicle, by name or YAML file (that of the first agent)",
    **TRUST,
    **OVERWRITE,
}


def run(options: Namespace) -> int:
    """Make the page and write it. Returns the exit code."""
    from sb3_quad.cli.output import warn
    from sb3_quad.envs.vehicles.vehicle import load_vehicle
    from sb3_quad.evaluation.controllers import parse_controllers
    from sb3_quad.show.demo.page import DEFAULT_AGENTS, make_page

    refuse_existing(options.output, options.overwrite)
    specs = parse_controllers(options.agents or DEFAULT_AGENTS)
    page, vehicle, rounded = make_page(specs, options.vehicle and load_vehicle(options.vehicle))
    for spec in specs:
        warn(spec.notice(vehicle))
    write_text(options.output, page)
    if rounded:
        print(
            f"weights of {' and '.join(rounded)} are rounded to half precision, "
            "to keep the page small"
        )
    print(f"saved {options.output}; open it in a browser")
    return 0
