"""The report of the merging stage, and the advice in it."""
