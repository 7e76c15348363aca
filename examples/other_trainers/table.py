"""The table that the scripts for other trainers print, with a row for each seed."""

HEADER = (
    "| trainer | seed | CPU s | its own episodes: length, of 500 "
    "| gentle starts: distance at the end | recoveries: survive | succeed |\n"
    "|---|---|---|---|---|---|---|"
)


def print_row(
    trainer: str,
    seed: int,
    cpu_seconds: float,
    length: float,
    distance: float,
    survival: float,
    success: float,
) -> None:
    """Print a line of the table.

    :param length: mean number of steps of an episode in the trainer's own simulator.
    :param distance: median distance from the target at the end of a flight with a gentle start, m.
    :param survival: share of the thesis's recoveries that survive.
    :param success: share of them that succeed.
    """
    shares = f"{survival:.1%} | {success:.1%}"
    print(
        f"| {trainer} | {seed} | {cpu_seconds:.1f} | {length:.0f} | {distance:.2f} m | {shares} |",
        flush=True,
    )
