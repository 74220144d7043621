"""What methods build with and solvers solve: Problem, Step, Parameter, Estimate, priors, the walking bias."""
