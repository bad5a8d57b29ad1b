"""A render's state on disk: a killed process leaves the last complete one, which continues to the same bits."""

from __future__ import annotations

import contextlib
import glob
import json
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pathjax import distributed, version
from pathjax.errors import InputError, InputWarning
from pathjax.rendering.progressive.passes import State
from pathjax.rendering.progressive.replicates import one_if_equal
from pathjax.scene.alike import fingerprint
from pathjax.scene.scene import Scene
from pathjax.sensors import film
from pathjax.system.files import write_whole
from pathjax.system.json_text import json_text

# Saving takes at most one in this many seconds.
COST = 200
# Assumed seconds of the first save with samples, so that it is due after a second.
_FIRST_COST = 0.005


def identity(scene: Scene, seed: int, strategy: str, adaptive: bool) -> dict[str, str | int]:
    """Return the facts that must agree for a state to be continued."""
    height, width = film.image_shape(scene.film)
    return {
        "pathjax": version.__version__,
        "image size": f"{width}x{height}",
        "scene": fingerprint(scene),
        "strategy": strategy,
        "seed": seed,
        "sampling": "adaptive" if adaptive else "uniform",
    }


class Checkpoint:
    """A file that holds the last saved state of one render."""

    def __init__(self, path: str | Path, identity: Mapping[str, str | int]):
        self.path, self.identity = Path(path), dict(identity)
        self.problem: str | None = None  # why the last state is not in the file
        self._saved, self._cost = 0.0, _FIRST_COST
        # Remove partial files of killed processes.
        parts = () if distributed.index() else self.path.parent.glob(f".{glob.escape(self.path.name)}.*.part")
        for part in parts:
            with contextlib.suppress(OSError):
                part.unlink()

    def load(self, fresh: State) -> State:
        """Return the saved state, or `fresh`, which has the same shapes, if there is no file.

        Raises:
            InputError: the file is damaged, not a checkpoint, or of another render; the message says which.
        """
        if not self.path.exists():
            return fresh
        try:
            with np.load(self.path, allow_pickle=False) as file:
                facts = json.loads(str(file["facts"]))
                identity, spp, seconds = facts["identity"], int(facts["spp"]), float(facts["seconds"])
                chunk = min(max(int(facts["chunk"]), 1), len(fresh.count))
                arrays = {name: file[name] for name in ("means", *fresh.of_pixels)} if file.files != ["facts"] else {}
        except Exception as error:  # zipfile, zlib, NumPy and json raise many kinds, depending on the file's bytes
            raise self._refusal(f"is not a checkpoint, or is damaged ({error})") from None
        for name, ours in self.identity.items():
            theirs = identity.get(name)
            if theirs != ours:
                raise self._refusal(f"was made with {name} {theirs}, this is {name} {ours}")
        if not arrays:
            return fresh
        state = replace(fresh, seconds=seconds)
        for name, array in arrays.items():
            wanted = getattr(fresh, name)
            shapes = (wanted.shape, (1,)) if name in fresh.of_pixels else (wanted.shape,)
            if array.dtype != wanted.dtype or array.shape not in shapes:
                raise self._refusal(f"is damaged: {name} is {array.dtype}{list(array.shape)}")
            setattr(state, name, np.broadcast_to(array, wanted.shape).copy())
        state.resume(spp, chunk)
        return state

    def save(self, state: State) -> None:
        """Write the state to the file; of several processes only the first one writes.

        Raises:
            InputError: the file cannot be written; the last one written is intact.
        """
        if distributed.index():
            return
        started = time.perf_counter()
        # Before the first sample there is nothing to save; this only checks that the file is writable.
        arrays = {}
        if state.count.any():
            arrays = {"means": state.means} | {name: one_if_equal(getattr(state, name)) for name in state.of_pixels}
        facts = json_text({"identity": self.identity, "spp": state.spp, "chunk": state.chunk, "seconds": state.seconds})

        try:
            write_whole(self.path, lambda file: np.savez(file, facts=np.array(facts), **arrays))
        finally:
            self._saved = time.perf_counter()
            if arrays:
                self._cost = self._saved - started

    def keep(self, state: State) -> None:
        """Save; on failure only warn, once for each reason, since the render is worth more than its checkpoint."""
        earlier, self.problem = self.problem, None
        try:
            self.save(state)
        except Exception as error:
            self.problem = str(error) or type(error).__name__
            if self.problem != earlier:
                warnings.warn(f"{self.problem}; the render goes on without", InputWarning, stacklevel=2)

    def save_if_due(self, state: State) -> None:
        """Call `keep`, unless the last save was so recent that it would slow the render down."""
        if time.perf_counter() - self._saved > COST * self._cost:
            self.keep(state)

    def _refusal(self, what: str) -> InputError:
        return InputError(f"{self.path} {what}; delete it, or name another checkpoint")
