"""Count what a policy's C header costs on a Cortex-M4F, in QEMU's STM32F405, and fit the table of
`sb3_quad/export/cost.py`.

    python examples/microcontroller/measure.py                          # networks of several sizes
    python examples/microcontroller/measure.py crazyflie-robust --optimize=-O2

It needs arm-none-eabi-gcc with newlib and qemu-system-arm (Debian: gcc-arm-none-eabi,
libnewlib-arm-none-eabi, qemu-system-arm). With `-icount shift=0`, each instruction takes a
nanosecond of virtual time, which a timer of the chip reads. QEMU counts instructions, not cycles:
it does not count waiting for flash, or the three cycles that a Cortex-M4 takes for a multiply-add.
"""

import argparse
import itertools
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch
from stable_baselines3 import PPO

from sb3_quad.agents.pretrained import agent_path
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.export.cost import PER_CALL, PER_MULTIPLICATION, PER_UNIT
from sb3_quad.export.policy import export_policy

HERE = Path(__file__).resolve().parent
# The firmware of the Crazyflie is compiled with these flags.
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
    ([192, 128], torch.nn.ReLU, ROBUST),
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


def sizes(exported):
    """Return multiplications, tanh units, ReLU units and 1, from the metadata of an export."""
    layers, _, hidden = exported.metadata["network"].partition(", hidden layers ")
    numbers = [int(number) for number in layers.split("-")]
    products = sum(a * b for a, b in itertools.pairwise(numbers))
    units = sum(numbers[1:-1])
    is_tanh = hidden.startswith("tanh")
    return [products, units * is_tanh, units * (not is_tanh), 1]


def make(layers, activation, sees):
    """Export a network of that shape, whose units are as far from zero as those of an agent."""
    arguments = {"net_arch": {"pi": layers, "vf": [8]}, "activation_fn": activation}
    env = QuadcopterVecEnv(1, seed=0, **sees)
    model = PPO("MlpPolicy", env, policy_kwargs=arguments, seed=0, device="cpu")
    with torch.no_grad():
        for parameter in model.policy.mlp_extractor.policy_net.parameters():
            parameter.mul_(3.0)
    FlightSettings(**sees).write_into(model)
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder) / "network.zip")
        return export_policy(Path(folder) / "network.zip", "c", name="policy", n_observations=200)


def main():
    """Count, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("agents", nargs="*", help="zips or names")
    parser.add_argument("--vehicle", default="crazyflie", help="that agents fly (crazyflie)")
    parser.add_argument("--optimize", default="-Os", help="-Os as the firmware's, or -O2")
    options = parser.parse_args()
    table = np.array([PER_MULTIPLICATION, PER_UNIT["tanh"], PER_UNIT["relu"], PER_CALL])
    if options.agents:
        exports = {
            agent: export_policy(
                agent_path(agent), "c", vehicle=options.vehicle, name="policy", n_observations=200
            )
            for agent in options.agents
        }
    else:
        exports = {f"{made[0]} {made[1].__name__}": make(*made) for made in NETWORKS}
    terms = np.array([sizes(exported) for exported in exports.values()], float)
    counts = np.array([count(exported, options.optimize) for exported in exports.values()])
    if not options.agents:
        # Minimise relative errors, so that small networks are as accurate as large ones.
        table = np.linalg.lstsq(terms / counts[:, None], np.ones(len(counts)), rcond=None)[0]
        product, tanh, relu, call = table
        print(
            f"least squares: {product:.2f} a multiplication, {tanh:.0f} a tanh unit, "
            f"{relu:.0f} a ReLU unit, {call:.0f} a call"
        )
    for name, counted, expected in zip(exports, counts, terms @ table, strict=True):
        print(
            f"{name}: {counted:,.0f} instructions a call, {counted / 168e3:.2f} ms at 168 MHz; "
            f"the table says {100 * (expected / counted - 1):+.1f} %"
        )


if __name__ == "__main__":
    main()
