"""The one error that a user can mend."""


class UserError(Exception):
    """Input that cannot be used: says what was found and what is allowed. The command line exits with status 2."""
