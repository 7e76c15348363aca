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
# Outdoors your quadcopter is heavier than in its data sheet, the wind blows, and the motors are
# late. In this notebook you change one thing after the other and see who still arrives. To see it
# for your own agent, replace one of those below by the path of your zip.

# %%
import tempfile

import matplotlib.pyplot as plt
import numpy as np

from sb3_quad.agents.pretrained import agent_path
from sb3_quad.evaluation.controllers import ControllerSpec
from sb3_quad.evaluation.evaluate import evaluate
from sb3_quad.evaluation.scenarios.load import axis_label, parse_suite
from sb3_quad.report.plots import STYLE

plt.rcParams.update({**STYLE, "figure.constrained_layout.use": True, "figure.dpi": 110})

# %% tags=["parameters"]
EPISODES = 60  # episodes of each controller in each scenario

# %% [markdown]
# ## Scenarios
#
# In a scenario you say where flights begin, where they go and what happens on the way. With `vary`
# you make a grid of scenarios from one. You compare three controllers: the PID; `itm-recovery`,
# which knows one vehicle, undisturbed; and `itm-robust`, which was trained with domain
# randomization, that is with other vehicles, forces and gusts.

# %%
suite = parse_suite(
    f"""
name: outside
scenarios:
  - name: mass
    title: another mass
    task: target_tracking
    duration: 12
    vary: {{randomize.mass: [0.7, 0.85, 1.0, 1.15, 1.3]}}
    n_episodes: {EPISODES}
  - name: force
    title: a constant force
    task: target_tracking
    duration: 12
    wrenches: [{{force: {{magnitude: 0}}}}]
    vary: {{wrenches.0.force.magnitude: [0, 1, 2, 3, 4, 5]}}
    n_episodes: {EPISODES}
  - name: delay
    title: a longer delay
    task: target_tracking
    duration: 12
    vary: {{randomize.delay: [0, 1, 2, 3, 4, 6]}}
    n_episodes: {EPISODES}
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
# All controllers fly the same episodes. `evaluate` gives you a folder with all metrics,
# trajectories and a table of the episodes. The command `sb3-quad evaluate` does the same, and
# writes a page, too.

# %%
folder = tempfile.mkdtemp()
results = evaluate(suite, controllers, f"{folder}/outside")
print(f"{len(results.entries)} entries of {EPISODES} flights")


# %% tags=["hide-input"]
def plot_grid(results):
    """Plot success (with its 95 % interval) and final error over what each scenario varies."""
    groups = {}
    for scenario in results.scenarios:
        groups.setdefault(scenario.group, []).append(scenario)
    n = len(groups)
    figure, axes = plt.subplots(
        2, n, figsize=(3.7 * n, 5.3), sharex="col", sharey="row", squeeze=False
    )
    for (top, bottom), cells in zip(axes.T, groups.values(), strict=True):
        (key,) = cells[0].cell
        x = [cell.cell[key] for cell in cells]
        for controller in results.controllers:
            colour = results.colours[controller.label]
            success = []
            error = []
            for cell in cells:
                metrics = results.entry(controller.label, cell.name).metrics
                share = metrics.success
                success.append((share.value, share.low, share.high))
                # The median of a few survivors would flatter.
                survives = metrics.survival.value >= 0.5
                error.append(metrics.final_error_median if survives else np.nan)
            value, low, high = 100 * np.array(success).T
            top.plot(x, value, "o-", color=colour, markersize=4, label=controller.label)
            top.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
            bottom.plot(x, np.maximum(error, 1e-3), "o-", color=colour, markersize=4)
        top.set_title(cells[0].title.split(":")[0].capitalize(), loc="left", fontweight="bold")
        bottom.set(xlabel=axis_label(key), yscale="log")
        bottom.yaxis.set_major_formatter("{x:g}")
    axes[0, 0].set(ylabel="success (%)", ylim=(-4, 104))
    axes[1, 0].set(ylabel="median final error (m)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(results.controllers))
    plt.show()


# %%
plot_grid(results)

# %% [markdown]
# A successful flight survives and ends within 0.1 m of its target. You see that with another mass,
# or a force, the PID and `itm-recovery` come to rest at an offset, since nothing in them integrates
# the error. `itm-robust` has an integral. It also sees its last observations, from which it can
# estimate what it flies. With a delay of six control steps, only `itm-robust` still arrives.
#
# ## Two things at once
#
# If you vary two keys, you get a map. This one shows recoveries by the tilt and the body rates at
# the start, at 6 m/s in a random direction.

# %%
tumbling = parse_suite(
    f"""
name: tumbling
scenarios:
  - name: starts
    task: state_recovery
    start: {{tilt: 0, body_rates: {{magnitude: 0}}, velocity: {{magnitude: 6}}}}
    vary:
      start.tilt: [0, 45, 90, 135, 180]
      start.body_rates.magnitude: [0, 4, 8, 12]
    duration: 6
    n_episodes: {EPISODES}
""",
    where="this notebook",
)
maps = evaluate(tumbling, controllers, f"{folder}/tumbling")

# %% tags=["hide-input"]
figure, panels = plt.subplots(
    1, len(controllers), figsize=(3.5 * len(controllers), 3.2), sharey=True
)
tilts = [0, 45, 90, 135, 180]
body_rates = [0, 4, 8, 12]
for panel, controller in zip(panels, maps.controllers, strict=True):
    shares = []
    for scenario in maps.scenarios:
        shares.append(maps.entry(controller.label, scenario.name).metrics.survival.value * 100)
    grid = np.reshape(shares, (len(tilts), len(body_rates))).T
    image = panel.imshow(grid, origin="lower", aspect="auto", cmap="viridis", vmin=0, vmax=100)
    for row, column in np.ndindex(grid.shape):
        colour = "white" if grid[row, column] < 60 else "black"
        text = f"{grid[row, column]:.0f}"
        panel.text(column, row, text, ha="center", va="center", color=colour, fontsize=8)
    panel.set_xticks(range(len(tilts)), tilts)
    panel.set_yticks(range(len(body_rates)), body_rates)
    panel.grid(visible=False)
    panel.set_title(controller.label, loc="left", fontweight="bold")
    panel.set_xlabel("tilt at the start (deg)")
panels[0].set_ylabel("body rates at the start (rad/s)")
figure.colorbar(image, ax=panels, label="survival (%)")
plt.show()

# %% [markdown]
# ## Further
#
# The suite `robustness` of the package varies more: inertia, motors, noise, gusts and hits. Try it
# with your agent: `sb3-quad evaluate pid my_agent.zip --suite robustness --workers 2`. If it fails
# there, train it with domain randomization, as `sb3-quad train` does by default.
