# %% [markdown]
# # First camera
#
# A camera of three lens types images a photograph of 19 x 19 pixels. Its sub-images become one image with an error bar
# for every pixel.

# %%
import matplotlib.pyplot as plt
import numpy as np

import ommatid

scene = ommatid.read_scene("tile19", set=["noise.variance=1e-2", "calibration.method=ideal"])
scene

# %% [markdown]
# ## What to expect
#
# `predict` computes the expected error before anything is rendered. No null space: every image can be recovered.

# %%
prediction = ommatid.predict(scene, rays=False)
print(f"null space of {prediction.null_space} dimensions, expected error {prediction.mse**0.5:.2f} grey levels rms")

# %% [markdown]
# ## Render and reconstruct
#
# The stack holds what the sensor records. The model holds H.

# %%
stack, model = ommatid.render(scene), ommatid.calibrate(scene)
stack

# %%
truth = ommatid.target_image(scene)
result = ommatid.reconstruct(stack, model, truth)
error = result.image - truth
print(f"measured error {np.sqrt(np.mean(error**2)):.2f} grey levels rms")
print("trusted" if result.trusted else result.summary.verdict)

# %% [markdown]
# ## Look at it

# %%
figure, axes = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
pictures = {"truth": truth, "estimate": result.image, "error": error, "error bar": result.deviation}
for ax, (name, picture) in zip(axes, pictures.items(), strict=True):
    figure.colorbar(ax.imshow(picture, cmap="gray"), ax=ax, location="bottom", label="grey levels")
    ax.set(title=name, xlabel="column", ylabel="row")
    ax.locator_params(integer=True)

# %% [markdown]
# Errors of neighbouring pixels are correlated. The error bar of a mean takes this into account:

# %%
mean, deviation = result.reconstruction.region((8, 8), (4, 4))
print(f"estimated mean of 4 x 4 pixels: {mean:.2f} +- {deviation:.2f}, true mean: {truth[8:12, 8:12].mean():.2f}")
