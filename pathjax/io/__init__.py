"""Files in and out: Mitsuba scene files, meshes, images. Plain NumPy; nothing here knows JAX."""
