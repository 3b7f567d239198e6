"""The body in the graph: bones, joint priors, initial poses, T-pose, tilt of the trunk, all joints."""
