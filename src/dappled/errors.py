"""The family of errors that a person is told in one sentence: what, where, what to do."""


class DappledError(Exception):
    """Something a person can mend. The message is the whole sentence; no traceback is shown with it."""
