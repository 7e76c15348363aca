"""Count what a policy's C header costs on a Cortex-M4F, in QEMU's STM32F405, and fit the table of
`sb3_quad/export/cost.py`.

    python examples/microcontroller/measure.py                          # networks of several sizes
    python examples/microcontroller/measure.py crazyflie-robust -O=-O2  # agents; other flags

It needs arm-none-eabi-gcc with newlib and qemu-system-arm (Debian: gcc-arm-none-eabi,
libnewlib-arm-none-eabi, qemu-system-arm). `-icount shift=0` lets each instruction take a nanosecond
of virtual time, and a timer of the chip reads it. QEMU counts instructions, not cycles: waiting for
flash, and the three cycles that a Cortex-M4 takes for a multiply-add, are not in them.
"""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch

HERE = Path(__file__).resolve().parent
# The firmware of the Crazyflie is compiled so.
CORE = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-fno-math-errno")
LINK = ("--specs=rdimon.specs", "-nostartfiles", "-ffunction-sections", "-Wl,--gc-sections")
QEMU = (
    "qemu-system-arm -M netduinoplus2 -nographic -monitor none -serial none "
    "-semihosting-config enable=on,target=native -icount shift=0 -kernel"
)
ROBUST = {"history": [0, 1, 2, 4, 8, 16, 32, 96], "last_action": True, "position_integral": {}}
NETWORKS = [
    ([64, 64], torch.nn.Tanh, {}),
    ([128, 128], torch.nn.Tanh, {}),
    ([64, 64], torch.nn.ReLU, {}),
    ([128, 64], torch.nn.ReLU, {}),
    ([256], torch.nn.Tanh, {}),
    ([96, 32], torch.nn.Tanh, ROBUST),
]


def build(folder, sources, flags=("-Os",), includes=()):
    """Compile and link C files of `folder` for the Cortex-M4F. Return the program's path."""
    program = Path(folder) / "program.elf"
    files = [HERE / "startup.c", *sources]
    command = ["arm-none-eabi-gcc", *flags, *CORE, *LINK, "-T", HERE / "memory.ld"]
    command += [f"-I{path}" for path in (folder, *includes)]
    command += [*files, "-lm", "-o", program]
    subprocess.run(command, check=True, cwd=folder)
    return program


def run(program):
    """Run a program in QEMU, in its own folder. Return what it prints, in words."""
    done = subprocess.run(
        [*QEMU.split(), program],
        cwd=program.parent,
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    )
    return done.stdout.split()


def features(n, inputs, seed=0):
    """Observations (n, inputs), float32: any attitude, within some metres of the target."""
    generator = np.random.default_rng(seed)
    rotation = np.linalg.qr(generator.normal(size=(n, 3, 3)))[0].reshape(n, 9)
    position = generator.normal(size=(n, 3), scale=2.0)
    motion = generator.normal(size=(n, inputs - 12), scale=1.0)
    return np.hstack([position, rotation, motion]).astype(np.float32)


def count(exported, optimize="-Os", n=1000):
    """Return instructions of a call of a header whose function is `policy_policy`, on average."""
    inputs = int(exported.metadata["observation"].split()[0])
    stateful = ["-DSTATEFUL"] if "state" in exported.metadata else []
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "policy.h").write_bytes(exported.content)
        features(n, inputs).tofile(Path(folder, "in.bin"))
        calls, instructions = run(build(folder, [HERE / "main.c"], [optimize, *stateful]))
    assert int(calls) == n
    return float(instructions)
