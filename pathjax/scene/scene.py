"""The scene: a pytree whose structure says what occurs, so that only that is compiled."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
from jaxtyping import Array, Int

from pathjax import bsdfs
from pathjax.bsdfs import Materials
from pathjax.emitters import Lights
from pathjax.media import Media
from pathjax.scene.metadata import About
from pathjax.sensors import Camera
from pathjax.sensors.film import Film
from pathjax.shapes import Geometry

# Depth that stands for "no limit": more bounces than any path survives roulette.
UNBOUNDED = 1 << 30


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scene:
    """Arrays of a scene. Scenes of the same structure and array shapes share one compiled kernel."""

    camera: Camera
    film: Film
    geometry: Geometry
    materials: Materials
    emitters: tuple[Lights, ...]  # one for each kind present
    max_depth: Int[Array, ""]  # vertices of the longest path; 1: emission only
    rr_depth: Int[Array, ""]  # vertices before roulette begins
    hide_emitters: bool = field(metadata={"static": True})  # from the camera
    about: About | None = field(metadata={"static": True})  # None: within kernels
    free_passes: bool = field(default=False, metadata={"static": True})  # straight through a surface is no vertex
    media: Media | None = None  # between surfaces; None: all is clear
    # Parameters that `with_parameters` set to traced values, by name. They carry the derivative, and tables hold the
    # same numbers detached: so a derivative that comes by a table is one that was asked for by other means.
    varied: dict[str, Array] = field(default_factory=dict)

    @property
    def scatters(self) -> bool:
        """Whether light is scattered between surfaces."""
        return self.media is not None and self.media.scatters

    @property
    def samples_lights(self) -> bool:
        """Whether anything scatters what a light sample finds: Dirac lobes do not."""
        return self.scatters or bsdfs.occurs(self.materials, "smooth")
