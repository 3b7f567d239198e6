"""Foundations that every package uses: errors, checked arrays, progress events, the context of a stage."""
