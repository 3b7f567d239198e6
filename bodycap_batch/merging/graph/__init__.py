"""The factor graph of the body in motion, and the covariance of its solution."""
