"""The command line."""

from pathjax.cli.commands import main

__all__ = ["main"]
