"""The body as the graph sees it: bones and joint priors, initial poses, T-pose, trunk lean, completion."""
