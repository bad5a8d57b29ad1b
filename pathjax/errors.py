"""The one exception for mistakes that the user can mend."""


class InputError(ValueError):
    """A file, a name or an argument is wrong; the message says where, what, and what to do about it.

    The command line prints the message alone and exits with status 2.
    """
