"""What is imported first: from here until `done`, Python looks for no garbage.

Importing makes modules, which stay, and to go through them time and again takes a fifth of it.
"""

import gc

_enabled = gc.isenabled()
gc.disable()


def done() -> None:
    if _enabled:
        gc.enable()
