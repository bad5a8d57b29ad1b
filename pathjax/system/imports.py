"""The module to import first: from here until `done`, Python's garbage collector is off.

Imports create lasting objects; scanning these again and again takes a fifth of the import time.
"""

import gc

_enabled = gc.isenabled()
gc.disable()


def done() -> None:
    if _enabled:
        age()
        gc.enable()


def age() -> None:
    """Move all objects to the oldest generation, which the collector seldom scans, without scanning them now.

    It does nothing if the program has frozen objects, as these can be unfrozen only all together.
    """
    if not gc.get_freeze_count():
        gc.freeze()
        gc.unfreeze()
