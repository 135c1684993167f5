"""The base of every error that a user of `processing` can cause and mend."""


class ProcessError(Exception):
    """Something asked for cannot be done; the message says what was asked, what came back, what to do.

    The command line prints the message without a traceback and ends with `exit_code`.

    Examples
    --------
    >>> try:
    ...     Capture("absent.h5")
    ... except ProcessError as error:
    ...     error.exit_code
    2
    """

    exit_code = 2


class NotDetermined(ProcessError):
    """The input is sound, but the data do not determine what was asked for."""

    exit_code = 1
