"""``export``: a trained policy as a file that flies without this package."""

import argparse
from pathlib import Path

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.base.files import refuse_existing, write_bytes
from sb3_quad.export.c_header import c_name
from sb3_quad.export.policy import FORMATS, export_policy


def run(options: argparse.Namespace) -> int:
    """Build, check, time, write. Returns the exit code."""
    if options.format not in FORMATS:
        raise ConfigError(unknown("format", options.format, FORMATS))
    model = Path(options.model)
    file = Path(options.file) if options.file else model.with_suffix(FORMATS[options.format])
    if file.resolve() == model.resolve():
        raise ConfigError(f"{file}: is the model itself; give another file with -o")
    refuse_existing(file, options.overwrite)
    if options.name is not None and options.format != "c":
        raise ConfigError(f"--name {options.name}: only a C header has one (--format c)")
    name = c_name(file.stem) if options.name is None else options.name
    exported = export_policy(model, options.format, options.output, options.vehicle, name=name)
    write_bytes(file, exported.content)
    print(f"settings: {exported.settings or 'none beside the zip'}")
    for key in ("vehicle", "scaling", "network", "observation", "result", "rotors", "check"):
        print(f"{key}: {exported.metadata[key]}")
    print(f"time: {exported.microseconds:.2f} µs per call, one observation, one thread")
    print(f"saved {file} ({len(exported.content)} bytes)")
    return 0
