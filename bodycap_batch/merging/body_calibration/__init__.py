"""What is constant about a body: mounts, bone lengths, metric scale, and their uncertainty."""
