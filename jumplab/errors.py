"""One root for every error that jumplab raises on purpose.

A message says what is wrong, where, the value, the limit and what to do. The command line prints the message alone and
exits with ``exit_code``.
"""


class JumplabError(Exception):
    """Root of all deliberate errors of the package."""

    exit_code = 4


class InputError(JumplabError):
    """The caller asked for something that cannot be meant: a bad target, file, option or robot."""

    exit_code = 2


class RobotError(InputError):
    """A robot description is missing something, or says something impossible."""


class InfeasibleError(JumplabError):
    """The question is well posed, but this robot cannot do it (or no plan was found within the limits)."""

    exit_code = 3


class SolverError(JumplabError):
    """A solver stopped without an answer that passes its own re-evaluated residuals.

    Attributes
    ----------
    stage : str
        Name of the stage that failed.
    status : str
        What the solver said.
    violations : tuple of str
        The worst violated terms, "name: amount unit at node k, t = ... s".
    """

    exit_code = 3

    def __init__(self, message: str, *, stage: str = "", status: str = "", violations: tuple[str, ...] = ()):
        super().__init__(message)
        self.stage, self.status, self.violations = stage, status, violations
