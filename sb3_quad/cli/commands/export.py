"""Write a trained policy as ONNX, TorchScript or a C header: physical units in, rotor thrusts or
speeds out.

The file takes 18 numbers in physical units: position relative to the target, m, world frame;
rotation matrix world to body, row by row; velocity, m/s, and body rates, rad/s, body frame. It
returns the command for each rotor. Scaling and clipping are built in. The file is checked against
the policy on 10,000 observations before it is written. A policy that sees earlier frames, its last
action or the position integral takes a state beside them, and returns the next.

examples:
  sb3-quad export logs/ppo_bc/QuadStateRecovery-v0_1/corrected_model.zip --format onnx
  sb3-quad export agent.zip --format c -o firmware/agent.h --name agent     agent_policy(observation, thrust)
  sb3-quad export agent.zip --format torchscript --output speeds            rotor speeds, rad/s
  sb3-quad export agent.zip --format c --vehicle my_vehicle.yaml

ONNX needs onnx and onnxruntime: pip install '.[export]' from a clone. A C header needs a C compiler
to check it.
"""

import argparse
from pathlib import Path

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import refuse_existing, write_bytes
from sb3_quad.cli.parser import Parser, add_common
from sb3_quad.controllers.pretrained import agent_path


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    model = "an MlpPolicy (of PPO, A2C, DAgger, PPOBC, SAC, SACBC, TD3): a zip, a run folder, or a name like itm-recovery"
    add("model", type=agent_path, metavar="MODEL", help=model)
    add("--format", required=True, metavar="FORMAT", help="onnx, torchscript or c")
    file = "file to write, or a folder for it (here, named as the zip, .onnx, .pt or .h)"
    add("-o", metavar="FILE", dest="file", help=file)
    add(
        "--output",
        default="thrusts",
        metavar="KIND",
        help="what it gives: thrusts (N, default) or speeds (rad/s)",
    )
    add(
        "--vehicle",
        metavar="VEHICLE",
        help="name or YAML file (the one that the zip or its run folder says)",
    )
    add(
        "--name",
        metavar="NAME",
        help="name the C function NAME_policy (the file's name without its ending)",
    )
    add_common(parser, "trust", "overwrite")


def run(options: argparse.Namespace) -> int:
    """Build, check, write. Returns the exit code."""
    from sb3_quad.cli.output import output_file, warn
    from sb3_quad.evaluation.controllers import ControllerSpec
    from sb3_quad.export.c_header import c_name
    from sb3_quad.export.policy import FORMATS, export_policy

    if options.format not in FORMATS:
        raise ConfigError(unknown("format", options.format, FORMATS))
    model = Path(options.model)
    file = output_file(options.file, model.stem + FORMATS[options.format])
    if file.resolve() == model.resolve():
        raise ConfigError(f"{file}: is the model itself; give another file with -o")
    refuse_existing(file, options.overwrite)
    if options.name is not None and options.format != "c":
        raise ConfigError(f"--name {options.name}: only a C header has one (--format c)")
    name = c_name(file.stem) if options.name is None else options.name
    if options.vehicle:
        warn(ControllerSpec(model.stem, str(model)).notice(options.vehicle))
    exported = export_policy(model, options.format, options.output, options.vehicle, name=name)
    write_bytes(file, exported.content)
    print(
        f"settings: {exported.settings or 'neither in the zip nor beside it; assumed: itm, the scaling of Table A.2'}"
    )
    for key in (
        "vehicle",
        "scaling",
        "network",
        "observation",
        "state",
        "result",
        "rotors",
        "check",
    ):
        if key in exported.metadata:
            print(f"{key}: {exported.metadata[key]}")
    print(f"saved {file} ({len(exported.content)} bytes)")
    return 0
