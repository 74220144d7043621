"""Benchmarks: ratios between alternatives timed in one run."""
