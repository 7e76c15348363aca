"""The page of ``sb3-quad demo``: controllers and vehicles as data, and the scripts, in one file that needs no network.

The scripts are ES modules without dependencies. They become one script here, so that no build step is needed.
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

from sb3_quad.base.arrays import Float32Array
from sb3_quad.base.colours import COLOURS, colours_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.version import __version__
from sb3_quad.controllers.agent_settings import agent_settings
from sb3_quad.controllers.zips import load_model
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.export.check import Reference
from sb3_quad.export.network import Network, build_network
from sb3_quad.simulation.batch import QuadcopterBatch
from sb3_quad.vehicles.vehicle import VEHICLES, Vehicle, first_vehicle, load_vehicle

DEFAULT_AGENTS = ("pid", "geometric", "stage two=itm-recovery", "any-quadcopter", "itm-robust", "stage one=itm-imitation")
LIMIT = 500_000  # bytes of a page, above which the largest networks are rounded to half precision
MODEL = ("vehicle", "dynamics", "observation", "network", "experts", "flight", "weights")  # without a browser, in this order
VIEW = ("fleet", "camera", "airframe", "scene", "plots", "hand", "player", "board", "controls", "app")
EXPERTS = ("pid", "geometric")


def make_page(specs: Sequence[ControllerSpec], vehicle: str | Vehicle | None = None) -> tuple[str, list[str]]:
    """The page as text, and the labels of the agents whose weights are rounded to half precision to make it small.

    :param specs: who flies, from the first on as many as are shown.
    :param vehicle: that all fly at first; None: the first agent's own, else ``itm``.
    :raises ConfigError: a controller that the page cannot fly, or a vehicle that cannot be loaded.
    """
    colours = colours_of([spec.label for spec in specs])
    agents, networks = [], {}
    for spec in specs:
        agent, network = describe(spec)
        agents.append({"label": spec.label, "colour": colours[spec.label], **agent})
        if network is not None:
            networks[spec.label] = network
    owned = [first_vehicle(spec.own.vehicle) for spec in specs if spec.own is not None and spec.own.vehicles is None]
    first = load_vehicle(vehicle or (owned[0] if owned else "itm"))
    vehicles = {each.name: each for each in (*map(load_vehicle, VEHICLES.names()), *owned, first)}
    rounded: list[str] = []
    while True:
        packed = [
            agent | pack(networks[agent["label"]], agent["label"] in rounded) for agent in agents if agent["label"] in networks
        ]
        by_label = {each["label"]: each for each in packed}
        data = {
            "agents": [by_label.get(agent["label"], agent) for agent in agents],
            "vehicles": [each.model_dump(mode="json") for each in vehicles.values()],
            "vehicle": first.name,
            "colours": COLOURS,
        }
        page = _render(data, rounded)
        exact = [label for label in networks if label not in rounded]
        if len(page.encode()) <= LIMIT or not exact:
            return page, rounded
        rounded.append(max(exact, key=lambda label: numbers(networks[label]).size))


def describe(spec: ControllerSpec) -> tuple[dict[str, Any], Network | None]:
    """A controller as the page knows it, but for its weights; and its network.

    :raises ConfigError: neither an expert of the page nor an agent in a zip that exports.
    """
    if spec.spec in EXPERTS:
        return {"kind": spec.spec}, None
    if not spec.is_zip:
        raise ConfigError(f"controller {spec.spec}: the page flies {', '.join(EXPERTS)}, and agents in zips")
    settings = agent_settings(spec.spec)[0]
    layout = settings.layout
    row = QuadcopterBatch(1, settings.with_changes(vehicle=layout, randomize=None), n_threads=1)  # it checks the scaling
    mean, std = row.mean[:, 0], row.std[:, 0]
    reference = Reference(load_model(spec.spec), layout, mean, std, "thrusts", row.observation)
    network = build_network(reference, f"model {spec.spec}")
    steps = [{"inputs": each.in_features, "outputs": each.out_features, "activation": after} for each, after in network.steps]
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
    layers = [part.detach().numpy().ravel() for each, _ in network.steps for part in (each.weight, each.bias)]
    return np.concatenate(layers)


def pack(network: Network, rounded: bool) -> dict[str, Any]:
    """A network's numbers as text: planes, each of one byte of every number, deflated, in base64.

    :param rounded: whether to half precision.
    """
    values = numbers(network).astype("<f2" if rounded else "<f4")
    planes = np.frombuffer(values.tobytes(), np.uint8).reshape(values.size, -1).T.tobytes()
    return {"bits": 8 * values.itemsize, "weights": base64.b64encode(zlib.compress(planes, 9)).decode()}


def script(modules: Iterable[str] = (*MODEL, *VIEW)) -> str:
    """The named modules as one script, in this order, without comments of their own lines and without indentation."""
    sources = files(__package__)
    text = "\n".join(sources.joinpath(f"{name}.js").read_text("utf-8") for name in modules)
    return re.sub(r"/\*\*.*?\*/|^import [^;]*;|^export (?=\w)|^\s+|^\s*//[^\n]*", "", text, flags=re.M | re.S)


def _render(data: dict[str, Any], rounded: Sequence[str]) -> str:
    notes = f"sb3_quad {__version__}. The page flies what sb3_quad flies in Python, in double precision."
    if rounded:
        notes += f" Weights of {' and '.join(rounded)} are rounded to half precision."
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    environment = jinja2.Environment(loader=jinja2.PackageLoader(__package__, ""), undefined=jinja2.StrictUndefined)
    return environment.get_template("page.html.j2").render(data=text, script=script(), notes=notes)
