"""The indexer method."""
