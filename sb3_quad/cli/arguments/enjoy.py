"""Watch controllers fly: in PyBullet's window, as a film, or as poses in one picture; several side by side.

examples:
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 -f logs          the latest run's agent, in a window
  sb3-quad enjoy --algo ppo_bc --env QuadStateRecovery-v0 --exp-id 2 --load-best
  sb3-quad enjoy pid geometric agent=path/to/agent.zip --task state_recovery --seed 13 -o recovery.mp4
  sb3-quad enjoy agent.zip pid --scenario thesis:recovery_s1 -o s1.png
  sb3-quad enjoy agent.zip --target 5 0 20 --force -20 -20 0 --torque -5 -5 -5 --at 2.5 --for 0.02 -o hit.mp4 --speed 0.5
  sb3-quad enjoy geometric --env-kwargs noise:0 vehicle:my_vehicle.yaml -n 3000 --no-render

A controller is pid, geometric, the path of an SB3 zip or a run folder, or package.module:factory; name=… labels it.
The first agent says which vehicle, task and observation all fly with, unless --env, --task, --scenario or --env-kwargs do.
Without --load-…, the agent of a run is trimmed_model.zip, else best_model.zip, else <Env>.zip.
"""

import argparse

from sb3_quad.cli.parser import BRIDGE, TRUST, Pairs, Parser, above_zero, natural, pointers, positive, whole

LACKED = "--num-threads --verbose --device --norm-reward --reward-log --gym-packages --custom-objects"
DEFAULT_ENV = "QuadTargetTracking-v0"


def add_arguments(parser: Parser) -> None:
    """The flags of rl-zoo's ``enjoy.py``, with their meanings, and those of what is flown and how it is shown."""
    parser.elsewhere = pointers(LACKED, BRIDGE.format("enjoy"))
    add = parser.add_argument
    add("controllers", nargs="*", metavar="CONTROLLER", help="who flies, besides the agent of --algo")
    add_flight_arguments(parser)
    parser.set_defaults(trained_agent=None)
    add("-n", "--n-timesteps", type=positive, metavar="N", help="control steps, in as many episodes as needed (one episode)")
    add("--no-render", action="store_true", help="only fly and print how it went")
    add("--task", metavar="NAME", help="target_tracking or state_recovery, instead of --env")
    add("--scenario", metavar="SUITE:NAME", help="a scenario of a suite, such as thesis:side_hit, instead of --env")
    add("--target", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where to fly to, m")
    add("--force", nargs=3, type=float, metavar=("X", "Y", "Z"), help="an external force, world frame, N")
    add("--torque", nargs=3, type=float, metavar=("X", "Y", "Z"), help="an external torque, body frame, N m")
    add("--at", dest="start", type=float, metavar="S", help="when force and torque begin, s (0)")
    add("--for", dest="duration", type=float, metavar="S", help="how long they act, s (to the end)")
    output = "write a film (.mp4, .gif) or the first episode as poses in one picture (.png) instead of opening a window"
    add("-o", "--output", metavar="FILE", help=output)
    add("--record", metavar="FILE", help="write a film, also beside a picture: .mp4 or .gif")
    add("--sequence", metavar="FILE", help="write a picture, also beside a film: .png")
    add("--times", nargs="+", type=float, metavar="S", help="times of the sequence's poses, s (wherever they do not overlap)")


def add_flight_arguments(parser: Parser) -> None:
    """The flags of rl-zoo's ``enjoy.py`` for an agent and its episodes, with their meanings, and those of a film."""
    add = parser.add_argument
    add("--algo", help="algorithm of a trained agent, looked up in the log folder")
    add("--env", help=f"environment id ({DEFAULT_ENV})")
    add("-f", "--folder", "--log-folder", default="logs", metavar="DIR", help="folder that holds the run folders (logs)")
    add("--exp-id", type=int, default=0, metavar="N", help="number of the run; 0: the latest with an agent (0)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--load-best", dest="which", action="store_const", const="best", help="the best agent of the evaluations"
    )
    which.add_argument("--load-checkpoint", dest="which", type=whole, metavar="N", help="the checkpoint after N timesteps")
    last = "last checkpoint"
    which.add_argument("--load-last-checkpoint", dest="which", action="store_const", const=last, help=f"the {last}")
    add("--n-envs", type=positive, default=1, metavar="N", help="episodes side by side, with consecutive seeds (1)")
    add("--seed", type=natural, default=0, metavar="N", help="seed of the first episode (0); later ones count up")
    actions = parser.add_mutually_exclusive_group()
    actions.add_argument("--deterministic", action="store_true", help="fly the mean of a policy's actions (default)")
    actions.add_argument("--stochastic", action="store_true", help="sample from a policy's actions")
    add("--env-kwargs", action=Pairs, nargs="+", default={}, metavar="K:V", help="environment keywords, such as noise:0")
    add("--trust", action="store_true", help=TRUST)
    add("--size", default="", metavar="WxH", help="size of one controller's panel, pixels")
    add("--speed", type=above_zero, default=1.0, metavar="X", help="playback speed of film and window; 0.5 is slow motion (1)")
    add("--overwrite", action="store_true", help="replace existing files")
    add("-P", "--progress", action=argparse.BooleanOptionalAction, help="progress bar of a film (in a terminal: yes)")
