# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # How robust is your agent
#
# A quadcopter outside is heavier than in the data sheet, the wind pushes it, its motors are late.
# This notebook changes one thing after the other and asks who still arrives. Put the path of your
# own zip in the place of an agent below.

# %%
import tempfile

import matplotlib.pyplot as plt
import numpy as np

from sb3_quad.base.colours import COLOURS
from sb3_quad.controllers.pretrained import agent_path
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.evaluate import evaluate
from sb3_quad.evaluation.scenarios.load import axis_label, parse_suite
from sb3_quad.report.plots import STYLE

plt.rcParams.update({**STYLE, "figure.constrained_layout.use": True, "figure.dpi": 110})

# %% tags=["parameters"]
EPISODES = 60  # of each controller in each scenario

# %% [markdown]
# ## Scenarios
#
# A scenario says where flights begin, where they go and what happens on the way. `vary` makes a
# grid of scenarios of one. The thesis's agents know one vehicle in still air; `itm-robust` was
# trained in random worlds, with changed vehicles, forces and gusts.

# %%
suite = parse_suite(
    f"""
name: outside
scenarios:
  - name: mass
    title: another mass
    target: {{distance: 10}}
    duration: 12
    vary: {{vehicle_changes.mass: [0.7, 0.85, 1.0, 1.15, 1.3]}}
    episodes: {EPISODES}
  - name: force
    title: a constant force
    target: {{distance: 10}}
    duration: 12
    wrenches: [{{force: {{magnitude: 0}}}}]
    vary: {{wrenches.0.force.magnitude: [0, 1, 2, 3, 4, 5]}}
    episodes: {EPISODES}
  - name: delay
    title: a longer delay
    target: {{distance: 10}}
    duration: 12
    vary: {{vehicle_changes.delay: [0, 1, 2, 3, 4, 6]}}
    episodes: {EPISODES}
""",
    where="this notebook",
)
controllers = [
    ControllerSpec("PID expert", "pid"),
    ControllerSpec("itm-recovery", agent_path("itm-recovery")),
    ControllerSpec("itm-robust", agent_path("itm-robust")),
]

# %% [markdown]
# ## Flights
#
# All controllers fly the same episodes. `evaluate` leaves a folder with all metrics, trajectories
# and a table of the episodes; the command `sb3-quad evaluate` does the same and makes a page of it.

# %%
folder = tempfile.mkdtemp()
results = evaluate(suite, controllers, f"{folder}/outside")
print(f"{len(results.entries)} entries of {EPISODES} flights")


# %% tags=["hide-input"]
def plot_grid(results):
    """Success with its 95 % interval, and the median final error, over what each group of scenarios
    varies.
    """
    groups = list(dict.fromkeys(each.group for each in results.scenarios))
    figure, axes = plt.subplots(
        2, len(groups), figsize=(3.7 * len(groups), 5.3), sharex="col", sharey="row", squeeze=False
    )
    for (top, bottom), group in zip(axes.T, groups, strict=True):
        cells = [each for each in results.scenarios if each.group == group]
        (key,) = cells[0].cell
        x = [cell.cell[key] for cell in cells]
        for controller, colour in zip(results.controllers, COLOURS, strict=False):
            metrics = [results.entry(controller.label, cell.name).metrics for cell in cells]
            success = (
                100
                * np.array(
                    [[each.success.value, each.success.low, each.success.high] for each in metrics]
                ).T
            )
            error = [
                each.final_error_median if each.survival.value >= 0.5 else np.nan
                for each in metrics
            ]
            top.plot(x, success[0], "o-", color=colour, markersize=4, label=controller.label)
            top.fill_between(x, success[1], success[2], color=colour, alpha=0.15, linewidth=0)
            bottom.plot(x, np.maximum(error, 1e-3), "o-", color=colour, markersize=4)
        top.set_title(cells[0].title.split(":")[0].capitalize(), loc="left", fontweight="bold")
        bottom.set(xlabel=axis_label(key, cells[0]), yscale="log")
        bottom.yaxis.set_major_formatter("{x:g}")
    axes[0, 0].set(ylabel="success (%)", ylim=(-4, 104))
    axes[1, 0].set(ylabel="median final error (m)")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=len(results.controllers),
    )
    plt.show()


# %%
plot_grid(results)

# %% [markdown]
# A success survives and ends within 0.1 m of its target. Under another mass or a force the PID and
# `itm-recovery` come to rest beside the target, since nothing in them adds up the error.
# `itm-robust` has an integral and remembers its last observations, so that it finds out what it
# flies. A delay of six control steps is too much for all three.
#
# ## Two things at once
#
# A grid over two keys is a map: recoveries by how far the quadcopter is tilted and how fast it
# tumbles when it is let go, at 6 m/s in a random direction.

# %%
tumbling = parse_suite(
    f"""
name: tumbling
scenarios:
  - name: starts
    start: {{attitude: {{tilt: 0}}, body_rates: {{magnitude: 0}}, velocity: {{magnitude: 6}}}}
    vary:
      start.attitude.tilt: [0, 45, 90, 135, 180]
      start.body_rates.magnitude: [0, 4, 8, 12]
    duration: 6
    episodes: {EPISODES}
""",
    where="this notebook",
)
maps = evaluate(tumbling, controllers, f"{folder}/tumbling")

# %% tags=["hide-input"]
figure, panels = plt.subplots(
    1, len(controllers), figsize=(3.5 * len(controllers), 3.2), sharey=True
)
first, second = (
    list(dict.fromkeys(each.cell[key] for each in maps.scenarios)) for key in maps.scenarios[0].cell
)
for panel, controller in zip(panels, maps.controllers, strict=True):
    shares = [
        maps.entry(controller.label, each.name).metrics.survival.value * 100
        for each in maps.scenarios
    ]
    grid = np.reshape(shares, (len(first), len(second))).T
    image = panel.imshow(grid, origin="lower", aspect="auto", cmap="viridis", vmin=0, vmax=100)
    for row, column in np.ndindex(grid.shape):
        colour = "white" if grid[row, column] < 60 else "black"
        panel.text(
            column,
            row,
            f"{grid[row, column]:.0f}",
            ha="center",
            va="center",
            color=colour,
            fontsize=8,
        )
    panel.set_xticks(range(len(first)), [f"{value:g}" for value in first])
    panel.set_yticks(range(len(second)), [f"{value:g}" for value in second])
    panel.grid(visible=False)
    panel.set_title(controller.label, loc="left", fontweight="bold")
    panel.set_xlabel("tilt at the start (deg)")
panels[0].set_ylabel("body rates at the start (rad/s)")
figure.colorbar(image, ax=panels, label="survival (%)")
plt.show()

# %% [markdown]
# ## Further
#
# The suite `robustness` of the package has more: inertia, motors, noise, gusts and hits, `sb3-quad
# evaluate pid my_agent.zip --suite robustness --workers 2`. An agent that fails there can be
# trained in random worlds: `sb3-quad train` does so by default.
