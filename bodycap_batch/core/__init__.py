"""What every package builds on: errors, checked arrays, progress events and the context of a stage."""
