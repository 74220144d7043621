"""Recordings in and out: bytes to messages to arrays; the only place that knows formats, topics and clocks."""
