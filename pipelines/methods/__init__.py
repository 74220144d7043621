"""One module a method: recording to Problem."""
