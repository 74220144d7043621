"""Solvers of a `Problem`: square-root elimination of a chain, robust minimisation, posterior, fixed-lag smoother.

Batch (`batch.py`): the problem is compiled into arrays (`engines.py`, `layout.py`, `linearization.py`);
Levenberg-Marquardt by gain ratio (`levenberg.py`) inside graduated non-convexity (`robust.py`) minimises; `chain.py`
eliminates all segments of the chain in lockstep by QR, and its root R of the shared unknowns gives covariance
(`posterior.py`), history, error budget and weak directions. Noise levels: restricted maximum likelihood
(`noise_estimation.py`), or the marginal likelihood of a rate-dependent model (`marginal_likelihood.py`).
`gtsam_engine.py` solves the same problem as a gtsam graph.

Incremental (`incremental.py`): batch solutions at geometric times while little is known, then iSAM2 or a fixed-lag
square-root smoother of gtsam (`smoother.py`), innovations gated by their chi-square (`gating.py`).

Begin with `chain.py`, then `batch.py`. Knows problems alone: no method, no recording, no report.
"""
