"""The published solvers, as published."""
