"""The motion as a factor graph: factors, optimisers, windows of a long timeline, covariance of the joints."""
