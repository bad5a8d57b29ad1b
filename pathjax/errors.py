"""Mistakes that the user can mend: those that end the work, and those with which it goes on."""


class InputError(ValueError):
    """A file, a name or an argument is wrong; the message says where, what, and what to do about it.

    The command line prints the message alone and exits with status 2.
    """


class InputWarning(UserWarning):
    """What is surely not meant, or could not be done beside the work; the command line prints the message alone."""
