"""Reconstruction of many frames of one camera, prepared once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ommatid.reconstruct.methods.prepared import Prepared
from ommatid.reconstruct.output import result_files
from ommatid.reconstruct.restore import check_camera
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import digest, fingerprint
from ommatid.scenes.camera import derive
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack

from .result import Result, check_type, flat_truth, result_of

NAMES = Path("the stack"), Path("the model")


class Reconstructor:
    """Reconstructs stacks of one camera with one model, one at a time; `ommatid.prepare` creates it."""

    def __init__(self, model: Model, scene: Scene | None = None) -> None:
        """Take [prior], [estimator] and [tiles] from `scene`, without one from each stack's own scene.

        Raises InputError if scene and model are of different cameras.
        """
        if scene is not None:
            check_camera(derive(scene), model, (scene.source, NAMES[1]))
        self._model, self._scene = model, scene
        self._prepared = Prepared(model)
        self._model_digest: str | None = None

    def __call__(self, stack: Stack, truth: FloatArray | None = None) -> Result:
        """Reconstruct a stack, as `ommatid.reconstruct` does.

        The error bars are those of an earlier stack where the noise variances of both are alike to a hundredth;
        `summary.diagnostics.noise_difference` then holds by how much they differ. The estimate is the stack's own.

        truth : with which the estimate is compared, (rows, columns) or (N,), of f or of a world finer than f
        Raises InputError if the stack is of another camera, or if memory does not suffice.
        """
        check_type("stack", stack, Stack, "read_stack")
        stack = self._with_estimator(stack)
        flat = None if truth is None else flat_truth(truth, stack.camera)
        outcome, report = result_files.reconstruct(stack, self._model, flat, NAMES, prepared=self._prepared)
        report = report.with_changes(fingerprint=self._fingerprint(stack))
        return result_of(stack, self._model, outcome, report)

    def _with_estimator(self, stack: Stack) -> Stack:
        if self._scene is None:
            return stack
        changes = {table: getattr(self._scene, table) for table in result_files.ESTIMATOR_TABLES}
        return replace(stack, scene=stack.scene.model_copy(update=changes))

    def _fingerprint(self, stack: Stack) -> str:
        """Return the fingerprint of everything that an estimate depends on; H is read for the first stack only."""
        if self._model_digest is None:
            nothing = replace(stack, values=stack.values[:0], variance=stack.variance[:0], record={})
            self._model_digest = result_files.fingerprint_of(nothing, self._model)
        pixels = digest(stack.values, stack.variance)
        return fingerprint([self._model_digest, pixels, stack.record, stack.scene.plain()])
