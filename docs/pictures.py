r"""Make pictures of the pages anew, each by the commands that stand beside its name.

Scripts drew adaptive_times.png, cloning.png, learning_speed.png and robustness.png; commit 5e3ee3c0
is the last that has them, in its folder of examples.

    make pictures                       # those that need no training
    make pictures ARGS="starts.png"     # only these
    make pictures-long                  # those of agents that are trained first, in hours

The commands run in ``build/pictures/``. What is flown or trained there is kept for later calls;
``build/pictures/finished.txt`` lists these commands. Empty the folder to begin anew.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
BUILD = ROOT / "build/pictures"
FINISHED = BUILD / "finished.txt"
KEPT = ("evaluate", "train", "sweep")  # whose folders later calls use

# Agents and evaluations that several pictures show.
CHAPTER_4 = """
sb3-quad evaluate PID=pid geometric "imitation agent=itm-imitation" "RL agent=itm-recovery"
    --suite thesis --scenario side_hit side_hit_size tracking -o thesis
"""
GEOMETRIC = """
sb3-quad train --conf-file nominal/two_stage.yml --seed 0 --num-threads 1 -f geometric
sb3-quad train --conf-file nominal/two_stage.yml --seed 1 --num-threads 1 -f geometric
sb3-quad train --conf-file nominal/two_stage.yml --seed 2 --num-threads 1 -f geometric
"""
PID = """
sb3-quad train --conf-file thesis.yml --seed 0 --num-threads 1 -f pid
sb3-quad train --conf-file thesis.yml --seed 1 --num-threads 1 -f pid
sb3-quad train --conf-file thesis.yml --seed 2 --num-threads 1 -f pid
"""
PRINTED = """
sb3-quad train --conf-file thesis/two_stage.yml --seed 0 --num-threads 1 -f printed
"""
PRINTED_PPO = """
sb3-quad train --algo ppo_bc --env {env} --conf-file thesis/reference.yml --seed 0
    --num-threads 1 --eval-freq 7200000 -f printed_ppo
"""

# By the picture's name: commands, one after the other; a line that is indented continues one. The
# last one draws the picture, or ``cp`` takes it out of a report.
SHORT = {
    "recovery.webp": """
sb3-quad enjoy "our agent (itm-robust)=itm-robust" "PID expert=pid"
    --scenario thesis:recovery_s1 -n 260 --size 320x320 -o recovery.webp
""",
    "recovery_sequence.png": """
sb3-quad enjoy "RL agent=itm-recovery" "PID expert=pid"
    --scenario thesis:recovery_s1 -o recovery_sequence.png
""",
    "thesis_s1_sequence.png": """
sb3-quad enjoy PID=pid RL-agent=thesis-recovery
    --scenario thesis:recovery_s1 -o thesis_s1_sequence.png
""",
    "side_hit_sequence.png": """
sb3-quad enjoy "RL agent=itm-recovery" "PID expert=pid"
    --scenario thesis:side_hit -o side_hit_sequence.png
""",
    "film_frame.png": """
sb3-quad enjoy "RL agent=itm-recovery" geometric "PID expert=pid"
    --task state_recovery --seed 13 -n 90 --speed 0.5 --size 320x320 -o film.webp
frame film.webp 32 film_frame.png
""",
    "side_hit_paths.png": CHAPTER_4 + "cp thesis/figures/side_hit_paths.png side_hit_paths.png",
    "side_hit_size.png": CHAPTER_4
    + "cp thesis/figures/side_hit_size_success.png side_hit_size.png",
    "tracking_times.png": CHAPTER_4 + "cp thesis/figures/tracking_times.png tracking_times.png",
    "starts.png": """
sb3-quad evaluate PID=pid geometric "imitation agent=itm-imitation" "RL agent=itm-recovery"
    --suite robustness --scenario starts -o starts
cp starts/figures/starts_0_success.png starts.png
""",
}
# The committed ones were drawn when the trainings ran. Since then, only their colours have changed,
# and those of the printed recipe were cut to three rows.
LONG = {
    "geometric_recovery_curves.png": GEOMETRIC
    + """
sb3-quad plot "imitation agent=geometric/dagger/QuadStateRecovery-v0_*"
    "RL agent=geometric/ppo_bc/QuadStateRecovery-v0_*" --line expert:100:-1.76
    --title "state recovery, geometric expert" -o geometric_recovery_curves.png
""",
    "geometric_tracking_curves.png": GEOMETRIC
    + """
