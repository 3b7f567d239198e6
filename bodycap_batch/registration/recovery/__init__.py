"""Find the poses of lost frames."""
