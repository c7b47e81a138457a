"""Simulate, calibrate and reconstruct the images of flat compound-eye cameras, with error bars.

The functions of this module do what the commands of the same names do, and return arrays:

    import ommatid
    scene = ommatid.read_scene("tile19", set={"noise.variance": 1e-2})
    stack, model = ommatid.render(scene), ommatid.calibrate(scene)
    result = ommatid.reconstruct(stack, model)

Nothing heavy is loaded before the first of them is used.
"""

# Neither `typing` nor `__future__` is imported: `python -m ommatid` first takes the current folder off the path.
from importlib import import_module
from types import ModuleType

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from .interface import (
        InputError,
        MachineError,
        Model,
        Reconstructor,
        Result,
        Scene,
        Stack,
        calibrate,
        check,
        observe,
        predict,
        prepare,
        read_model,
        read_result,
        read_scene,
        read_stack,
        reconstruct,
        render,
        run,
        stack,
        target_image,
    )

__all__ = [
    "InputError",
    "MachineError",
    "Model",
    "Reconstructor",
    "Result",
    "Scene",
    "Stack",
    "calibrate",
    "check",
    "observe",
    "predict",
    "prepare",
    "read_model",
    "read_result",
    "read_scene",
    "read_stack",
    "reconstruct",
    "render",
    "run",
    "stack",
    "target_image",
]


class _CallablePackage(ModuleType):
    """The package ommatid.reconstruct, which is also the function of that name."""

    def __call__(self, stack: "Stack", model: "Model", truth: "Any" = None) -> "Result":
        """Reconstruct a stack with a model; see ommatid.interface.reconstruct."""
        return import_module(".interface", __name__).reconstruct(stack, model, truth)


import_module(".reconstruct", __name__).__class__ = _CallablePackage  # a docstring: this loads nothing else


def __getattr__(name: str) -> "Any":
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(".interface", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
