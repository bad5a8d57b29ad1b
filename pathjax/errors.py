"""Exceptions for mistakes that the user can correct: an error ends the work; after a warning it continues."""


class InputError(ValueError):
    """A file, a name or an argument is wrong. The message names the place, the mistake and the remedy.

    The command line prints the message alone and exits with status 2.
    """


class InputWarning(UserWarning):
    """A setting is surely unintended, or something beside the work failed. The command line prints only the message."""
