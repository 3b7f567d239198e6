"""Ground of every package: errors, checked arrays, progress, what a stage may use besides its inputs."""
