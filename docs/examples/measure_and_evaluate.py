# %% [markdown]
# # Measure, evaluate and plot from Python
#
# This file is a notebook: editors show its cells by the marks `# %%`, and
# `jupytext --to ipynb measure_and_evaluate.py` converts it. As a script it takes the output folder:
# `python docs/examples/measure_and_evaluate.py FOLDER`. `measure.api` has every command as a
# function; `measure.Run` gives poses as arrays.

# %%
from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

import measure
from measure import api
from measure.host import Registry

IN_A_NOTEBOOK = "ipykernel" in sys.modules
folder = Path("example" if IN_A_NOTEBOOK or len(sys.argv) < 2 else sys.argv[1])
frame_sets = 12

# %% [markdown]
# ## A recording
#
# A session is a folder with images, their times, the calibration and the body. Here a short one is
# rendered: four cameras, three balls, exact truth. Put the folder of your own session in its place.

# %%
session = api.render_demo(folder, frame_sets)

# %% [markdown]
# ## Measure
#
# `precise` is the default profile. `choose` swaps a stage or changes a setting, as `--solver` and
# `--set` do on the command line. The run folder holds a row for every frame set.

# %%
registry = Registry.discover()
profile = api.choose(api.load_profile("precise"), {"solver": "contours"}, ["detector.rays=96"])
options = api.RunOptions(recording=False, overwrite=True)
summary = api.run(session, folder / "run", profile, registry, options)
print(f"{summary.ok} of {summary.frame_sets} frame sets have a pose without a flag")

# %% [markdown]
# ## Evaluate
#
# `evaluate` compares the run with the session's truth; `evaluation_tables` formats the result as
# `measure evaluate` prints it.

# %%
evaluation = api.evaluate(folder / "run")
for table in api.evaluation_tables(evaluation):
    print(f"\n{table.title}\n{' | '.join(table.columns)}")
    for row in table.rows:
        print(" | ".join("" if cell is None else str(cell) for cell in row))

# %% [markdown]
# ## Errors and their stated uncertainty
#
# `measure.Run` has the pose and its 6x6 covariance (x y z in mm, then the rotation vector in rad)
# of every frame set. `api.read_trajectory` interpolates the truth at the times of the frame sets.

# %%
run = measure.Run.load(folder / "run")
truth = api.read_trajectory(session / "truth.csv").at(run.times)
error_mm = run.position - truth.translation
sd_mm = np.sqrt(np.diagonal(run.covariance, axis1=1, axis2=2)[:, :3])
rms_mm = float(np.sqrt(np.mean(np.sum(error_mm**2, axis=1))))
print(f"\nposition error {rms_mm:.3f} mm RMS in 3-D")

# %%
figure = go.Figure()
for i, axis in enumerate("xyz"):
    error_bars = {"type": "data", "array": 2 * sd_mm[:, i]}
    figure.add_scatter(x=run.times, y=error_mm[:, i], error_y=error_bars, mode="markers", name=axis)
figure.update_layout(
    title="Measured minus true position, with two stated standard deviations",
    xaxis_title="time, s",
    yaxis_title="error, mm",
)
if IN_A_NOTEBOOK:
    figure.show()
figure.write_html(folder / "errors.html", include_plotlyjs=True)
print(f"wrote {folder / 'errors.html'}")
