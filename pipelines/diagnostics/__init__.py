"""Tests of an estimate: numbers and findings, no words, nothing solved but in trials.

- observability: directions of the joint covariance in prior sigmas; z-score of a number against its prior
- goodness of fit: chi-square and its two-sided interval; innovations; robust scale of residuals
- change: differences between the estimate until a time and the final one have covariance P_t - P_T (Hausman)
- hypotheses: data with one fault mended are solved again; chi-square compares them
- device changes: a random walk with steps between recordings; Allan deviation and Whittle likelihood for noise at rest

Begin with `diagnose.py`, which turns an `Estimate` into `Finding`s; `fault_models.py` says what a method declares.
Knows problems and estimates: no method (a `build` function is passed), no recording, no report.
"""