sb3-quad plot "imitation agent=geometric/dagger/QuadStateRecovery-v0_*"
    "RL agent=geometric/ppo_bc/QuadStateRecovery-v0_*" --task target_tracking
    --line expert:100:-4.59 --title "target tracking, geometric expert"
    -o geometric_tracking_curves.png
""",
    "recovery_curves.png": PID
    + """
sb3-quad sweep ppo_only -f .
sb3-quad plot "RL-agent, first half=pid/ppo_bc/QuadStateRecovery-v0_[135]"
    "RL-agent, second half=pid/ppo_bc/QuadStateRecovery-v0_[246]"
    "PPO only=sweep/ppo_only_1/runs/recoveries-and-targets/seed_*/ppo_bc/QuadStateRecovery-v0_1"
    --thesis state_recovery --title "state recovery, PID expert" -o recovery_curves.png
""",
    "tracking_curves.png": PID
    + """
sb3-quad plot "IL-agent=pid/dagger/QuadTargetTracking-v0_*" --thesis target_tracking
    --title "target tracking, PID expert" -o tracking_curves.png
""",
    "recipe_imitation_curves.png": PRINTED
    + """
sb3-quad plot "IL-agent=printed/dagger/QuadTargetTracking-v0_1" --thesis target_tracking
    --show survival success reward -o recipe_imitation_curves.png
""",
    "recipe_recovery_curves.png": PRINTED
    + """
sb3-quad plot "RL-agent=printed/ppo_bc/QuadStateRecovery-v0_1" --thesis state_recovery
    --show survival success reward -o recipe_recovery_curves.png
""",
    "reference_recovery_curves.png": PRINTED_PPO.format(env="QuadStateRecovery-v0")
    + """
sb3-quad plot "PPO only, on recoveries=printed_ppo/ppo_bc/QuadStateRecovery-v0_1"
    --thesis state_recovery --show survival reward -o reference_recovery_curves.png
""",
    "reference_tracking_curves.png": PRINTED_PPO.format(env="QuadTargetTracking-v0")
    + """
sb3-quad plot "PPO only, on targets=printed_ppo/ppo_bc/QuadTargetTracking-v0_1"
    --thesis target_tracking --show survival reward -o reference_tracking_curves.png
""",
}
PICTURES = SHORT | LONG


def commands(text: str) -> list[list[str]]:
    """Return the words of each command of a picture."""
    return [shlex.split(line) for line in text.strip().replace("\n    ", " ").splitlines() if line]


def run(words: list[str]) -> None:
    """Run a command in BUILD.

    :raises subprocess.CalledProcessError: it fails.
    """
    program, *arguments = words
    if program == "cp":
        shutil.copyfile(BUILD / arguments[0], BUILD / arguments[1])
        return
    if program == "frame":
        frame(BUILD / arguments[0], int(arguments[1]), BUILD / arguments[2])
        return
    if program == "sb3-quad":
        arguments = ["-m", "sb3_quad.cli", *arguments]
        if words[1] in ("enjoy", "plot"):
            arguments.append("--overwrite")
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    subprocess.run([sys.executable, *arguments], cwd=BUILD, env=environment, check=True)


def frame(film: Path, number: int, picture: Path) -> None:
    """Write one frame of a film as a picture."""
    from PIL import Image

    with Image.open(film) as frames:
        frames.seek(number)
        frames.convert("RGB").save(picture, optimize=True)


def main() -> None:
    """Make the pictures that the command line names, and move them into the folder of the pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pictures", nargs="*", metavar="PICTURE", help="only these")
    parser.add_argument("--long", action="store_true", help="those that need a training")
    parser.add_argument("--into", type=Path, default=DOCS, help="folder for them (docs/)")
    options = parser.parse_args()
    unknown = set(options.pictures) - set(PICTURES)
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(PICTURES)}")
    BUILD.mkdir(parents=True, exist_ok=True)
    FINISHED.touch()
    for name in options.pictures or (LONG if options.long else SHORT):
        for words in commands(PICTURES[name]):
            line = shlex.join(words)
            if line in FINISHED.read_text().splitlines():
                continue
            print("$", line, flush=True)
            run(words)
            if words[1] in KEPT:
                with FINISHED.open("a") as file:
                    print(line, file=file)
        options.into.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(BUILD / name, options.into / name)
        print(f"{options.into / name}", flush=True)


if __name__ == "__main__":
    main()
