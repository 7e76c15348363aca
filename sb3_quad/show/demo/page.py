"""The page of ``sb3-quad demo``: controllers and vehicles as data, and the scripts, in one file
that needs no network.

The scripts are ES modules without dependencies. They become one script here, so that no build step
is needed.
"""

import base64
import json
import re
import zlib
from collections.abc import Iterable, Sequence
from importlib.resources import files
from typing import Any

import jinja2
import numpy as np

from sb3_quad.base import __version__
from sb3_quad.base.arrays import Float32Array
from sb3_quad.base.colours import COLOURS, colours_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.zips import load_model
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.export.check import Reference
from sb3_quad.export.network import Network, build_network
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.vehicles.vehicle import VEHICLES, Vehicle, first_vehicle, load_vehicle

DEFAULT_AGENTS = (
    "pid",
    "geometric",
    "stage two=itm-recovery",
    "any-quadcopter",
    "stage one=itm-imitation",
)
LIMIT = 500_000  # bytes of a page, above which the largest networks are rounded to half precision
MODEL = (
    "vehicle",
    "dynamics",
    "observation",
    "network",
    "experts",
    "flight",
    "weights",
)  # without a browser, in this order
VIEW = (
    "fleet",
    "camera",
    "airframe",
    "scene",
    "plots",
    "hand",
    "player",
    "board",
    "controls",
    "app",
)
EXPERTS = ("pid", "geometric")


def make_page(
    specs: Sequence[ControllerSpec], vehicle: Vehicle | None = None
) -> tuple[str, Vehicle, list[str]]:
    """The page as text, the vehicle that all fly at first, and which agents' weights are rounded to
    make the page small.

    :param specs: who flies, from the first on as many as are shown.
    :param vehicle: that all fly at first; None: the first agent's own, else ``itm``.
    :raises ConfigError: a controller that the page cannot fly, or settings that cannot be read.
    """
    agents, networks = [], {}
    for spec, colour in zip(
        specs, colours_of([spec.label for spec in specs]).values(), strict=True
    ):
        described, networks[spec.label] = describe(spec)
        agents.append({"label": spec.label, "colour": colour, **described})
    vehicles = {name: load_vehicle(name) for name in VEHICLES.names()}
    own = [
        _add(vehicles, first_vehicle(spec.own.vehicle))
        for spec in specs
        if spec.own and not spec.own.vehicles
    ]
    first = _add(vehicles, vehicle or [*own, vehicles["itm"]][0])
    data = {
        "vehicles": [each.model_dump(mode="json") for each in vehicles.values()],
        "vehicle": first.name,
        "colours": COLOURS,
    }
    sizes = {
        label: numbers(network).size for label, network in networks.items() if network is not None
    }
    by_size = sorted(sizes, key=lambda label: -sizes[label])
    for count in range(len(by_size) + 1):  # of the largest networks that are rounded
        rounded = by_size[:count]
        packed = {
            label: pack(network, label in rounded)
            for label, network in networks.items()
            if network is not None
        }
        page = _render(
            {**data, "agents": [agent | packed.get(agent["label"], {}) for agent in agents]},
            rounded,
        )
        if len(page.encode()) <= LIMIT:
            break
    return page, first, rounded


def _add(vehicles: dict[str, Vehicle], vehicle: Vehicle) -> Vehicle:
    """Add a vehicle to others unless one of them flies the same; it is given another name if its
    own is taken.
    """
    for known in vehicles.values():
        if known.name == vehicle.name and known.flies_as(vehicle):
            return known
    while vehicle.name in vehicles:
        vehicle = vehicle.model_copy(update={"name": f"{vehicle.name}′"})
    return vehicles.setdefault(vehicle.name, vehicle)


def describe(spec: ControllerSpec) -> tuple[dict[str, Any], Network | None]:
    """A controller as the page knows it, but for its weights; and its network.

    :raises ConfigError: neither an expert of the page nor an agent in a zip that exports.
    """
    if spec.spec in EXPERTS:
        return {"kind": spec.spec}, None
    if not spec.is_zip:
        raise ConfigError(
            f"controller {spec.spec}: the page flies {', '.join(EXPERTS)}, and agents in zips"
        )
    settings = agent_settings(spec.spec)[0]
    layout = settings.layout
    row = QuadcopterBatch(
        1, settings.with_changes(vehicle=layout, randomize=None), n_threads=1
    )  # it checks the scaling
    mean, std = row.mean[:, 0], row.std[:, 0]
    reference = Reference(load_model(spec.spec), layout, mean, std, "thrusts", row.observation)
    network = build_network(reference, f"model {spec.spec}")
    steps = [
        {"inputs": each.in_features, "outputs": each.out_features, "activation": after}
        for each, after in network.steps
    ]
    described = {
        "kind": "network",
        "vehicle": "" if settings.vehicles is not None else first_vehicle(settings.vehicle).name,
        "layout": layout.model_dump(mode="json", include={"rotor_positions", "rotor_directions"}),
        "observation": row.observation.model_dump(mode="json"),
        "mean": mean.tolist(),
        "std": std.tolist(),
        "shapes": steps,
    }
    return described, network


def numbers(network: Network) -> Float32Array:
    """Weights and biases, layer by layer."""
    layers = [
        part.detach().numpy().ravel()
        for each, _ in network.steps
        for part in (each.weight, each.bias)
    ]
    return np.concatenate(layers)


def pack(network: Network, rounded: bool) -> dict[str, Any]:
    """A network's numbers as text: planes, each of one byte of every number, deflated, in base64.

    :param rounded: whether to half precision.
    """
    values = numbers(network).astype("<f2" if rounded else "<f4")
    planes = np.frombuffer(values.tobytes(), np.uint8).reshape(values.size, -1).T.tobytes()
    return {
        "bits": 8 * values.itemsize,
        "weights": base64.b64encode(zlib.compress(planes, 9)).decode(),
    }


def script(modules: Iterable[str] = (*MODEL, *VIEW)) -> str:
    """The named modules as one script, in this order, without comments of their own lines and
    without indentation.
    """
    sources = files(__package__)
    text = "\n".join(sources.joinpath(f"{name}.js").read_text("utf-8") for name in modules)
    return re.sub(
        r"/\*\*.*?\*/|^import [^;]*;|^export (?=\w)|^\s+|^\s*//[^\n]*", "", text, flags=re.M | re.S
    )


def _render(data: dict[str, Any], rounded: Sequence[str]) -> str:
    notes = f"sb3_quad {__version__}. The page flies what sb3_quad flies in Python, in double precision."
    if rounded:
        notes += f" Weights of {' and '.join(rounded)} are rounded to half precision."
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(__package__, ""), undefined=jinja2.StrictUndefined
    )
    return environment.get_template("page.html.j2").render(data=text, script=script(), notes=notes)
