# %% [markdown]
# # Sweep a tolerance
#
# How precisely do the lenses have to stand? The expected error against the standard deviation of their positions, for
# an estimator that takes H as designed, and with a calibrated H.

# %%
import matplotlib.pyplot as plt
import numpy as np

import ommatid


def tolerance(position: float) -> str:
    """Return the key for lenses displaced by a standard deviation in nanometres."""
    return f'camera.tolerance={{position="{position:g} nm"}}'


positions = np.logspace(0, 3, 7)  # nanometres
designed = [
    ommatid.predict(ommatid.read_scene("tile19", set=["noise.variance=1e-2", tolerance(each)]), rays=False).mse
    for each in positions
]
calibrated = ommatid.predict(ommatid.read_scene("tile19", set="noise.variance=1e-2"), rays=False).mse

# %%
figure, ax = plt.subplots(figsize=(6, 3.8), layout="constrained")
ax.loglog(positions, np.sqrt(designed), "o-", label="H as designed")
ax.axhline(np.sqrt(calibrated), color="tab:green", label="H calibrated, without its own noise")
ax.set(xlabel="standard deviation of the lens positions (nm)", ylabel="expected error (grey levels rms)")
ax.legend()
ax.grid(alpha=0.3)

# %% [markdown]
# The largest tolerance at which the design's H costs at most half as much again:

# %%
affordable = np.interp(1.5 * np.sqrt(calibrated), np.sqrt(designed), positions)
print(f"{affordable:.0f} nm")
