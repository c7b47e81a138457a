# %% [markdown]
# # Compare one type and three
#
# Two cameras with nearly the same number of sensor pixels: three arrays of one lens type, and one array of each of
# three types. The noise and the target are the same.

# %%
import matplotlib.pyplot as plt
import numpy as np

import ommatid

keys = ["noise.variance=1e-2", "calibration.method=ideal"]
cameras = {"one type": "I,I,I", "three types": "I,II,III"}
scenes = {name: ommatid.read_scene("tile19", set=keys, lens=lens) for name, lens in cameras.items()}
for name, scene in scenes.items():
    found = ommatid.predict(scene, rays=False)
    print(f"{name:12} {found.measurements} measurements, null space of {found.null_space:3} dimensions, ", end="")
    print(f"expected error {found.mse**0.5:.2f} grey levels rms")

# %% [markdown]
# ## The same photograph

# %%
truth = ommatid.target_image(scenes["one type"])
results = {
    name: ommatid.reconstruct(ommatid.render(scene), ommatid.calibrate(scene), truth) for name, scene in scenes.items()
}
figure, axes = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained")
axes[0].imshow(truth, cmap="gray", vmin=truth.min(), vmax=truth.max())
axes[0].set_title("truth")
for ax, (name, result) in zip(axes[1:], results.items(), strict=True):
    ax.imshow(result.image, cmap="gray", vmin=truth.min(), vmax=truth.max())
    ax.set_title(f"{name}: {np.sqrt(result.mse):.2f} grey levels rms")
for ax in axes:
    ax.set(xlabel="column", ylabel="row")

# %% [markdown]
# ## With more noise
#
# Three types keep their lead as long as the null space of one type costs more than the noise.

# %%
variances = np.logspace(-4, 4, 9)
figure, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
for name, lens in cameras.items():
    errors = [
        ommatid.predict(ommatid.read_scene("tile19", set=f"noise.variance={value:g}", lens=lens), rays=False).mse
        for value in variances
    ]
    ax.loglog(np.sqrt(variances), np.sqrt(errors), "o-", label=name)
ax.set(xlabel="noise of the sensor (grey levels)", ylabel="expected error (grey levels rms)")
ax.legend()
ax.grid(alpha=0.3)
