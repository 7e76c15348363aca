"""Write a trained policy as ONNX, TorchScript or a C header: physical units in, rotor thrusts or speeds out.

The file takes 18 numbers in physical units: position relative to the target, m, world frame; rotation matrix
world to body, row by row; velocity, m/s, and body rates, rad/s, body frame. It returns the command for each rotor.
Scaling and clipping are built in. The file is checked against the policy on 10,000 observations before it is written.
A policy that sees earlier frames, its last action or the position integral takes a state beside them, and returns the next.

examples:
  sb3-quad export logs/ppo_bc/QuadStateRecovery-v0_1/trimmed_model.zip --format onnx
  sb3-quad export agent.zip --format c -o firmware/agent.h --name agent     agent_policy(observation, thrust)
  sb3-quad export agent.zip --format torchscript --output speeds            rotor speeds, rad/s
  sb3-quad export agent.zip --format c --vehicle my_vehicle.yaml

ONNX needs onnx and onnxruntime: pip install '.[export]' from a clone. A C header needs a C compiler to check it.
"""

from sb3_quad.cli.parser import TRUST, Parser
from sb3_quad.controllers.pretrained import agent_path


def add_arguments(parser: Parser) -> None:
    add = parser.add_argument
    agent = "an agent with MlpPolicy (PPO, A2C, DAgger, PPOBC): a zip, a run folder, or a name like itm-recovery"
    add("model", type=agent_path, metavar="MODEL", help=agent)
    add("--format", required=True, metavar="FORMAT", help="onnx, torchscript or c")
    add(
        "-o",
        metavar="FILE",
        dest="file",
        help="file to write, or a folder for it (here, named as the zip, .onnx, .pt or .h)",
    )
    add("--output", default="thrusts", metavar="KIND", help="what it gives: thrusts (N, default) or speeds (rad/s)")
    add("--vehicle", metavar="VEHICLE", help="name or YAML file (the one that the zip or its run folder says)")
    add("--name", metavar="NAME", help="name the C function NAME_policy (the file's name without its ending)")
    add("--trust", action="store_true", help=TRUST)
    add("--overwrite", action="store_true", help="replace FILE if it exists")
