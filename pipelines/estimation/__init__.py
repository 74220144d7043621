"""Maximum a-posteriori estimation of a chain with shared unknowns: what methods declare and solvers return.

A recording is a chain of small states x_k (attitudes; poses) and a few dozen unknowns s that all of it shares (mounts,
biases, scales). The estimate minimises

    sum_i rho(|r_i(x_k, x_k+1, b_j, s)|^2) + |W (s - s_0)|^2

with whitened residuals r, a robust loss rho for measurements that may be outliers, a bias b_j that walks in pieces, and
Gaussian priors. Covariances are those of the linearised problem at the minimum.

Begin with `problem.py` (Problem, Step, Quantity, Estimate), then `gyro_chain.py`. It imports no method, solver
or recording.
"""
