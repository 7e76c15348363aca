"""``export``: a trained policy as a file that flies without this package."""

import argparse
import sys
from pathlib import Path

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import refuse_existing, write_bytes
from sb3_quad.cli.output import output_file
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.export.c_header import c_name
from sb3_quad.export.policy import FORMATS, export_policy


def run(options: argparse.Namespace) -> int:
    """Build, check, time, write. Returns the exit code."""
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
    if options.vehicle and (line := ControllerSpec(model.stem, str(model)).notice(options.vehicle)):
        print(f"warning: {line}", file=sys.stderr)
    exported = export_policy(model, options.format, options.output, options.vehicle, name=name)
    write_bytes(file, exported.content)
    print(f"settings: {exported.settings or 'neither in the zip nor beside it; assumed: itm, the scaling of Table A.2'}")
    for key in ("vehicle", "scaling", "network", "observation", "state", "result", "rotors", "check"):
        if key in exported.metadata:
            print(f"{key}: {exported.metadata[key]}")
    if exported.microseconds is not None:
        print(f"time: {exported.microseconds:.2f} µs per call, one observation, one thread")
    print(f"saved {file} ({len(exported.content)} bytes)")
    return 0
