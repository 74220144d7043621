"""The los method."""
