"""Descriptions of exceptions that code of the user raises."""

import traceback

# What code that is only imported or called must not end a command with: sys.exit() would end it as if it had succeeded
FAILURES = (Exception, SystemExit)


def describe_exception(error: BaseException) -> str:
    """Return the type, the message and the place of an exception, in one line."""
    message = " ".join(str(error).split())
    frames = traceback.extract_tb(error.__traceback__)
    # The message of a SyntaxError has the place; the traceback has only that of the import
    has_place = frames and not isinstance(error, SyntaxError)
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if has_place else ""
    return f"{type(error).__name__}{f': {message}' if message else ''}{place}"
