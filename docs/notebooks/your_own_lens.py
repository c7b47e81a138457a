# %% [markdown]
# # Your own lens
#
# A scene is a dictionary of tables. This one has thin lenses with apertures, whose diffraction depends on the f-number.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import ommatid
from ommatid.scenes.scene import parse


def camera(f_number: float, pixel_pitch: str = "12 um") -> ommatid.Scene:
    """Return a tile of 19 x 19 pixels before three lens types of one f-number."""
    lenses = [
        {"name": name, "magnification": f"1/{m}", "array": [m, m], "pixels": "fit", "f_number": f_number}
        for name, m in (("I", 3), ("II", 4), ("III", 5))
    ]
    return parse(
        {
            "target": {"shape": [19, 19], "pixel_pitch": "1 mm", "distance": "1 m"},
            "camera": {"pixel_pitch": pixel_pitch, "lens_pitch": "3 mm", "lens": lenses},
            "noise": {"variance": 1e-3},
        },
        Path("my lens"),
    )


camera(4.0)

# %% [markdown]
# ## Which f-number
#
# The Airy disk grows with the f-number. Beyond a quarter of a sensor pixel for wavelength times f-number, the error
# rises steeply.

# %%
f_numbers = np.array([1.4, 2.0, 2.8, 4.0, 5.6, 8.0])
figure, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
for pitch in ("6 um", "12 um"):
    errors = [ommatid.predict(camera(number, pitch), rays=False).mse for number in f_numbers]
    ax.loglog(f_numbers, np.sqrt(errors), "o-", label=f"pixels of {pitch}")
ax.set(xlabel="f-number", ylabel="expected error (grey levels rms)", xticks=f_numbers)
ax.set_xticks(f_numbers, [f"{number:g}" for number in f_numbers])
ax.minorticks_off()
ax.legend()
ax.grid(alpha=0.3)

# %% [markdown]
# ## A real lens
#
# The gallery's `doublet` is a cemented achromat, traced surface by surface. Its surfaces are in a file of their own.

# %%
achromat = ommatid.read_scene("doublet")
for surface in achromat.camera.lens[0].surfaces:
    behind = f"then {surface.thickness:g} mm of {surface.glass or 'air'}" if surface.thickness else "then the sensor"
    print(f"radius {surface.radius:8.4f} mm, {behind}")
