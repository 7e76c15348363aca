"""The page of ``sb3-quad demo``: controllers and vehicles as data, and the scripts, in one file
that needs no network.

The scripts are ES modules without dependencies. They become one script here, so that no build step
is needed; the tables of states and features in it are those of :mod:`sb3_quad.envs.simulation`.
"""

import base64
import json
import re
import zlib
from collections.abc import Sequence
from importlib.resources import files

import numpy as np
from torch.nn.utils import parameters_to_vector

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.zips import load_model
from sb3_quad.base import __version__
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.templates import render
from sb3_quad.base.types import StrDict
from sb3_quad.envs.simulation.observation import DEFAULT_STD, GROUPS, OBSERVATION_SIZE, F
from sb3_quad.envs.simulation.state import AHEAD, STATE, STATE_SIZE, X
from sb3_quad.envs.vehicles.vehicle import VEHICLES, Vehicle, first_vehicle, load_vehicle
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.tables import COLOURS, colours_of
from sb3_quad.export.check import TrainedPolicy
from sb3_quad.export.network import Network, build_network

DEFAULT_AGENTS = (
    "pid",
    "geometric",
    "itm-robust",
    "RL agent=itm-recovery",
    "any-quadcopter",
    "imitation agent=itm-imitation",
)
EXACT = 50_000  # networks with more numbers than this are rounded to half precision
# The modules of the page in the order of their imports: those that need no browser, and the others.
MODEL = """
    tables
    vehicle
    dynamics
    rates
    observation
    network
    experts
    course
    flight
    weights
    gradient
    """
VIEW = """
    fleet
    camera
    airframe
    scene
    plots
    hand
    player
    board
    controls
    school
    app
    """
EXPERTS = ("pid", "geometric")
FEATURES = {"position", "rotation", "velocity", "body_rates"}  # as observation.js computes them
TABLES = {
    "X": X._asdict(),
    "SIZES": STATE,
    "STATE_SIZE": STATE_SIZE,
    "AHEAD": AHEAD,
    "F": F._asdict(),
    "OBSERVATION_SIZE": OBSERVATION_SIZE,
    "DEFAULT_STD": DEFAULT_STD.tolist(),
}
# Parts of a script: strings, templates (even with a template in them) and comments at the end of a
# line are kept as they are; documentation, imports, the word export, indentation and comment lines
# are removed.
PARTS = re.compile(
    r"""
    (?P<kept>
        "(?:\\.|[^"\\\n])*" | '(?:\\.|[^'\\\n])*'
        | `(?:\\.|\$\{(?:[^`{}]|\{[^`{}]*\}|`(?:\\.|[^`\\])*`)*\}|[^`\\])*`
        | (?<=\S)[ ]*//[^\n]*
    )
    | /\*\*.*?\*/ | ^import\ [^;]*; | ^export\ (?=\w) | ^\s*//[^\n]* | ^\s+
    """,
    re.MULTILINE | re.DOTALL | re.VERBOSE,
)


def make_page(
    specs: Sequence[ControllerSpec], vehicle: Vehicle | None = None
) -> tuple[str, Vehicle, list[str]]:
    """Return the page as text, the vehicle that all fly at first, and the agents whose weights were
    rounded to keep the page small.

    :param specs: the controllers, of which the first ones are shown.
    :param vehicle: the vehicle that all fly at first; None: the first agent's own, or else ``itm``.
    :raises ConfigError: a controller that the page cannot fly, or settings that cannot be read.
    """
    # A given vehicle comes first, then those of the agents, each with a unique name.
    colours = colours_of([spec.label for spec in specs])
    vehicles = {name: load_vehicle(name) for name in VEHICLES.names()}
    first = vehicle and _add(vehicles, vehicle)
    agents = []
    for spec in specs:
        agents.append({"label": spec.label, "colour": colours[spec.label], **describe(spec)})
        if spec.own and not spec.own.vehicles:
            own = _add(vehicles, first_vehicle(spec.own.vehicle))
            agents[-1]["vehicle"] = own.name
            first = first or own
    first = first or vehicles["itm"]
    rounded = [agent["label"] for agent in agents if agent.get("bits") == 16]
    data = {
        "vehicles": [known.model_dump(mode="json") for known in vehicles.values()],
        "vehicle": first.name,
        "colours": COLOURS,
        "agents": agents,
    }
    # Without "<", no text in the data can end the script element.
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    page = render(
        __package__,
        "page.html.j2",
        data=text,
        model=script(MODEL),
        view=script(VIEW),
        rounded=rounded,
        version=__version__,
    )
    return page, first, rounded


def _add(vehicles: dict[str, Vehicle], vehicle: Vehicle) -> Vehicle:
    """Add a vehicle to others, unless one of them has the same parameters. It gets another name if
    its own is taken.
    """
    while vehicle.name in vehicles:
        known = vehicles[vehicle.name]
        if known.flies_as(vehicle):
            return known
        vehicle = vehicle.model_copy(update={"name": f"{vehicle.name}′"})
    return vehicles.setdefault(vehicle.name, vehicle)


def describe(spec: ControllerSpec) -> StrDict:
    """Return a controller as data for the page.

    :raises ConfigError: neither an expert of the page nor an agent in a zip that exports, or an
        observation with a feature that the page does not compute.
    """
    if spec.spec in EXPERTS:
        return {"kind": spec.spec}
    if not spec.is_zip:
        raise ConfigError(
            f"controller {spec.spec}: the page flies {', '.join(EXPERTS)}, and agents in zips"
        )
    further = ", ".join(sorted(GROUPS.keys() - FEATURES))
    if further:
        raise ConfigError(f"controller {spec.spec}: the page does not compute {further}")
    model = load_model(spec.spec)
    settings, _ = agent_settings(spec.spec, model)
    layout = settings.layout
    trained = TrainedPolicy(model, settings, layout)
    network = build_network(trained, f"model {spec.spec}")
    return {
        "kind": "network",
        "vehicle": "" if settings.vehicles is not None else first_vehicle(settings.vehicle).name,
        "layout": layout.model_dump(mode="json", include={"rotor_positions", "rotor_directions"}),
        "action": settings.action,
        "observation": trained.observation.model_dump(mode="json"),
        "mean": trained.mean.tolist(),
        "std": trained.std.tolist(),
        "clip": trained.clip,
        "shapes": network.shapes,
        **pack(network),
    }


def pack(network: Network) -> StrDict:
    """Return a network's numbers, layer by layer, as text: planes, each of one byte of every
    number, deflated, in base64.
    """
    # The page stays small because large networks are rounded.
    values = parameters_to_vector(network.parameters()).numpy()
    values = values.astype("<f2" if values.size > EXACT else "<f4")
    # Sorted by byte, signs and exponents are adjacent and deflate better.
    planes = values.view(np.uint8).reshape(values.size, -1).T.tobytes()
    return {
        "bits": 8 * values.itemsize,
        "weights": base64.b64encode(zlib.compress(planes, 9)).decode(),
    }


def script(modules: str) -> str:
    """Return the named modules as one script, in this order."""
    folder = files(__package__)
    text = "\n".join(folder.joinpath(f"{name}.js").read_text("utf-8") for name in modules.split())
    return join_modules(text).replace('JSON.parse("TABLES")', json.dumps(TABLES))


def join_modules(text: str) -> str:
    """Return modules, one after the other, as one script without imports, exports, documentation
    and indentation; strings and template literals stay as they are.
    """
    return PARTS.sub(lambda match: match["kept"] or "", text)
