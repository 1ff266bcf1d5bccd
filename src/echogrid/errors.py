"""The errors that echogrid raises on purpose; all share one root."""


def escaped(text: str) -> str:
    """The text on one line that a terminal can show: what controls a terminal is written as Python writes it."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class EchogridError(Exception):
    """Root of every error that a user of echogrid can cause. Its text is one line that a terminal can show."""

    def __init__(self, text: str):
        super().__init__(escaped(text))


class InputError(EchogridError):
    """Something that was read is not what it should be.

    The text is ``where: found X, expected Y``; ``where`` names the file and, where there is one, the line
    (``drive.csv:17``) or the key (``robot.yaml: mounts[3]``).
    """

    def __init__(self, where: object, found: str, expected: str):
        super().__init__(f"{where}: found {found}, expected {expected}")
        self.where, self.found, self.expected = str(where), found, expected

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        # An error that is raised in another process is made anew of these.
        return type(self), (self.where, self.found, self.expected)


class UsageError(EchogridError):
    """A request that cannot be carried out as it stands, though every file is well formed."""


class MissingError(UsageError, ImportError):
    """A request that needs a package which is not installed; the line says how it is."""


class DoubtWarning(UserWarning):
    """Frames that a program handed over were mapped, but something about them is doubtful."""
