"""Calibrating while the recording is still being written."""
