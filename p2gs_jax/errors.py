"""Errors that the user can fix; the command line prints them without a traceback and exits 2."""


class UserError(Exception):
    """Bad input or an impossible request.

    The `message` names the file or option and its fault, `fix` names the remedy.
    """

    def __init__(self, message: str, *, fix: str | None = None):
        self.message = message.removesuffix(".") + "."
        super().__init__(self.message)
        self.fix = fix

    def __str__(self) -> str:
        return self.message if self.fix is None else f"{self.message}\n  To fix it: {self.fix}"


class DivergenceError(UserError):
    """A loss or a gradient is not finite; the message names step, term and checkpoint."""


def broken(
    source: object,
    why: object,
    fix: str = "get the file again: it is damaged or of another version",
) -> UserError:
    """Return the error for a damaged file; the fault `why` follows the name of the file."""
    return UserError(f"{source} {why}", fix=fix)
