"""The head method."""
