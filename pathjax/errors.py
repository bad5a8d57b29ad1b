"""Mistakes that the user can correct: an error ends the work, and after a warning it goes on."""


class InputError(ValueError):
    """A file, a name or an argument is wrong. The message says where, what is wrong and what to do about it.

    The command line prints the message alone and exits with status 2.
    """


class InputWarning(UserWarning):
    """A setting is surely not meant, or something beside the work failed. The command line prints the message alone."""
