"""The one exception of known causes."""

from __future__ import annotations


class InputError(Exception):
    """Input that cannot be used: a recording, a config, an option.

    The message is one line that says what is wrong, where (topic, time, key) and what to do. The command line prints it
    and exits with code 2.
    """
