"""The scene: a pytree whose structure tells which kinds occur, so that only these are compiled."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
from jaxtyping import Array, Int

from pathjax import bsdfs
from pathjax.bsdfs import Materials
from pathjax.compile import register_dataclass, standard_promotion
from pathjax.emitters import Lights
from pathjax.errors import InputError
from pathjax.media import Media
from pathjax.scene.metadata import About, Names
from pathjax.sensors import Camera
from pathjax.sensors.film import Film
from pathjax.shapes import Geometry

# Depth that stands for "no limit": no path survives roulette for so many bounces.
UNBOUNDED = 1 << 30


@register_dataclass
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
    about: About | Names | None = field(metadata={"static": True})  # Names in fits; None in kernels
    free_passes: bool = field(default=False, metadata={"static": True})  # straight passes are no vertices
    media: Media | None = None  # between surfaces; None: vacuum everywhere
    # Parameters that `with_parameters` set to traced values, by name. They carry the derivative, and tables hold the
    # same values detached: so a derivative through a table was requested in another way.
    varied: dict[str, Array] = field(default_factory=dict)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors in the order of the scene's file: ids, or indices from 0 for sensors without an id."""
        return tuple(self.described.description.views)

    @standard_promotion
    def with_sensor(self, which: int | str) -> Scene:
        """Return the scene seen by another sensor of its file, with its film; all else, also parameters, is shared.

        Args:
            which: one of `sensors`, or its index, from 0.
        Raises:
            InputError: there is no such sensor, it is not supported, or it stands in another medium.
        """
        about = self.described
        description = about.description.seen_by(which)
        if self.media is not None and description.view.medium is not about.description.view.medium:
            name = description.seen
            raise InputError(f"sensor {name!r} stands in another medium; load the scene with sensor={name!r}")
        dtype = self.camera.origin.dtype
        seen = description.view
        view = seen.camera.build(seen.film, dtype), seen.film.build(dtype)
        camera, film = jax.device_put(view)
        return replace(self, camera=camera, film=film, about=replace(about, description=description))

    @property
    def described(self) -> About | Names:
        """Return `about`, which is an `About` outside of fits.

        Raises:
            InputError: the scene was stripped of its names.
        """
        if self.about is None:
            raise InputError("this scene was stripped of its names; take the one that load_scene returned")
        return self.about

    @property
    def scatters(self) -> bool:
        """Return whether light is scattered between surfaces."""
        return self.media is not None and self.media.scatters

    @property
    def samples_lights(self) -> bool:
        """Return whether light samples can contribute, as something other than Dirac lobes scatters light."""
        return self.scatters or bsdfs.occurs(self.materials, "smooth")
