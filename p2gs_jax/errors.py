"""Errors that a person can act on; the command line prints them without a traceback and exits 2."""


class UserError(Exception):
    """Bad input or an impossible request: which file, what is wrong, what to do."""

    def __init__(self, message: str, *, fix: str | None = None):
        """Store the message and, where there is one, the remedy.

        Args:
            message: what is wrong, naming the file or the option.
            fix: what the person can do about it.
        """
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
    """Return the error for a file that does not hold what it should.

    Args:
        source: the file.
        why: what is wrong, in words that follow the file's name.
        fix: the remedy.
    """
    return UserError(f"{source} {why}", fix=fix)
