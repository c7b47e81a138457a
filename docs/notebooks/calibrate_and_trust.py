# %% [markdown]
# # Calibrate and trust
#
# The lenses of this camera stand 41 nm beside their places, which shifts their views by 0.03 pixels of the image. H as
# designed is then not the camera's, and the verdict says so without knowing the truth.

# %%
import matplotlib.pyplot as plt

import ommatid

keys = ['camera.tolerance={position="41 nm"}', "noise.variance=1e-2"]
scene = ommatid.read_scene("tile19", set=keys)
stack, truth = ommatid.render(scene), ommatid.target_image(scene)

designed = ommatid.calibrate(ommatid.read_scene("tile19", set=[*keys, "calibration.method=ideal"]))
result = ommatid.reconstruct(stack, designed, truth)
print("trusted" if result.trusted else "not to be trusted:", *result.summary.verdict.reasons, sep="\n- ")

# %% [markdown]
# ## The held-out check
#
# Every sub-imager is predicted from all others.

# %%
check = ommatid.check(stack, designed)
print("trusted" if check.verdict.trusted else "not to be trusted:", *check.verdict.reasons, sep="\n- ")

# %% [markdown]
# ## Calibrate
#
# Rendered point sources find H of the camera as it stands, and the uncertainty of every number in it.

# %%
calibrated = ommatid.calibrate(scene, stack)
better = ommatid.reconstruct(stack, calibrated, truth)
for name, each in (("as designed", result), ("calibrated", better)):
    print(f"{name:12} measured {each.mse**0.5:.2f}, expected {each.expected_mse**0.5:.2f} grey levels rms, ", end="")
    print("trusted" if each.trusted else "not to be trusted")

# %%
figure, axes = plt.subplots(1, 2, figsize=(7.5, 3.4), layout="constrained")
for ax, (name, each) in zip(axes, (("H as designed", result), ("H calibrated", better)), strict=True):
    shown = ax.imshow((each.image - truth) / each.deviation, cmap="RdBu", vmin=-4, vmax=4)
    figure.colorbar(shown, ax=ax, label="error in error bars")
    ax.set(title=name, xlabel="column", ylabel="row")
    ax.locator_params(integer=True)
