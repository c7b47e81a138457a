# %% [markdown]
# # The paper, with a slider
#
# A tile of 19 x 19 pixels, one, two or three lens types, and noise: Eq. 4 and Eq. 5 of the paper in a few lines of
# NumPy. With [ipywidgets](https://ipywidgets.readthedocs.io) the last cell has sliders; without, it shows fixed values.

# %%
import matplotlib.pyplot as plt
import numpy as np

import ommatid

truth = ommatid.target_image(ommatid.read_scene("tile19"))
lenses = {"one type, twice": "I,I", "two types": "I,II", "three types": "I,II,III"}
scenes = {
    name: ommatid.read_scene("tile19", set="calibration.method=ideal", lens=lens) for name, lens in lenses.items()
}
matrices = {name: ommatid.calibrate(scene).matrix.toarray() for name, scene in scenes.items()}
mean, variance = 127.5, (256**2 - 1) / 12  # f0 and P0: every value from 0 to 255 is equally likely

# %% [markdown]
# ## The estimator
#
# A depends on the noise variance that it *expects*. Its expected error is a straight line in the *actual* one: the part
# of the prior, and the part of the noise.


# %%
def estimator(H, expected):
    """A = P0 H^T (H P0 H^T + Rv)^-1 (Eq. 4)."""
    return np.linalg.solve(variance * H @ H.T + expected * np.eye(len(H)), variance * H).T


def expected_error(H, expected, actual):
    """The mean of the diagonal of (I - A H) P0 (I - A H)^T + A Rv A^T (Eq. 5)."""
    A = estimator(H, expected)
    missed = np.eye(truth.size) - A @ H
    return (variance * (missed**2).sum() + actual * (A**2).sum()) / truth.size


# %% [markdown]
# ## Error against noise
#
# Figure 2: one or two types have a null space, and the error stays where it is; three types have none.

# %%
actual = np.logspace(-6, 2, 9)
figure, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
for name, H in matrices.items():
    ax.loglog(actual, [expected_error(H, noise, noise) for noise in actual], "o-", label=name)
ax.set(xlabel="noise variance (grey levels squared)", ylabel="expected squared error per pixel")
ax.legend()
ax.grid(alpha=0.3)

# %% [markdown]
# ## Try it
#
# The noise as a power of ten, what the estimator expects, and the lens types.


# %%
def show(types="three types", noise=-2.0, expected=-2.0):
    """Draw an estimate and its error; noise, expected : variances as powers of ten."""
    H = matrices[types]
    recorded = H @ truth.ravel() + np.random.default_rng(0).normal(0, 10 ** (noise / 2), len(H))
    estimate = mean + estimator(H, 10.0**expected) @ (recorded - mean * H.sum(axis=1))
    error = expected_error(H, 10.0**expected, 10.0**noise)
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained")
    for ax, image in zip(axes, (truth, estimate.reshape(truth.shape)), strict=False):
        ax.imshow(image, cmap="gray", vmin=truth.min(), vmax=truth.max())
        ax.set(xlabel="column", ylabel="row")
    axes[0].set_title("truth")
    axes[1].set_title(f"{types}: {np.sqrt(np.mean((estimate - truth.ravel()) ** 2)):.3g} grey levels rms")
    difference = (estimate - truth.ravel()).reshape(truth.shape)
    limit = abs(difference).max()
    drawn = axes[2].imshow(difference, cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes[2].set(title=f"error; expected {error**0.5:.3g} rms", xlabel="column", ylabel="row")
    figure.colorbar(drawn, ax=axes[2], label="grey levels")
    plt.show()


try:
    from ipywidgets import interact
except ImportError:
    show("two types")
    show("three types")
else:
    interact(show, types=list(matrices), noise=(-6.0, 2.0), expected=(-6.0, 2.0))
