"""The one exception that stands for a user's mistake: the commands print its single line and exit with status 2."""


class UserError(Exception):
    """A mistake in data, configuration or arguments.  The message is one line: which file or key, and the likely cause."""
