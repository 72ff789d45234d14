"""Errors that a person can act on; the command line prints them without a traceback and exits 2."""


class UserError(Exception):
    """Bad input or an impossible request.

    The `message` says what is wrong with which file or option, `fix` what the person can do.
    """

    def __init__(self, message: str, *, fix: str | None = None):
        super().__init__(message)
        self.message = message
        self.fix = fix

    def __str__(self) -> str:
        """Return the message followed by the remedy."""
        return self.message if self.fix is None else f"{self.message}\n  To fix it: {self.fix}"


class DivergenceError(UserError):
    """A loss or a gradient stopped being finite; names the step, the term and the checkpoint."""


def broken(
    source: object,
    why: object,
    fix: str = "get the file again: it is damaged or of another version",
) -> UserError:
    """Return the error for a file that does not hold what it should; `why` follows its name."""
    return UserError(f"{source} {why}", fix=fix)
