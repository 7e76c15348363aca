"""Write a page in which quadcopters fly under several controllers side by side: throw them, push
them, move the target.

It is one file that needs no network and no other program than a browser. Weights, vehicles and a
small simulation of the package's physics are in it. Other agents can be dropped onto the page as
zips.

examples:
  sb3-quad demo                                                     PID, geometric, and agents of the package
  sb3-quad demo -o docs/demo.html --overwrite
  sb3-quad demo logs/dagger/QuadStateRecovery-v0_1 pid geometric    your own agent beside the experts
  sb3-quad demo new=agent.zip old=path/to/agent.zip -o compare.html
  sb3-quad demo pid geometric any-quadcopter --vehicle my_vehicle.yaml

A controller is pid, geometric, an agent of the package such as itm-recovery, the path of an SB3
zip, or a run folder; name=… labels it. All fly the same vehicle, at first the first agent's; the
page also has those of the package.
"""

import argparse

from sb3_quad.base.files import refuse_existing, write_text
from sb3_quad.cli.parser import Parser, add_common


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    add(
        "agents",
        nargs="*",
        metavar="AGENT",
        help="who flies (pid, geometric, and agents that come with the package)",
    )
    add("-o", "--output", default="demo.html", metavar="FILE", help="the page (demo.html)")
    add(
        "--vehicle",
        metavar="VEHICLE",
        help="name or YAML file of the vehicle at first (the first agent's)",
    )
    add_common(parser, "trust", "overwrite")


def run(options: argparse.Namespace) -> int:
    """Pack, write. Returns the exit code."""
    from sb3_quad.cli.output import warn
    from sb3_quad.evaluation.controllers import parse_controllers
    from sb3_quad.show.demo.page import DEFAULT_AGENTS, make_page
    from sb3_quad.vehicles.vehicle import load_vehicle

    refuse_existing(options.output, options.overwrite)
    specs = parse_controllers(options.agents or DEFAULT_AGENTS)
    page, vehicle, rounded = make_page(specs, options.vehicle and load_vehicle(options.vehicle))
    for spec in specs:
        warn(spec.notice(vehicle))
    write_text(options.output, page)
    if rounded:
        print(
            f"weights of {' and '.join(rounded)} are rounded to half precision, to keep the page small"
        )
    print(f"saved {options.output} ({len(page.encode())} bytes); open it in a browser")
    return 0
