"""The cube method."""
