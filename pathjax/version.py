"""The version, of the package and of the states that a checkpoint may hold."""

__version__ = "0.5.0"
