"""Scene files and meshes: `load.load_scene` makes a scene of a file; the readers below it are plain NumPy."""
