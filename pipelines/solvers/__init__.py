"""Batch and incremental solvers of Problems."""
