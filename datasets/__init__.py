"""Converters of public recordings to sessions; named scenarios."""
