"""Write a trained policy as ONNX, C, or for a flight controller.

The exported policy takes 18 numbers in physical units: position relative to the
target, m, world frame; rotation matrix from world to body, row by row;
velocity, m/s, and body rates, rad/s, body frame. It returns a command for each
rotor. Scaling and clipping are included. Before the file is written, it is
checked against the policy on 10,000 observations. A policy that observes
earlier frames, its last action or the position integral also takes a state,
and returns the next one.

examples:
  sb3-quad export logs/ppo_bc/QuadStateRecovery-v0_1 --format onnx
  # defines agent_policy(observation, thrust)
  sb3-quad export agent.zip --format c -o firmware/agent.h --name agent
  # rotor speeds instead of thrusts, rad/s
  sb3-quad export agent.zip --format onnx --output speeds
  sb3-quad export agent.zip --format c --vehicle my_vehicle.yaml
  # a folder that the Crazyflie's firmware builds
  sb3-quad export crazyflie-robust --format crazyflie -o my_app

ONNX: pip install '.[export]' from a clone. The check
of a C header needs a C compiler.
"""

from argparse import Namespace
from pathlib import Path

from sb3_quad.agents.pretrained import agent_path
from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.files import refuse_existing, write_bytes
from sb3_quad.cli.parser import OVERWRITE, TRUST, Flags

FLAGS: Flags = {
    "model MODEL": (
        "agent with an MlpPolicy (of PPO, A2C, DAgger, PPOBC, APG, SAC or TD3): "
        "a zip, a run folder, hf:ORG/NAME, or a name such as itm-recovery"
    ),
    "--format": ({"required": True}, "onnx, c or crazyflie"),
    "-o FILE": (
        {"dest": "file"},
        "file to write, or a folder for it (MODEL.onnx or .h in this folder); "
        "for crazyflie the folder of all files (MODEL_crazyflie)",
    ),
    "--output KIND": (
        str,
        "thrusts",
        "result of the policy: thrusts (N, default) or speeds (rad/s)",
    ),
    "--vehicle": "vehicle, by name or YAML file (that of the zip or its run folder)",
    "--name": "call the C function NAME_policy (the name of the file)",
    **TRUST,
    **OVERWRITE,
}


def run(options: Namespace) -> int:
    """Export, check, write. Returns the exit code."""
    from sb3_quad.cli.output import warn
    from sb3_quad.evaluation.controllers import ControllerSpec
    from sb3_quad.export.c_header import c_name
    from sb3_quad.export.policy import APP, FORMATS, HEADER, export_policy

    refuse_unknown("format", [options.format], FORMATS)
    model = Path(agent_path(options.model))
    is_app = options.format == APP
    ending = FORMATS[options.format]
    file = Path(options.file or "")
    # Without a suffix it is a folder; without -o, this one. An app is a folder itself.
    if not options.file or (not is_app and (file.is_dir() or not file.suffix)):
        file /= model.stem + ending
    if file.resolve() == model.resolve():
        raise ConfigError(f"{file}: is the model itself; give another file with -o")
    # Suffixes that no format has, such as .hpp, are the user's choice.
    if file.suffix != ending and file.suffix in (*FORMATS.values(), ".zip"):
        raise ConfigError(f"{file}: --format {options.format} writes {model.stem}{ending}")
    refuse_existing(file / HEADER if is_app else file, options.overwrite)
    name = options.name
    if name is None:
        name = c_name(model.stem if is_app else file.stem)
    elif options.format == "onnx":
        raise ConfigError(f"--name {name}: only a C header has one (--format c)")
    if options.vehicle:
        warn(ControllerSpec(model.stem, str(model)).notice(options.vehicle))
    exported = export_policy(model, options.format, options.output, options.vehicle, name)
    files = exported.files or {"": exported.content}
    for path in files:
        refuse_existing(file / path, options.overwrite)
    for path, content in files.items():
        write_bytes(file / path, content)
    print("settings:", exported.settings or "in neither the zip nor its folder")
    for fact, value in exported.metadata.items():
        print(f"{fact}: {value}")
    print(f"saved {file} ({sum(map(len, files.values()))} bytes)")
    return 0
