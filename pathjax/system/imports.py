"""What is imported first: from here until `done`, Python looks for no garbage.

Importing makes modules, which stay, and to go through them time and again takes a fifth of it.
"""

import gc

_enabled = gc.isenabled()
gc.disable()


def done() -> None:
    if _enabled:
        age()
        gc.enable()


def age() -> None:
    """Let Python take all objects for old ones, which it seldom goes through, without going through them now.

    Where a program has frozen some, which only all together are let go of again, all stay as they are.
    """
    if not gc.get_freeze_count():
        gc.freeze()
        gc.unfreeze()
