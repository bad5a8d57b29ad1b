"""Scene files and meshes: `load.load_scene` builds a scene from a file; the readers that it uses are plain NumPy."""
